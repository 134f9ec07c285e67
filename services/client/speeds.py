"""Velocities of joints that report positions alone; needs only NumPy."""

import math

import numpy as np

from congrasp.services.client.arrays import bounded

_SHORTEST_S = 1e-6  # of the time between two measurements; quotients of less are too large


class Speeds:
    """Velocities of J joints, from successive measured positions."""

    def __init__(self, most: np.ndarray, lasting: float):
        """Starts without a measurement.

        Args:
          most: (J,) largest plausible speed, rad/s or m/s.
          lasting: seconds for which a speed counts after the change of the position; measurements
            may arrive at a lower rate than steps.
        """
        self._most = most
        self._lasting = lasting
        self._position = np.full(len(most), np.nan)
        self._changed_at = np.full(len(most), -math.inf)
        self._speed = np.zeros(len(most))

    def of(self, position: np.ndarray, now: float) -> np.ndarray:
        """Speeds (J,) at a measurement: each joint's displacement since its last change over the
        time; zero at first.

        Args:
          position: (J,) measured; the last three are angles modulo full turns.
          now: s.
        """
        elapsed = now - self._changed_at
        way = position - self._position
        way[-3:] = np.remainder(way[-3:] + np.pi, 2 * np.pi) - np.pi
        is_measurable = np.isfinite(way) & (elapsed > 0.0)
        changed = position != self._position  # also where it is not finite
        measured = np.where(is_measurable, way / np.maximum(elapsed, _SHORTEST_S), 0.0)
        lasting = np.where(elapsed <= self._lasting, self._speed, 0.0)
        self._speed = bounded(np.where(changed, measured, lasting), self._most)
        self._position = position
        self._changed_at = np.where(changed, now, self._changed_at)
        return self._speed
