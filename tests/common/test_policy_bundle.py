import dataclasses

import jax
import numpy as np
import pytest
import safetensors.numpy

from congrasp.common.config import NetworkConfig, RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy import network, normalizer
from congrasp.common.policy.bundle import PolicyBundle, PolicySpec
from congrasp.common.policy.normalizer import Statistics
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.observation import fields
from congrasp.common.wire.codec import Message, decode, encode
from tests.compiled import program_count

LAYOUT = (
    ("state", 3),
    ("heading", 2),
    ("affordance", 2),
    ("pose_finger", 2),
    ("pose_wrist", 2),
    ("trajectory", 2),
    ("mask", 4),
)
SPEC = PolicySpec("claw", LAYOUT, 2, NetworkConfig(hidden=(8, 4), encoder=3))


@pytest.fixture
def bundle() -> PolicyBundle:
    rng = np.random.default_rng(0)
    return PolicyBundle(
        spec=SPEC,
        task=TaskConfig(hand="claw", mass_range=(0.8, 1.2)),
        params=network.init(5, LAYOUT, 2, SPEC.network),
        observation=Statistics(np.float64(2**40 + 1), rng.normal(size=17), rng.random(17) * 2**40),
        value=Statistics(np.float64(7), np.float64(-3.0), np.float64(28.0)),
        version=12,
        run_id="ab12",
        transitions=3_000_000_000,
    )


def test_file_keeps_everything_exactly(bundle, tmp_path):
    path = tmp_path / "policy.safetensors"
    bundles.save(bundle, path)
    loaded = bundles.load(path)
    assert loaded.spec == bundle.spec
    assert loaded.task == bundle.task
    assert loaded.version == 12
    assert loaded.run_id == "ab12"
    assert loaded.transitions == 3_000_000_000
    for name in ("params", "observation", "value"):
        jax.tree.map(
            np.testing.assert_array_equal,
            getattr(loaded, name),
            jax.device_get(getattr(bundle, name)),
        )
    assert loaded.observation.count == 2**40 + 1
    assert [p.name for p in tmp_path.iterdir()] == ["policy.safetensors"]


def test_policy_without_critic_acts_as_before(bundle, tmp_path):
    path = tmp_path / "policy.safetensors"
    bundles.save(bundles.without_critic(bundle), path)
    names = set(safetensors.numpy.load_file(path))
    assert {name.split("/")[0] for name in names} == {"actor", "observation"}
    loaded = bundles.load(path)
    assert bundle.has_critic
    assert not loaded.has_critic
    assert loaded.actor_sha256 == bundle.actor_sha256
    assert loaded.spec == bundle.spec
    assert loaded.task == bundle.task
    assert loaded.version == 12
    jax.tree.map(
        np.testing.assert_array_equal,
        loaded.inference_parameters,
        jax.device_get(bundle.inference_parameters),
    )


def test_policy_with_a_part_of_a_critic_is_refused(bundle):
    less = bundles.without_critic(bundle).to_message()
    for name in ("critic/output/bias", "value/count"):
        part = Message({**less.arrays, name: np.zeros(1, np.float32)}, less.meta)
        with pytest.raises(CongraspError, match=r"p\.safetensors"):
            PolicyBundle.from_message(part, "p.safetensors")


def test_new_critic_is_that_of_an_untrained_policy(bundle):
    begun = bundles.with_new_critic(bundles.without_critic(bundle), 5)
    jax.tree.map(np.testing.assert_array_equal, begun.params, bundle.params)
    assert begun.value.count == 0
    assert begun.actor_sha256 == bundle.actor_sha256


def _actor_bias(bundle: PolicyBundle) -> PolicyBundle:
    params = jax.tree.map(np.array, bundle.params)
    params["actor"]["network"]["output"]["bias"][0] += 1e-6
    return dataclasses.replace(bundle, params=params)


def _mean(bundle: PolicyBundle) -> PolicyBundle:
    observation = bundle.observation
    return dataclasses.replace(bundle, observation=observation._replace(mean=observation.mean + 1))


def _hand(bundle: PolicyBundle) -> PolicyBundle:
    return dataclasses.replace(bundle, spec=dataclasses.replace(bundle.spec, hand="paw"))


@pytest.mark.parametrize("change", [_actor_bias, _mean, _hand])
def test_actor_hash_changes_with_the_actor(bundle, change):
    assert change(bundle).actor_sha256 != bundle.actor_sha256


def test_actor_hash_ignores_critic_and_version(bundle):
    params = {**bundle.params, "critic": jax.tree.map(np.zeros_like, bundle.params["critic"])}
    other = dataclasses.replace(bundle, params=params, version=13)
    assert other.actor_sha256 == bundle.actor_sha256


def test_file_is_read_by_other_programs(bundle, tmp_path):
    bundles.save(bundle, tmp_path / "policy.safetensors")
    arrays = safetensors.numpy.load_file(tmp_path / "policy.safetensors")
    np.testing.assert_array_equal(arrays["actor/log_std"], bundle.params["actor"]["log_std"])


