"""Intervals of rates of clustered episodes, and standard errors of means."""

import math

import numpy as np

NORMAL_95 = 1.959964
"""Quantile of the normal distribution for two-sided 95 % intervals."""


def wilson(rate: float, count: float) -> tuple[float, float]:
    """95 % Wilson score interval of a rate.

    Args:
      rate: share of successes.
      count: number of independent episodes, not necessarily an integer.
    """
    if count <= 0:
        return 0.0, 1.0
    z2 = NORMAL_95**2
    center = (rate + z2 / (2 * count)) / (1 + z2 / count)
    half = NORMAL_95 / (1 + z2 / count) * math.sqrt(rate * (1 - rate) / count + z2 / (4 * count**2))
    return max(center - half, 0.0), min(center + half, 1.0)


def independent_episodes(outcomes: np.ndarray, clusters: np.ndarray) -> float:
    """Number of independent episodes with the same variance of the rate as these clustered ones.

    It is the number of episodes over the design effect (Kish, Survey Sampling, 1965): the
    cluster-robust variance of the rate, G / (G - 1) sum_g (sum_{i in g} (y_i - p))^2 / n^2, over p
    (1 - p) / n. The design effect is at least 1. If all episodes have the same outcome it cannot be
    estimated, and each cluster counts once. Episodes of a single cluster count as independent, and
    the rate is that of the cluster.

    Args:
      outcomes: (E,) bool.
      clusters: (E,) label of the cluster of each episode.
    """
    count = len(outcomes)
    _, members = np.unique(clusters, return_inverse=True)
    number_of_clusters = int(members.max(initial=-1)) + 1
    if number_of_clusters <= 1:
        return float(count)
    rate = float(np.mean(outcomes))
    if rate in (0.0, 1.0):
        return float(number_of_clusters)
    deviations = np.bincount(members, np.asarray(outcomes, float) - rate)
    correction = number_of_clusters / (number_of_clusters - 1)
    robust_variance = correction * float(deviations @ deviations) / count**2
    design_effect = robust_variance * count / (rate * (1 - rate))
    return count / max(design_effect, 1.0)


def clustered_interval(outcomes: np.ndarray, clusters: np.ndarray) -> tuple[float, float]:
    """95 % interval of the rate of outcomes (E,) in clusters (E,): Wilson's, with
    `independent_episodes`.
    """
    rate = float(np.mean(outcomes)) if len(outcomes) else 0.0
    return wilson(rate, independent_episodes(outcomes, clusters))


def standard_error(values: np.ndarray) -> float:
    """Standard error of the mean of independent values (E,), at least two."""
    return float(values.std(ddof=1) / np.sqrt(len(values)))
