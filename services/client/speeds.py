"""Velocities of joints that report positions alone; needs only NumPy."""

import math

import numpy as np

from congrasp.services.client.arrays import bounded

_SHORTEST_S = 1e-6  # time between two measurements; a division by less gives too large a speed


class Speeds:
    """Velocities of J joints, from successive measured positions."""

    def __init__(self, most: np.ndarray, lasting: float):
        """Starts without a measurement.

        Args:
          most: (J,) largest plausible speed, rad/s or m/s.
          lasting: seconds for which a speed is kept while the position does not change, because
            measurements may arrive at a lower rate than steps; zero after that.
        """
        self._limits = most
        self._lasting_s = lasting
        self._position = np.full(len(most), np.nan)
        self._changed_at = np.full(len(most), -math.inf)
        self._speed = np.zeros(len(most))

    def of(self, position: np.ndarray, now: float) -> np.ndarray:
        """Returns the speeds (J,) at a measurement: each joint's displacement since its position
        last changed, divided by the time since then; zero at first.

        Args:
          position: (J,) measured, m or rad; the last three are angles modulo full turns.
          now: time of the measurement, s.
        """
        elapsed = now - self._changed_at
        displacement = position - self._position
        displacement[-3:] = np.remainder(displacement[-3:] + np.pi, 2 * np.pi) - np.pi
        is_measurable = np.isfinite(displacement) & (elapsed > 0.0)
        is_changed = position != self._position  # also where it is not finite
        measured = np.where(is_measurable, displacement / np.maximum(elapsed, _SHORTEST_S), 0.0)
        lasting = np.where(elapsed <= self._lasting_s, self._speed, 0.0)
        self._speed = bounded(np.where(is_changed, measured, lasting), self._limits)
        self._position = position
        self._changed_at = np.where(is_changed, now, self._changed_at)
        return self._speed