def test_content_hash_changes_with_the_content(bundle):
    first = bundles.content_hash(encode(bundle.to_message()))
    again = bundles.content_hash(
        encode(PolicyBundle.from_message(decode(encode(bundle.to_message()))).to_message())
    )
    other = bundles.content_hash(encode(dataclasses.replace(bundle, version=13).to_message()))
    assert first == again != other


def test_message_shares_the_arrays_of_this_process(bundle):
    assert bundle.to_message().arrays["actor/log_std"] is bundle.params["actor"]["log_std"]


@pytest.mark.parametrize(
    "change",
    [
        {"hand": "paw"},
        {"action_size": 3},
        {"layout": (("state", 4), ("heading", 1), *LAYOUT[2:])},
        {"network": NetworkConfig(hidden=(8, 5), encoder=3)},
        {"network": NetworkConfig(hidden=(8, 4), encoder=4)},
    ],
)
def test_schema_changes_with_every_covered_setting(change):
    other = dataclasses.replace(SPEC, **change)
    assert other.schema != SPEC.schema
    with pytest.raises(CongraspError) as caught:
        other.require(SPEC, "mine.safetensors")
    text = str(caught.value)
    assert "\n" not in text
    assert all(
        word in text
        for word in ("mine.safetensors", "'claw'", SPEC.schema, other.hand, other.schema)
    )


def test_initial_std_is_no_part_of_the_schema():
    assert dataclasses.replace(SPEC, network=NetworkConfig((8, 4), 3, 0.9)).schema == SPEC.schema


def _without(message: Message, name: str) -> Message:
    return Message({k: v for k, v in message.arrays.items() if k != name}, message.meta)


def _with(message: Message, name: str, value: float) -> Message:
    return Message(
        {**message.arrays, name: np.full_like(message.arrays[name], value)}, message.meta
    )


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda m: Message(m.arrays, {**m.meta, "format": 1}), "format 1"),
        (lambda m: Message(m.arrays, {k: v for k, v in m.meta.items() if k != "hand"}), "hand"),
        (lambda m: Message(m.arrays, {**m.meta, "task": {"wheels": 4}}), "wheels"),
        (
            lambda m: Message(m.arrays, {**m.meta, "task": {"reward": {"force_max": "0.1"}}}),
            "reward.force_max.*'0.1'",
        ),
        (
            lambda m: Message(m.arrays, {**m.meta, "task": {"reward": {"force_max": True}}}),
            "reward.force_max.*True",
        ),
        (lambda m: Message(m.arrays, {**m.meta, "action_size": "4"}), "action_size.*'4'"),
        (lambda m: Message(m.arrays, {**m.meta, "version": True}), "version is True"),
        (lambda m: Message(m.arrays, {**m.meta, "transitions": "9"}), "transitions is '9'"),
        (lambda m: Message(m.arrays, {**m.meta, "layout": [["state", -3]]}), "layout|meta"),
        (
            lambda m: Message(m.arrays, {**m.meta, "network": {"hidden": [-8], "encoder": 3}}),
            "meta|schema",
        ),
        (lambda m: Message(m.arrays, {**m.meta, "schema": "0" * 16}), "schema"),
        (lambda m: _without(m, "critic/output/bias"), "critic/output/bias"),
        (lambda m: Message({**m.arrays, "extra": np.zeros(1)}, m.meta), "extra"),
        (
            lambda m: Message({**m.arrays, "actor/log_std": np.zeros(3, np.float32)}, m.meta),
            "actor/log_std",
        ),
        (
            lambda m: Message({**m.arrays, "actor/log_std": np.full(2, np.nan)}, m.meta),
            "actor/log_std",
        ),
        (
            lambda m: Message({**m.arrays, "actor/log_std": np.zeros(2, np.int32)}, m.meta),
            "actor/log_std",
        ),
        (
            lambda m: Message({**m.arrays, "actor/log_std": np.full(2, 1e4, np.float32)}, m.meta),
            "actor/log_std",
        ),
        (lambda m: _with(m, "observation/m2", -1.0), "observation/m2"),
        (lambda m: _with(m, "observation/count", -1.0), "observation/count"),
        (lambda m: _with(m, "critic/output/bias", 1e30), "critic/output/bias"),
        (lambda m: Message(m.arrays, {**m.meta, "version": -1}), "version"),
        (lambda m: Message(m.arrays, {**m.meta, "version": 2**70}), "version"),
        (lambda m: Message(m.arrays, {**m.meta, "transitions": -1}), "transitions"),
    ],
)
def test_a_spoilt_bundle_is_refused_in_one_line(bundle, spoil, words):
    with pytest.raises(CongraspError, match=words) as caught:
        PolicyBundle.from_message(spoil(bundle.to_message()), "p.safetensors")
    assert "p.safetensors" in str(caught.value)


