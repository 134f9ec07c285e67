"""What messages must hold."""

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np
import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.wire.codec import Message, decode, encode
from congrasp.common.wire.messages import (
    EPISODE,
    EVENT,
    RECORDED,
    MessageSpec,
    RolloutForm,
    is_finite,
    validate,
    validate_bundle,
    validate_rollout,
)

T = 3
B = 2
D = 5
A = 4
E = 1
FORM = RolloutForm(T, B, D, A, half=True)


def rollout(arrays=None, **meta):
    """A valid rollout with changes; an array that is None is left out."""
    all_arrays = {
        **FORM.zeros(),
        "episode/success": np.zeros(E, np.float32),
        "term/distance": np.zeros(E, np.float32),
    } | (arrays or {})
    header = {
        "actor": "a",
        "incarnation": "0f",
        "sequence": 0,
        "version": 2,
        "run_id": "e",
        "schema": "s",
    }
    return Message(
        {name: array for name, array in all_arrays.items() if array is not None},
        {**header, "steps": T * B, **meta},
    )


def check(message, form=FORM, **options):
    return validate_rollout(message, form, **options)


def test_valid_rollout_gives_its_header():
    header = check(decode(encode(rollout(sequence=7))), schema="s")
    assert header == ("a", "0f", 7, 2, "e", "s", T * B)
    assert header.owner == ("a", "0f")


def test_no_episode_need_have_ended_and_none_need_be_measured():
    check(
        rollout(
            {"episode/success": np.zeros(0, np.float32), "term/distance": np.zeros(0, np.float32)}
        )
    )
    check(rollout({"episode/success": None, "term/distance": None}))


def full(shape, value, dtype=np.float32):
    array = np.zeros(shape, dtype)
    array.flat[-1] = value
    return array


@pytest.mark.parametrize(
    ("arrays", "match"),
    [
        ({"action": None}, "lacks the array 'action'"),
        ({"extra": np.zeros(1, np.float32)}, "unknown array 'extra'"),
        ({"episode": np.zeros(1, np.float32)}, "unknown array 'episode'"),
        ({"action": np.zeros((T, B, A))}, "'action' has dtype float64, not float32"),
        ({"terminal": np.zeros((T, B), np.uint8)}, "'terminal' has dtype uint8, not bool"),
        (
            {"observation": np.zeros((T, B, D + 1), np.float16)},
            r"'observation' has shape \(3, 2, 6\), not .*D=5",
        ),
        (
            {"action": np.zeros((T, B, A + 1), np.float32)},
            r"'action' has shape \(3, 2, 5\), not .*A=4",
        ),
        (
            {"reward": np.zeros((T + 1, B), np.float32)},
            r"'reward' has shape \(4, 2\), not \(T=3, B=2\)",
        ),
        ({"reward": np.zeros((T, B, 1), np.float32)}, "'reward' has shape"),
        ({"last_observation": np.zeros((B + 1, D), np.float16)}, "'last_observation' has shape"),
        (
            {"observation": np.zeros((T, B, D), np.float32)},
            "'observation' has dtype float32, not float16",
        ),
        (
            {"last_observation": np.zeros((B, D), np.float32)},
            "'last_observation' has dtype float32, not float16",
        ),
        ({"term/distance": np.zeros(E + 1, np.float32)}, "'term/distance' has shape"),
        (
            {"observation": full((T, B, D), np.nan, np.float16)},
            "'observation' has values that are not finite",
        ),
        (
            {"observation": full((T, B, D), -np.inf, np.float16)},
            "'observation' has values that are not finite",
        ),
        ({"reward": full((T, B), np.inf)}, "'reward' has values that are not finite"),
        ({"episode/success": full(E, np.nan)}, "'episode/success' has values that are not finite"),
    ],
)
def test_bad_array_is_named_with_its_rule(arrays, match):
    with pytest.raises(CongraspError, match=match):
        check(rollout(arrays))


@pytest.mark.parametrize(
    ("meta", "match"),
    [
        ({"sequence": -1}, "counts"),
        ({"version": 10**20}, "too large for a count"),
        ({"sequence": "0"}, "'sequence' is '0', not int"),
        ({"sequence": True}, "'sequence' is True, not int"),
        ({"version": 1.0}, "'version' is 1.0, not int"),
        ({"run_id": None}, "'run_id' is None, not str"),
        ({"actor": "../x"}, "actor"),
        ({"incarnation": "x" * 65}, "incarnation"),
        ({"steps": 5}, r"'steps' is 5, not T\*B = 3\*2"),
        ({"schema": "other"}, "policy schema 'other', not s"),
    ],
)
def test_bad_meta_is_named(meta, match):
    with pytest.raises(CongraspError, match=match):
        check(rollout(**meta), schema="s")


