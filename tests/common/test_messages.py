"""Rollouts are checked against their specification."""

import dataclasses

import numpy as np
import pytest

from common.errors import CongraspError
from common.wire.codec import Message
from common.wire.messages import validate_bundle, validate_rollout
from tests.rollouts import ACTION, OBSERVATION, SCHEMA, bundle, rollout


def _check(message: Message) -> None:
    validate_rollout(message, observation_size=OBSERVATION, action_size=ACTION, schema=SCHEMA)


def _changed(name: str, value: np.ndarray | None) -> Message:
    message = rollout()
    arrays = {k: v for k, v in message.arrays.items() if k != name}
    return dataclasses.replace(message, arrays=arrays if value is None else {**arrays, name: value})


def test_a_good_rollout_passes():
    _check(rollout())


@pytest.mark.parametrize(
    ("name", "value", "word"),
    [
        ("reward", None, "lacks the array 'reward'"),
        ("extra", np.zeros(3, np.float32), "should not have"),
        ("reward", np.zeros((4, 2)), "float64"),
        ("reward", np.zeros((4, 3), np.float32), "B should be 2"),
        ("action", np.zeros((4, 2, 9), np.float32), "A should be 3"),
        ("reward", np.full((4, 2), np.nan, np.float32), "not finite"),
        ("observation", np.full((4, 2, OBSERVATION), np.inf, np.float16), "not finite"),
        ("episode/success", np.zeros((2, 2), np.float32), "shape"),
    ],
)
def test_what_is_wrong_is_named(name, value, word):
    with pytest.raises(CongraspError, match=word):
        _check(_changed(name, value))


@pytest.mark.parametrize(
    ("entry", "value"), [("schema", "other"), ("sequence", "0"), ("version", None), ("steps", 9), ("actor", 3)]
)
def test_metadata_is_checked(entry, value):
    message = rollout()
    with pytest.raises(CongraspError, match=entry):
        _check(dataclasses.replace(message, meta={**message.meta, entry: value}))


def test_bundles_must_be_finite():
    validate_bundle(bundle(1))
    with pytest.raises(CongraspError, match="not finite"):
        validate_bundle(Message({"actor/w": np.array([np.nan], np.float32)}, bundle(1).meta))
