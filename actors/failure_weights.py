"""Sampling weights of objects by the outcomes of their episodes."""

from collections.abc import Sequence

import numpy as np

_MEMORY_EPISODES = 50.0
"""Average number of episodes of each object after which an outcome's weight decays by a factor
e.
"""
_PRIOR_EPISODES = 5.0
"""Number of episodes for which the rate of the larger group counts, in addition to those of the
object or family.
"""
_LARGEST_FACTOR = 2.0
"""Largest factor on an object's weight, and the inverse of the smallest one."""


class FailureWeights:
    """Counts of the episodes of N objects, and the sampling weights that follow from them.

    With n episodes of an object of which f failed, both forgotten exponentially, its failure rate
    is estimated as p = (f + k p_family) / (n + k), k = 5, where the family's rate is regularised in
    the same way towards that of all objects. With its variance v = p (1 - p) and the mean of all
    objects, m, the weight is (v + m) / 2m, between a half and two: most is learnt where success is
    most uncertain.
    """

    def __init__(self, weight: np.ndarray, families: Sequence[str]):
        """Starts without episodes.

        Args:
          weight: (N,) weights while all objects have the same failure rate.
          families: families of the N objects.
        """
        self._weight = np.asarray(weight, float)
        self._families, self._family = np.unique(np.asarray(families), return_inverse=True)
        self._episodes = np.zeros(len(self._weight))
        self._failures = np.zeros(len(self._weight))

    def add(self, objects: np.ndarray, success: np.ndarray) -> None:
        """Counts E episodes with these objects (E,) int, and their success (E,)."""
        index = np.asarray(objects, int)
        decay = np.exp(-len(objects) / (_MEMORY_EPISODES * len(self._weight)))
        self._episodes *= decay
        self._failures *= decay
        np.add.at(self._episodes, index, 1.0)
        np.add.at(self._failures, index, 1.0 - np.asarray(success))

    def metrics(self) -> dict[str, float]:
        """Failure rates by family, and the largest and least factor on an object's weight."""
        metrics = {}
        for name, rate in zip(self._families, self._family_rates, strict=True):
            metrics[f"failure/{name}"] = float(rate)
        factors = self._factors
        metrics["weight_most"] = float(factors.max())
        metrics["weight_least"] = float(factors.min())
        return metrics

    @property
    def weights(self) -> np.ndarray:
        """Weights (N,) float32."""
        return (self._weight * self._factors).astype(np.float32)

    @property
    def _factors(self) -> np.ndarray:
        """Factors (N,) on the weights."""
        failures = self._failures + _PRIOR_EPISODES * self._family_rates[self._family]
        rates = failures / (self._episodes + _PRIOR_EPISODES)
        variance = rates * (1 - rates)
        mean = variance.mean()
        if mean == 0.0:
            return np.ones(len(self._weight))
        return np.clip((variance + mean) / (2 * mean), 1 / _LARGEST_FACTOR, _LARGEST_FACTOR)

    @property
    def _family_rates(self) -> np.ndarray:
        """Failure rates (families,); zero before any episode."""
        episodes = np.bincount(self._family, self._episodes)
        failures = np.bincount(self._family, self._failures)
        return (failures + _PRIOR_EPISODES * self._rate) / (episodes + _PRIOR_EPISODES)

    @property
    def _rate(self) -> float:
        """Failure rate of all objects."""
        return float(self._failures.sum() / max(self._episodes.sum(), 1.0))