def test_empty_rollout_is_refused():
    nothing = RolloutForm(0, B, D, A, half=True).zeros()
    with pytest.raises(CongraspError, match=r"has shape \(0, 2, 5\), not \(T=3, B=2, D=5\)"):
        check(rollout(nothing, steps=0))


def test_zeros_have_the_forms_sizes_and_dtypes():
    zeros = RolloutForm(T, B, D, A, half=False).zeros(rollouts=3)
    assert {name: (array.shape, str(array.dtype)) for name, array in zeros.items()} == {
        "observation": ((T, 3 * B, D), "float32"),
        "action": ((T, 3 * B, A), "float32"),
        "log_probability": ((T, 3 * B), "float32"),
        "reward": ((T, 3 * B), "float32"),
        "terminal": ((T, 3 * B), "bool"),
        "truncated": ((T, 3 * B), "bool"),
        "last_observation": ((3 * B, D), "float32"),
    }


def test_an_algorithm_that_learns_from_less_is_sent_less():
    form = dataclasses.replace(
        FORM, arrays={name: RECORDED[name] for name in ("observation", "reward")}
    )
    check(Message(form.zeros(), rollout().meta), form)
    with pytest.raises(CongraspError, match="unknown array 'action'"):
        check(rollout(), form)
    with pytest.raises(CongraspError, match="lacks the array 'reward'"):
        check(Message({"observation": form.zeros()["observation"]}, rollout().meta), form)


def test_device_arrays_pass_unread():
    check(
        Message(
            {name: jnp.asarray(array) for name, array in rollout().arrays.items()}, rollout().meta
        )
    )


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan])
@pytest.mark.parametrize("at", [0, 65535, 65536, 200_000])
def test_every_half_is_looked_at(value, at):
    array = np.full((3, 66_667), 65504, np.float16)
    assert is_finite(array)
    assert is_finite(-array)
    assert is_finite(array[:0])
    array.flat[at] = value
    assert not is_finite(array)


def bundle(**arrays):
    statistics = {
        f"{kind}/{name}": np.zeros(shape)
        for (kind, shape), name in itertools.product(
            (("observation", 5), ("value", ())), ("mean", "m2")
        )
    }
    counts = {"observation/count": np.zeros(()), "value/count": np.zeros(())}
    weights = {
        "actor/trunk/0/kernel": np.zeros((5, 3), np.float32),
        "critic/head/bias": np.zeros(1, np.float32),
    }
    meta = {
        "version": 1,
        "run_id": "e",
        "schema": "s",
        "hand": "human",
        "layout": [["state", 5]],
        "action_size": 4,
    }
    all_arrays = {**statistics, **counts, **weights, **arrays}
    return Message(
        {name: array for name, array in all_arrays.items() if array is not None},
        {**meta, "format": 1},
    )


def test_bundle():
    validate_bundle(bundle(), schema="s")
    with pytest.raises(CongraspError, match="policy schema 's', not t"):
        validate_bundle(bundle(), schema="t")
    with pytest.raises(CongraspError, match="lacks the array 'observation/mean'"):
        validate_bundle(bundle(**{"observation/mean": None}))
    with pytest.raises(CongraspError, match=r"'observation/m2' has shape \(4,\), not \(D=5\)"):
        validate_bundle(bundle(**{"observation/m2": np.zeros(4)}))
    with pytest.raises(CongraspError, match="no arrays of an actor"):
        validate_bundle(bundle(**{"actor/trunk/0/kernel": None}))
    with pytest.raises(CongraspError, match="'critic/head/bias' has values that are not finite"):
        validate_bundle(bundle(**{"critic/head/bias": full(1, np.nan)}))
    with pytest.raises(CongraspError, match="unknown array 'optimizer/mu'"):
        validate_bundle(bundle(**{"optimizer/mu": np.zeros(1)}))


def test_symbols_bind_across_arrays_and_literals_hold():
    with pytest.raises(
        CongraspError, match=r"'link_quaternion' has shape \(7, 2, 3\), not \(T=7, L=2, 4\)"
    ):
        validate(
            Message({"link_position": np.zeros((7, 2, 3)), "link_quaternion": np.zeros((7, 2, 3))}),
            MessageSpec(
                "episode",
                {name: EPISODE.arrays[name] for name in ("link_position", "link_quaternion")},
            ),
        )


def test_meta_alone():
    validate(Message(meta={"time": 1.5, "level": "info", "text": "x", "more": 1}), EVENT)
    validate(Message(meta={"time": 1, "level": "info", "text": "x"}), EVENT)
    with pytest.raises(CongraspError, match="'time' is '1', not int or float"):
        validate(Message(meta={"time": "1", "level": "info", "text": "x"}), EVENT)
