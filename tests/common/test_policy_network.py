import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from congrasp.common.config import NetworkConfig
from congrasp.common.errors import CongraspError
from congrasp.common.policy import network

LAYOUT = (
    ("state", 7),
    ("heading", 3),
    ("affordance", 5),
    ("pose_finger", 4),
    ("pose_wrist", 2),
    ("trajectory", 6),
    ("mask", 4),
)
MASKS = ("affordance", "pose_finger", "pose_wrist", "trajectory")
SIZE = sum(size for _, size in LAYOUT)
ACTIONS = 3
CONFIG = NetworkConfig(hidden=(16, 8), encoder=4, initial_std=0.6)
mean_of = jax.jit(lambda params, x: network.policy(params, LAYOUT, x)[0])
value_of = jax.jit(lambda params, x, *inputs: network.value(params, LAYOUT, x, *inputs))


@pytest.fixture(scope="module")
def params():
    return network.init(0, LAYOUT, ACTIONS, CONFIG)


def observations(mask: tuple[int, ...], seed: int = 0) -> np.ndarray:
    x = np.random.default_rng(seed).normal(size=(6, SIZE)).astype(np.float32)
    x[:, -len(MASKS) :] = mask
    return x


def test_sizes_come_from_the_configuration(params):
    actor = params["actor"]["network"]
    assert actor["affordance"]["kernel"].shape == (5, 4)
    assert actor["trunk_0"]["kernel"].shape == (7 + 3 + 4 + 4 * 4, 16)
    assert actor["output"]["kernel"].shape == (8, ACTIONS)
    assert params["critic"]["output"]["kernel"].shape == (8, 1)
    np.testing.assert_allclose(np.exp(params["actor"]["log_std"]), 0.6, rtol=1e-6)


def test_weights_start_orthogonal(params):
    kernel = np.asarray(params["critic"]["trunk_1"]["kernel"])
    np.testing.assert_allclose(kernel.T @ kernel, 2.0 * np.eye(8), atol=1e-5)


def test_leading_axes_are_free(params):
    x = observations((1, 0, 1, 0))
    stacked = mean_of(params, x.reshape(2, 3, SIZE)).reshape(6, ACTIONS)
    np.testing.assert_allclose(stacked, mean_of(params, x), rtol=1e-5, atol=1e-7)
    assert value_of(params, x.reshape(2, 3, SIZE)).shape == (2, 3)


@pytest.mark.parametrize("mask", list(itertools.product((0, 1), repeat=4)))
def test_a_block_matters_exactly_while_its_bit_is_set(params, mask):
    # Biases that are not zero: an encoder's output is then not zero by itself for a zero block.
    params = jax.tree.map(lambda leaf: leaf + 0.1, params)
    x = observations(mask)
    base = mean_of(params, x), value_of(params, x)
    start = 0
    for name, size in LAYOUT[:-1]:
        changed = x.copy()
        changed[:, start : start + size] += 1.0
        start += size
        other = mean_of(params, changed), value_of(params, changed)
        active = name not in MASKS or mask[MASKS.index(name)]
        for before, after in zip(base, other, strict=True):
            assert bool(jnp.any(before != after)) == bool(active)


def test_gaussian_against_scipy():
    rng = np.random.default_rng(1)
    mean, log_std, action = rng.normal(size=(5, 4)), rng.normal(size=4) * 0.3, rng.normal(size=(5, 4))
    expected = scipy.stats.norm.logpdf(action, mean, np.exp(log_std)).sum(-1)
    np.testing.assert_allclose(network.log_probability(mean, log_std, action), expected, rtol=1e-5)
    np.testing.assert_allclose(
        network.entropy(log_std), scipy.stats.norm.entropy(scale=np.exp(log_std)).sum(), rtol=1e-5
    )


def test_kl_divergence_by_hand():
    # One dimension: KL(N(0,1) || N(1,2^2)) = ln 2 + (1 + 1)/8 - 1/2.
    kl = network.kl_divergence(jnp.zeros((1, 1)), jnp.zeros(1), jnp.ones((1, 1)), jnp.log(jnp.array([2.0])))
    np.testing.assert_allclose(kl, [np.log(2.0) + 0.25 - 0.5], rtol=1e-6)


def test_samples_have_the_gaussians_moments():
    mean, log_std = jnp.broadcast_to(jnp.array([1.0, -2.0]), (40_000, 2)), jnp.log(jnp.array([0.5, 0.1]))
    draws = np.asarray(network.sample(jax.random.PRNGKey(3), mean, log_std))
    np.testing.assert_allclose(draws.mean(0), [1.0, -2.0], atol=4 * 0.5 / np.sqrt(40_000))
    np.testing.assert_allclose(draws.std(0), [0.5, 0.1], rtol=0.02)


@pytest.mark.parametrize("layout", [LAYOUT[:-1], (*LAYOUT[:-1], ("mask", 5)), (("extra", 1), *LAYOUT), LAYOUT[1:]])
def test_foreign_layouts_are_refused(layout):
    with pytest.raises(CongraspError, match="layout"):
        network.init(0, layout, ACTIONS, CONFIG)


def test_privileged_inputs_reach_the_critic_alone(params):
    wide = network.init(0, LAYOUT, ACTIONS, CONFIG, 3)
    jax.tree.map(np.testing.assert_array_equal, wide["actor"], params["actor"])
    x, inputs = np.ones((2, SIZE), np.float32), np.zeros((2, 3), np.float32)
    inputs[1, 2] = 1.0
    assert len(wide["critic"]["trunk_0"]["kernel"]) == len(params["critic"]["trunk_0"]["kernel"]) + 3
    first, second = value_of(wide, x, inputs)
    assert first != second


def test_new_inputs_leave_results_unchanged(params):
    rng = np.random.default_rng(0)
    x, inputs = rng.normal(size=(5, SIZE)).astype(np.float32), rng.normal(size=(5, 3)).astype(np.float32)
    states = np.arange(dict(LAYOUT)["state"])
    wide = network.with_inputs(params, states, np.full(3, -1))
    np.testing.assert_allclose(value_of(wide, x, inputs), value_of(params, x), rtol=1e-5)
    back = network.with_inputs(wide, states, np.arange(0))
    jax.tree.map(np.testing.assert_array_equal, back, jax.device_get(params))
    swapped = network.with_inputs(wide, np.array([1, -1, 0, *states[2:]]), np.array([2, -1, 0]))
    wider = np.concatenate([x[:, 1:2], rng.normal(size=(5, 1)), x[:, :1], x[:, 2:]], -1).astype(np.float32)
    layout = (("state", len(states) + 1), *LAYOUT[1:])
    means = [network.policy(tree, *given)[0] for tree, given in ((params, (LAYOUT, x)), (swapped, (layout, wider)))]
    np.testing.assert_allclose(*means, rtol=1e-5, atol=1e-7)
