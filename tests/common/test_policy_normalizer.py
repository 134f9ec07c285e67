import itertools

import hypothesis
import hypothesis.extra.numpy
import hypothesis.strategies as st
import jax.numpy as jnp
import numpy as np
import pytest

from congrasp.common.policy import normalizer
from congrasp.common.policy.normalizer import Statistics

LAYOUT = (
    ("state", 2),
    ("heading", 1),
    ("affordance", 2),
    ("pose_finger", 1),
    ("pose_wrist", 1),
    ("trajectory", 1),
    ("mask", 4),
)
MASKS = ("affordance", "pose_finger", "pose_wrist", "trajectory")
SIZE = sum(size for _, size in LAYOUT)


def exact(samples: np.ndarray) -> Statistics:
    samples = np.asarray(samples, np.float64)
    return Statistics(np.float64(len(samples)), samples.mean(0), samples.var(0) * len(samples))


def test_moments_by_hand():
    # 1, 2, 3, 6: mean 3, squared deviations 4 + 1 + 0 + 9.
    count, mean, m2 = normalizer.moments(jnp.array([[1.0, 2.0], [3.0, 6.0]]))
    assert (count, mean, m2) == (4.0, 3.0, 14.0)


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
    whole = exact(samples)
    for got in (merged, one_by_one):
        assert got.count == whole.count
        np.testing.assert_allclose(got.mean, whole.mean, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(got.m2, whole.m2, rtol=1e-9, atol=1e-7)


def test_merging_ranks_in_order_gives_every_rank_the_same_bits():
    rng = np.random.default_rng(2)
    state = exact(rng.normal(size=(50, 3)))
    deltas = [normalizer.moments(jnp.asarray(rng.normal(size=(20, 3)), jnp.float32), 1) for _ in range(4)]
    first, second = normalizer.merge(state, *deltas), normalizer.merge(state, *[Statistics(*d) for d in deltas])
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
def observations() -> np.ndarray:
    rng = np.random.default_rng(4)
    x = rng.normal(3.0, 2.0, size=(2000, SIZE))
    x[:, -4:] = rng.integers(0, 2, size=(2000, 4))
    start = 3
    for bit, name in enumerate(MASKS):
        size = dict(LAYOUT)[name]
        x[:, start : start + size] *= x[:, SIZE - 4 + bit, None]
        start += size
    return x.astype(np.float32)


def test_each_group_is_normalised_in_its_own_way(observations):
    affine = normalizer.observation_affine(exact(observations), LAYOUT)
    y = np.asarray(normalizer.apply(affine, observations))
    np.testing.assert_allclose(y[:, :3].mean(0), 0.0, atol=1e-4)
    np.testing.assert_allclose(y[:, :3].std(0), 1.0, rtol=1e-4)
    np.testing.assert_allclose(np.sqrt((y[:, 3:-4] ** 2).mean(0)), 1.0, rtol=1e-4)
    np.testing.assert_array_equal(y[:, 3:-4] == 0.0, observations[:, 3:-4] == 0.0)
    np.testing.assert_array_equal(y[:, -4:], observations[:, -4:])


def test_outliers_are_clipped(observations):
    affine = normalizer.observation_affine(exact(observations), LAYOUT)
    y = np.asarray(normalizer.apply(affine, np.full((1, SIZE), 1e6, np.float32)))
    assert y.max() == 10.0


def test_a_block_that_was_never_active_stays_finite():
    affine = normalizer.observation_affine(exact(np.zeros((10, SIZE))), LAYOUT)
    assert np.isfinite(normalizer.apply(affine, np.full((1, SIZE), 0.3, np.float32))).all()


def test_half_precision_observations_become_float32(observations):
    affine = normalizer.observation_affine(exact(observations), LAYOUT)
    assert normalizer.apply(affine, observations.astype(np.float16)).dtype == np.float32


def test_values_by_hand():
    # Returns -1 and 3: mean 1, standard deviation 2.
    affine = normalizer.value_affine(exact(np.array([-1.0, 3.0])))
    assert (affine.shift, affine.scale) == (1.0, 0.5)
