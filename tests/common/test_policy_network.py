"""Networks of policies, and the statistics that normalise their inputs."""

import itertools

import hypothesis
import hypothesis.extra.numpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from hypothesis import strategies as st

from congrasp.common.config import NetworkConfig
from congrasp.common.errors import CongraspError
from congrasp.common.policy import network, normalizer
from congrasp.common.policy.normalizer import Statistics

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
ALWAYS = 7 + 3  # inputs that no mask turns off
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
    mean = rng.normal(size=(5, 4))
    log_std = rng.normal(size=4) * 0.3
    action = rng.normal(size=(5, 4))
    expected = scipy.stats.norm.logpdf(action, mean, np.exp(log_std)).sum(-1)
    np.testing.assert_allclose(network.log_probability(mean, log_std, action), expected, rtol=1e-5)
    np.testing.assert_allclose(
        network.entropy(log_std), scipy.stats.norm.entropy(scale=np.exp(log_std)).sum(), rtol=1e-5
    )


def test_kl_divergence_by_hand():
    # One dimension: KL(N(0,1) || N(1,2^2)) = ln 2 + (1 + 1)/8 - 1/2.
    kl = network.kl_divergence(
        jnp.zeros((1, 1)), jnp.zeros(1), jnp.ones((1, 1)), jnp.log(jnp.array([2.0]))
    )
    np.testing.assert_allclose(kl, [np.log(2.0) + 0.25 - 0.5], rtol=1e-6)


def test_samples_have_the_gaussians_moments():
    mean = jnp.broadcast_to(jnp.array([1.0, -2.0]), (40_000, 2))
    log_std = jnp.log(jnp.array([0.5, 0.1]))
    draws = np.asarray(network.sample(jax.random.PRNGKey(3), mean, log_std))
    np.testing.assert_allclose(draws.mean(0), [1.0, -2.0], atol=4 * 0.5 / np.sqrt(40_000))
    np.testing.assert_allclose(draws.std(0), [0.5, 0.1], rtol=0.02)


@pytest.mark.parametrize(
    "layout", [LAYOUT[:-1], (*LAYOUT[:-1], ("mask", 5)), (("extra", 1), *LAYOUT), LAYOUT[1:]]
)
def test_foreign_layouts_are_refused(layout):
    with pytest.raises(CongraspError, match="layout"):
        network.init(0, layout, ACTIONS, CONFIG)


def test_privileged_inputs_reach_the_critic_alone(params):
    wide = network.init(0, LAYOUT, ACTIONS, CONFIG, 3)
    jax.tree.map(np.testing.assert_array_equal, wide["actor"], params["actor"])
    x = np.ones((2, SIZE), np.float32)
    inputs = np.zeros((2, 3), np.float32)
    inputs[1, 2] = 1.0
    assert (
        len(wide["critic"]["trunk_0"]["kernel"]) == len(params["critic"]["trunk_0"]["kernel"]) + 3
    )
    first, second = value_of(wide, x, inputs)
    assert first != second


def test_new_inputs_leave_results_unchanged(params):
    rng = np.random.default_rng(0)
    x = rng.normal(size=(5, SIZE)).astype(np.float32)
    inputs = rng.normal(size=(5, 3)).astype(np.float32)
    states = np.arange(dict(LAYOUT)["state"])
    wide = network.with_inputs(params, states, np.full(3, -1))
    np.testing.assert_allclose(value_of(wide, x, inputs), value_of(params, x), rtol=1e-5)
    back = network.with_inputs(wide, states, np.arange(0))
    jax.tree.map(np.testing.assert_array_equal, back, jax.device_get(params))
    swapped = network.with_inputs(wide, np.array([1, -1, 0, *states[2:]]), np.array([2, -1, 0]))
    wider = np.concatenate([x[:, 1:2], rng.normal(size=(5, 1)), x[:, :1], x[:, 2:]], -1).astype(
        np.float32
    )
    layout = (("state", len(states) + 1), *LAYOUT[1:])
    means = [
        network.policy(tree, *arguments)[0]
        for tree, arguments in ((params, (LAYOUT, x)), (swapped, (layout, wider)))
    ]
    np.testing.assert_allclose(*means, rtol=1e-5, atol=1e-7)


# --- normalisers ---


def exact(samples: np.ndarray) -> Statistics:
    samples = np.asarray(samples, np.float64)
    return Statistics(np.float64(len(samples)), samples.mean(0), samples.var(0) * len(samples))


def test_moments_by_hand():
    # 1, 2, 3, 6: mean 3, squared deviations 4 + 1 + 0 + 9.
    count, mean, m2 = normalizer.moments(jnp.array([[1.0, 2.0], [3.0, 6.0]]))
    assert count == 4.0
    assert mean == 3.0
    assert m2 == 14.0


