"""How often objects are drawn by how often they fail: numbers by hand, and bounds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from congrasp.actors.process.failure_weights import FailureWeights


def test_weights_by_hand():
    """Two mugs and a box, four episodes each: 4, 0 and 0 failures."""
    found = FailureWeights(np.array([1.0, 1.0, 3.0]), ["mug", "mug", "box"])
    np.testing.assert_array_equal(found.weights, [1, 1, 3])
    found.add(np.repeat([0, 1, 2], 4), np.repeat([0.0, 1.0, 1.0], 4))
    # Nothing was counted before, so that nothing is forgotten. All: 4/12. Mugs: (4 + 5/3) / (8 + 5), boxes: (5/3) / 9.
    mugs, boxes = 17 / 39, 5 / 27
    rates = np.array([(4 + 5 * mugs) / 9, 5 * mugs / 9, 5 * boxes / 9])
    variance = rates * (1 - rates)
    factors = (variance + variance.mean()) / (2 * variance.mean())
    np.testing.assert_allclose(found.weights, [1.0, 1.0, 3.0] * factors, rtol=1e-6)
    assert found.metrics()["failure/mug"] == pytest.approx(mugs)
    assert found.metrics()["failure/box"] == pytest.approx(boxes)


def test_old_outcomes_are_forgotten():
    """After 50 episodes of each object what came before counts e times less."""
    found = FailureWeights(np.ones(2), ["box", "mug"])
    found.add(np.zeros(100, int), np.zeros(100))
    assert found.metrics()["failure/box"] == pytest.approx(1.0)
    found.add(np.zeros(100, int), np.ones(100))
    old = 100 * np.exp(-1)
    mean = old / (100 + old)
    assert found.metrics()["failure/box"] == pytest.approx((old + 5 * mean) / (100 + old + 5))


@given(st.lists(st.tuples(st.integers(0, 4), st.booleans()), max_size=200))
def test_weights_stay_within_a_factor_of_four_and_follow_uncertainty(episodes):
    found = FailureWeights(np.ones(5), ["a", "a", "a", "b", "b"])
    index = np.array([i for i, _ in episodes], int)
    success = np.array([s for _, s in episodes], float)
    found.add(index, success)
    weights = found.weights
    assert weights.min() >= 0.5 and weights.max() <= 2.0
