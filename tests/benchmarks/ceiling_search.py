"""Cross-entropy method: many independent searches side by side, each with a diagonal Gaussian.

Rubinstein, "The cross-entropy method for combinatorial and continuous optimization", 1999.
"""

from typing import NamedTuple

import numpy as np

_MEAN_SMOOTHING = 0.7
_STD_SMOOTHING = 0.4
"""Weights of the elites' mean and standard deviation against those before. The standard deviation
follows slowly: with few elites a search would otherwise stop before it reaches a distant optimum.
"""
_LEAST_STD = 0.01
"""Least standard deviation of a parameter, so that no search stops early."""


class Search(NamedTuple):
    """Distributions of C searches over D parameters."""

    mean: np.ndarray
    """(C, D)."""
    std: np.ndarray
    """(C, D)."""

    def rows(self, chosen: np.ndarray) -> "Search":
        """Selects searches by index or mask."""
        return Search(self.mean[chosen], self.std[chosen])


def begin(count: int, size: int, std: float) -> Search:
    """Returns `count` searches over `size` parameters around zero."""
    return Search(np.zeros((count, size)), np.full((count, size), std))


def candidates(search: Search, population: int, rng: np.random.Generator) -> np.ndarray:
    """Draws candidates (C, population, D); the first of each search is its mean."""
    count, size = search.mean.shape
    normal = rng.standard_normal((count, population, size))
    normal[:, 0] = 0.0
    drawn: np.ndarray = search.mean[:, None] + search.std[:, None] * normal
    return drawn


def refined(search: Search, drawn: np.ndarray, scores: np.ndarray, elites: int) -> Search:
    """Moves each search towards its best candidates.

    Args:
      search: the distributions from which the candidates were drawn.
      drawn: candidates (C, population, D).
      scores: (C, population), higher is better; a candidate without a finite score is the worst.
      elites: number of candidates that count.
    """
    finite = np.where(np.isfinite(scores), scores, -np.inf)
    order = np.argsort(-finite, axis=1)[:, :elites]
    best = np.take_along_axis(drawn, order[:, :, None], axis=1)
    mean = _MEAN_SMOOTHING * best.mean(1) + (1 - _MEAN_SMOOTHING) * search.mean
    std = _STD_SMOOTHING * best.std(1) + (1 - _STD_SMOOTHING) * search.std
    return Search(mean, np.maximum(std, _LEAST_STD))
