"""Sampling weights of an actor's objects, from the failure rates of its episodes."""

from collections.abc import Sequence

import numpy as np

_MEMORY = 50.0
"""Average number of episodes of each object after which an outcome's weight decays by a factor e."""
_PRIOR = 5.0
"""Number of episodes for which the rate of the larger group counts, in addition to those of the object or family."""
_BOUND = 2.0
"""Largest factor on an object's weight, and the inverse of the smallest one."""


class FailureWeights:
    """Counts of the episodes of N objects, and the sampling weights that follow from them.

    With n episodes of an object of which f failed, both forgotten exponentially, its failure rate is estimated as p =
    (f + k p_family) / (n + k), k = 5, where the family's rate is regularised in the same way towards that of all
    objects. With its variance v = p (1 - p) and the mean of all objects, m, the weight is (v + m) / 2m, between a half
    and two: most is learnt where success is most uncertain.
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
        kept = np.exp(-len(objects) / (_MEMORY * len(self._weight)))
        for total, outcome in ((self._episodes, np.ones(len(objects))), (self._failures, 1.0 - np.asarray(success))):
            total *= kept
            np.add.at(total, np.asarray(objects, int), outcome)

    def metrics(self) -> dict[str, float]:
        """Failure rates by family, and the largest and least factor on an object's weight."""
        factor = self._factors
        return {
            **{f"failure/{name}": float(rate) for name, rate in zip(self._families, self._family_rates, strict=True)},
            "weight_most": float(factor.max()),
            "weight_least": float(factor.min()),
        }

    @property
    def weights(self) -> np.ndarray:
        """Weights (N,) float32."""
        return (self._weight * self._factors).astype(np.float32)

    @property
    def _factors(self) -> np.ndarray:
        """Factors (N,) on the weights."""
        rates = (self._failures + _PRIOR * self._family_rates[self._family]) / (self._episodes + _PRIOR)
        variance = rates * (1 - rates)
        mean = variance.mean()
        if mean == 0.0:
            return np.ones(len(self._weight))
        return np.clip((variance + mean) / (2 * mean), 1 / _BOUND, _BOUND)

    @property
    def _family_rates(self) -> np.ndarray:
        """Failure rates (families,); zero before any episode."""
        episodes, failures = (np.bincount(self._family, total) for total in (self._episodes, self._failures))
        return (failures + _PRIOR * self._rate) / (episodes + _PRIOR)

    @property
    def _rate(self) -> float:
        """Failure rate of all objects."""
        return float(self._failures.sum() / max(self._episodes.sum(), 1.0))