def test_inference_normalises_and_returns_the_log_probability(bundle):
    raw = np.random.default_rng(1).normal(size=(5, 17)).astype(np.float16)
    raw[:, -4:] = 1.0
    affine = normalizer.observation_affine(bundle.observation, LAYOUT)
    mean, log_std = network.policy(bundle.params, LAYOUT, normalizer.apply(affine, raw))
    parameters = bundle.inference_parameters
    np.testing.assert_allclose(
        bundles.mean_action(LAYOUT, parameters, raw), mean, rtol=1e-5, atol=1e-6
    )
    action, log_probability = bundles.sample_action(LAYOUT, parameters, raw, jax.random.PRNGKey(0))
    np.testing.assert_allclose(
        log_probability, network.log_probability(mean, log_std, action), rtol=1e-4
    )
    other, _ = bundles.sample_action(LAYOUT, parameters, raw, jax.random.PRNGKey(1))
    assert not np.allclose(action, other)


def test_new_weights_do_not_compile_again(bundle):
    raw = np.zeros((3, 17), np.float32)
    bundles.mean_action(LAYOUT, bundle.inference_parameters, raw)
    compiled = program_count(bundles.mean_action)
    moved = dataclasses.replace(bundle, params=jax.tree.map(lambda x: x + 1, bundle.params))
    wire = PolicyBundle.from_message(decode(encode(moved.to_message())))
    bundles.mean_action(LAYOUT, wire.inference_parameters, raw)
    assert program_count(bundles.mean_action) == compiled


def test_spec_of_the_real_task():
    config = RunConfig()
    spec = bundles.policy_spec(config.task, config.network)
    assert spec.hand == "human"
    assert spec.action_size == 26
    network.check_layout(spec.layout)


def test_a_bundle_describes_its_critics_inputs(bundle, tmp_path):
    seen = (("mass", 1), ("observation", 4))
    statistics = Statistics(np.float64(3), np.arange(5.0), np.ones(5))
    wide = bundles.with_inputs_of(dataclasses.replace(SPEC, privileged=seen), bundle.task, bundle)
    assert wide.spec.schema == bundle.spec.schema
    assert wide.spec.privileged_size == 5
    bundles.save(dataclasses.replace(wide, privileged=statistics), tmp_path / "p")
    loaded = bundles.load(tmp_path / "p")
    assert loaded.spec.privileged == seen
    np.testing.assert_array_equal(loaded.privileged.mean, statistics.mean)
    raw = np.random.default_rng(1).normal(size=(5, 17)).astype(np.float16)
    same = [
        np.asarray(bundles.mean_action(LAYOUT, one.inference_parameters, raw))
        for one in (bundle, loaded)
    ]
    np.testing.assert_array_equal(*same)
    message = wide.to_message()
    for wrong in ([["mass", -5]], [["mass", 1 << 20]], [["mass", 4]], [["mass"]], 7):
        with pytest.raises(CongraspError, match=r"p\.safetensors"):
            PolicyBundle.from_message(
                Message(message.arrays, {**message.meta, "privileged": wrong}), "p.safetensors"
            )


def test_a_policy_that_observes_less_begins_with_the_same_actions():
    sizes = NetworkConfig(hidden=(8, 4), encoder=3)
    plain = TaskConfig(surface_normals=False)
    normals = TaskConfig(surface_normals=True)
    spec, wider = (bundles.policy_spec(task, sizes) for task in (plain, normals))
    rng = np.random.default_rng(2)
    names = []
    for field in fields(get_hand("human"), normals)["state"]:
        names += [field.name] * field.size
    is_observed = np.ones(sum(size for _, size in wider.layout), bool)
    is_observed[: len(names)] = [name not in ("normal", "height") for name in names]
    count = 1e9
    size = np.count_nonzero(is_observed)
    seen = Statistics(np.float64(count), rng.normal(size=size), count * rng.uniform(0.5, 2.0, size))
    params = network.init(5, spec.layout, spec.action_size, sizes, spec.privileged_size)
    less = PolicyBundle(spec, plain, params, seen, normalizer.empty(), 3, "ab", 4)
    more = bundles.with_inputs_of(wider, normals, less)
    raw = rng.normal(size=(6, len(is_observed))).astype(np.float32)
    before = bundles.mean_action(spec.layout, less.inference_parameters, raw[:, is_observed])
    after = bundles.mean_action(wider.layout, more.inference_parameters, raw)
    np.testing.assert_allclose(after, before, rtol=1e-4, atol=1e-6)
    batch = normalizer.moments(raw, 1)
    news = normalizer.merge(
        more.observation, batch._replace(count=np.float64(1e6), m2=batch.m2 * 1e6 / 6)
    )
    np.testing.assert_allclose(
        news.mean[~is_observed], raw[:, ~is_observed].mean(0), rtol=0.1, atol=1e-3
    )
    with pytest.raises(CongraspError, match="is for hand 'human'"):
        bundles.with_inputs_of(spec, plain, more)
