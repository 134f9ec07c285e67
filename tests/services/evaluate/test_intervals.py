"""Intervals of rates, against numbers worked out by hand."""

import numpy as np
import pytest

from congrasp.services.evaluate.intervals import clustered, independent_episodes, wilson


def test_wilson_interval():
    # n = 10, p = 0.8, z = 1.96: centre (0.8 + 0.19207) / 1.38415, half width 1.96 sqrt(0.016 + 0.0096036) / 1.38415.
    assert wilson(0.8, 10) == pytest.approx((0.49016, 0.94332), abs=1e-5)
    # No success: 0 to z^2 / (n + z^2).
    assert wilson(0.0, 10) == pytest.approx((0.0, 3.84146 / 13.84146), abs=1e-5)
    assert wilson(1.0, 1000) == pytest.approx((1000 / 1003.84146, 1.0), abs=1e-6)
    assert wilson(0.0, 0) == (0.0, 1.0)


def test_clusters_count_by_the_design_effect():
    """By hand: rates 1, 1/2, 1/2 and 0 of four clusters of four, p = 1/2, sums off the mean 2, 0, 0 and -2.

    The robust variance is 4/3 * 8 / 16^2 = 1/24, that of 16 independent episodes 1/64: the design effect is 8/3.
    """
    outcomes = np.array([1, 1, 1, 1, 1, 0, 1, 0, 0, 1, 0, 1, 0, 0, 0, 0], bool)
    clusters = np.repeat([7, 3, 5, 1], 4)
    assert independent_episodes(outcomes, clusters) == pytest.approx(6.0)
    # n = 6, p = 1/2: half width 1.96 sqrt(1/24 + 0.026677) / 1.640243.
    assert clustered(outcomes, clusters) == pytest.approx((0.18761, 0.81239), abs=1e-4)


def test_an_interval_is_never_narrower_than_that_of_independent_episodes():
    alternating, clusters = np.tile([1, 0], 8), np.repeat(np.arange(8), 2)
    assert independent_episodes(alternating, clusters) == 16.0
    assert independent_episodes(alternating, np.arange(16)) == 15.0  # G / (G - 1), as of a sample's variance


def test_clusters_that_end_alike_count_once():
    assert independent_episodes(np.ones(20, bool), np.repeat(np.arange(5), 4)) == 5.0
    assert clustered(np.ones(20, bool), np.repeat(np.arange(5), 4)) == wilson(1.0, 5.0)
    assert independent_episodes(np.array([1, 0, 1, 1]), np.zeros(4)) == 4.0, "one object alone"
