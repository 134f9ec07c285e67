"""Draws from uniform numbers: their shares, their edges, and that no name disturbs another."""

import jax
import numpy as np
import pytest

from congrasp.common import chance

MANY = 20_000
UNIFORM = np.random.default_rng(0).uniform(size=MANY).astype(np.float32)
LAST = np.float32(1 - 2.0**-24)


def pvalue(numbers, distribution):
    """Of the test of Kolmogorov and Smirnov."""
    from scipy import stats  # takes seconds in every worker

    return stats.kstest(np.asarray(numbers), distribution).pvalue


def test_numbers_of_a_name_depend_on_no_other_name_and_on_no_wider_one():
    key = jax.random.key(3)
    alone = chance.uniforms(key, {"a": 2}, 5)
    with_others = chance.uniforms(key, {"b": 7, "a": 2, "c": 1}, 5)
    assert alone["a"].shape == (5, 2)
    assert with_others["b"].shape == (5, 7)
    np.testing.assert_array_equal(alone["a"], with_others["a"])
    numbers = np.concatenate([np.ravel(part) for part in with_others.values()])
    assert len(set(numbers.tolist())) == numbers.size
    assert numbers.min() >= 0
    assert numbers.max() < 1


def test_numbers_are_uniform():
    numbers = np.asarray(chance.uniforms(jax.random.key(0), {"a": 3}, MANY)["a"])
    for column in numbers.T:
        assert pvalue(column, "uniform") > 0.01
    assert np.abs(np.corrcoef(numbers.T) - np.eye(3)).max() < 0.03


def test_normal_numbers_are_finite_at_the_edges_and_follow_the_inverse_distribution():
    np.testing.assert_allclose(chance.normal(np.float32([0.5, 0.84134475])), [0.0, 1.0], atol=1e-5)
    assert np.isfinite(chance.normal(np.array([0.0, LAST], np.float32))).all()
    assert pvalue(chance.normal(UNIFORM), "norm") > 0.01


def test_indices_are_equally_likely_and_below_the_count():
    assert np.bincount(chance.index(UNIFORM, 7)) / MANY == pytest.approx(
        np.full(7, 1 / 7), abs=0.01
    )
    assert chance.index(np.float32([0.0, LAST]), 300).tolist() == [0, 299]


def test_weighted_indices_have_their_shares_and_skip_zeros():
    """By hand: weights 0, 1, 0, 3: a quarter and three quarters."""
    indices = np.asarray(chance.weighted(UNIFORM, np.float32([0, 1, 0, 3])))
    assert np.bincount(indices, minlength=4) / MANY == pytest.approx([0, 0.25, 0, 0.75], abs=0.01)
    assert chance.weighted(np.float32([0.0, LAST]), np.float32([0, 1, 0, 3])).tolist() == [1, 3]


def test_one_of_the_allowed_is_chosen():
    allowed = np.tile([False, True, False, True, True], (MANY, 1))
    assert np.bincount(chance.among(UNIFORM, allowed)) / MANY == pytest.approx(
        [0, 1 / 3, 0, 1 / 3, 1 / 3], abs=0.01
    )
    assert chance.among(np.float32([0.7]), np.zeros((1, 4), bool)).tolist() == [0]