def test_moments_of_half_precision_far_from_zero():
    samples = (1000.0 + np.random.default_rng(0).normal(size=(75, 400, 3)) * 0.5).astype(np.float32)
    got = normalizer.moments(jnp.asarray(samples), event_axes=1)
    want = exact(samples.reshape(-1, 3))
    np.testing.assert_allclose(got.mean, want.mean, rtol=1e-7)
    np.testing.assert_allclose(got.m2, want.m2, rtol=1e-4)


@hypothesis.settings(max_examples=60, deadline=None)
@hypothesis.given(
    samples=hypothesis.extra.numpy.arrays(
        np.float64, st.tuples(st.integers(2, 40), st.just(3)), elements=st.floats(-1e3, 1e3)
    ),
    cuts=st.lists(st.integers(0, 40), max_size=4),
)
def test_merging_any_partition_gives_the_whole(samples, cuts):
    edges = [0, *sorted(min(cut, len(samples)) for cut in cuts), len(samples)]
    parts = [samples[a:b] for a, b in itertools.pairwise(edges) if b > a]
    merged = normalizer.merge(*(exact(part) for part in parts))
    one_by_one = normalizer.empty((3,))
    for part in parts:
        one_by_one = normalizer.merge(one_by_one, exact(part))
    of_all = exact(samples)
    for got in (merged, one_by_one):
        assert got.count == of_all.count
        np.testing.assert_allclose(got.mean, of_all.mean, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(got.m2, of_all.m2, rtol=1e-9, atol=1e-7)


def test_merging_ranks_in_order_gives_every_rank_the_same_bits():
    rng = np.random.default_rng(2)
    state = exact(rng.normal(size=(50, 3)))
    deltas = [
        normalizer.moments(jnp.asarray(rng.normal(size=(20, 3)), jnp.float32), 1) for _ in range(4)
    ]
    first = normalizer.merge(state, *deltas)
    second = normalizer.merge(state, *[Statistics(*d) for d in deltas])
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
    assert first.count == 50 + 4 * 20


def test_counts_stay_exact_where_float32_would_stop():
    start = Statistics(np.float64(2**31), np.zeros(1), np.full(1, 2.0**31))
    assert normalizer.merge(start, exact(np.zeros((1, 1)))).count == 2**31 + 1


def test_identity_before_anything_was_seen():
    x = np.linspace(-20, 20, SIZE, dtype=np.float32)[None]
    affine = normalizer.observation_affine(normalizer.empty((SIZE,)), LAYOUT)
    np.testing.assert_array_equal(normalizer.apply(affine, x), np.clip(x, -10, 10))


@pytest.fixture
def seen() -> np.ndarray:
    rng = np.random.default_rng(4)
    x = rng.normal(3.0, 2.0, size=(2000, SIZE))
    x[:, -4:] = rng.integers(0, 2, size=(2000, 4))
    start = ALWAYS
    for bit, name in enumerate(MASKS):
        size = dict(LAYOUT)[name]
        x[:, start : start + size] *= x[:, SIZE - 4 + bit, None]
        start += size
    return x.astype(np.float32)


def test_each_group_is_normalised_in_its_own_way(seen):
    affine = normalizer.observation_affine(exact(seen), LAYOUT)
    y = np.asarray(normalizer.apply(affine, seen))
    np.testing.assert_allclose(y[:, :ALWAYS].mean(0), 0.0, atol=1e-4)
    np.testing.assert_allclose(y[:, :ALWAYS].std(0), 1.0, rtol=1e-4)
    np.testing.assert_allclose(np.sqrt((y[:, ALWAYS:-4] ** 2).mean(0)), 1.0, rtol=1e-4)
    np.testing.assert_array_equal(y[:, ALWAYS:-4] == 0.0, seen[:, ALWAYS:-4] == 0.0)
    np.testing.assert_array_equal(y[:, -4:], seen[:, -4:])


def test_outliers_are_clipped(seen):
    affine = normalizer.observation_affine(exact(seen), LAYOUT)
    y = np.asarray(normalizer.apply(affine, np.full((1, SIZE), 1e6, np.float32)))
    assert y.max() == 10.0


def test_a_block_that_was_never_active_stays_finite():
    affine = normalizer.observation_affine(exact(np.zeros((10, SIZE))), LAYOUT)
    assert np.isfinite(normalizer.apply(affine, np.full((1, SIZE), 0.3, np.float32))).all()


def test_half_precision_observations_become_float32(seen):
    affine = normalizer.observation_affine(exact(seen), LAYOUT)
    assert normalizer.apply(affine, seen.astype(np.float16)).dtype == np.float32


def test_values_by_hand():
    # Returns -1 and 3: mean 1, standard deviation 2.
    affine = normalizer.value_affine(exact(np.array([-1.0, 3.0])))
    assert affine.shift == 1.0
    assert affine.scale == 0.5
