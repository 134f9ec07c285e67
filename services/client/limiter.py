"""Targets within the limits of a robot, for any input; needs only NumPy.

NaN fails every comparison: a target that is NaN, infinite or of the wrong shape holds the joint at
its last target.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.services.client.arrays import as_numbers, bounded
from congrasp.services.client.floor import Floor
from congrasp.services.client.limits import JointLimits

_EQUAL = 1e-12
"""Largest difference of equal targets, m or rad, which have rounding errors."""
_SHORTEST_S = 1e-9
"""Least time between two targets; after a shorter one, a target does not move, since a division by
it could overflow."""


class Limited(NamedTuple):
    """A command within the limits."""

    target: np.ndarray
    """(J,) positions, within the limits of position and speed."""
    torque: np.ndarray
    """(J,) torques of the servos at that target, within the limits; at the last measured position
    if a measurement is not finite."""
    by: tuple[str, ...]
    """Limits that were applied to a target: of `not_finite`, `torque`, `acceleration`, `speed`,
    `position`, `table`.
    """


class Limiter:
    """Targets within limits.

    A target always stays within the limits of position and speed. Within those of speed, it moves
    to where the servo's torque is within its limit. So a blocked joint is not wound up, and a jump
    of a measurement does not make a target jump. Limits of position and the table have priority
    over those of acceleration: a target stops there at once.

    Attributes:
      target: (J,) the last target.
    """

    def __init__(
        self,
        limits: JointLimits,
        start: np.ndarray,
        *,
        period: float = 0.01,
        floor: Floor | None = None,
    ):
        """Starts from a position, clipped to the limits.

        Args:
          limits: the limits.
          start: (J,) current targets of the joints.
          period: seconds from one target to the next.
          floor: plane below the palm; a palm that starts below it does not move deeper.

        Raises:
          CongraspError: the start is not a finite number for each joint, or the period not
            positive.
        """
        first = as_numbers(start, len(limits.lower))
        if not np.isfinite(first).all() or not 0.0 < period < math.inf:
            raise CongraspError(
                "A limiter starts from one finite number for each joint, and has a positive period."
            )
        self._limits = limits
        self._period_s = period
        self._floor = floor
        self._latest_time = -math.inf  # time of the last target
        self.target = np.clip(first, limits.lower, limits.upper)
        self._position = self.target  # the last measured one
        self._speed = np.zeros(len(first))  # of the target

    def limit(self, target: Any, position: Any, velocity: Any, now: float) -> Limited:
        """Returns target and torque within the limits.

        Args:
          target: (J,) requested targets, m or rad.
          position: (J,) measured, m or rad.
          velocity: (J,) measured, m/s or rad/s.
          now: time, s; if the clock is set back, the targets stop until it has caught up.
        """
        limits = self._limits
        last = self.target
        elapsed = self._elapsed(now)
        requested = as_numbers(target, len(last))
        q = as_numbers(position, len(last))
        v = as_numbers(velocity, len(last))
        is_requested = np.isfinite(requested)
        is_measured = np.isfinite(q) & np.isfinite(v)
        goal = np.where(is_requested, requested, last)
        with np.errstate(all="ignore"):
            self._position = np.where(is_measured, q, self._position)
            v = np.where(is_measured, v, 0.0)
            # The target at which the servo has no torque
            neutral = self._position + v * (limits.kv / limits.kp)
            by_torque = neutral + bounded(goal - neutral, limits.torque / limits.kp)
            by_torque = np.where(is_measured & np.isfinite(by_torque), by_torque, last)
            displacement, smooth_displacement = self._displacements(by_torque - last, elapsed)
            by_speed = last + displacement
            by_acceleration = last + smooth_displacement
            by_position = np.clip(by_acceleration, limits.lower, limits.upper)
            self.target = self._above_floor(by_position, last)
            self._speed = np.zeros(len(last))
            if elapsed:
                self._speed = (self.target - last) / elapsed
            servo_torque = limits.kp * (self.target - self._position) - limits.kv * v
            torque = bounded(servo_torque, limits.torque)
        changed = {
            "not_finite": not (is_requested & is_measured).all(),
            "torque": not _are_equal(by_torque, goal),
            "acceleration": not _are_equal(smooth_displacement, displacement),
            "speed": not _are_equal(by_speed, by_torque),
            "position": not _are_equal(by_position, by_acceleration),
            "table": not np.array_equal(self.target, by_position),
        }
        return Limited(
            target=self.target.copy(),
            torque=np.where(np.isfinite(torque), torque, 0.0),
            by=tuple(name for name, is_applied in changed.items() if is_applied),
        )

    def _displacements(self, request: np.ndarray, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
        """Limits the displacements of the targets since the last ones.

        Args:
          request: (J,) requested displacements, m or rad.
          elapsed: time since the last targets, s.

        Returns:
          The displacements (J,) within the limits of speed, and those within the limits of speed
          and acceleration.
        """
        limits = self._limits
        by_speed = bounded(request, limits.speed * elapsed)
        if not elapsed or not limits.acceleration.any():
            return by_speed, by_speed
        is_unlimited = limits.acceleration == 0.0
        braking = limits.acceleration * elapsed  # largest change of speed in a step, m/s or rad/s
        wrist_distances = np.linalg.norm(request[-6:].reshape(2, 3), axis=1)
        distance = np.append(np.abs(request[:-6]), np.repeat(wrist_distances, 3))
        # A target that brakes in each step, with speeds v, v - braking, v - 2 braking, …, comes to
        # rest at the requested place after this many steps, if its first speed is `stoppable`.
        steps = np.maximum(np.ceil((np.sqrt(1 + 8 * distance / (braking * elapsed)) - 1) / 2), 1)
        stoppable = distance / (steps * elapsed) + (steps - 1) * braking / 2
        max_speed = np.where(is_unlimited, limits.speed, np.minimum(limits.speed, stoppable))
        speed = bounded(request, max_speed * elapsed) / elapsed
        change = bounded(speed - self._speed, np.where(is_unlimited, np.inf, braking))
        return by_speed, (self._speed + change) * elapsed

    def _above_floor(self, target: np.ndarray, last: np.ndarray) -> np.ndarray:
        """Returns a target that keeps the palm above the floor, or as high as it was if it was
        below: the requested one if possible, else it raised without further rotation, else one
        that keeps the wrist.

        Args:
          target: (J,) the requested target.
          last: (J,) the last target.
        """
        if self._floor is None:
            return target
        limits = self._limits
        floor = self._floor
        min_clearance = min(floor.clearance(last[-6:]), 0.0)
        if floor.clearance(target[-6:]) >= min_clearance:
            return target
        raised = np.append(target[:-3], last[-3:])
        missing_height = max(min_clearance - floor.clearance(raised[-6:]), 0.0)
        raised[-6:-3] += floor.normal * missing_height
        if (raised >= limits.lower).all() and (raised <= limits.upper).all():
            return raised
        return np.append(target[:-6], last[-6:])

    def _elapsed(self, now: float) -> float:
        """Seconds since the last target, at most a period, so that targets do not catch up after a
        pause; 0 if the clock was set back.
        """
        elapsed = now - self._latest_time
        if not (math.isfinite(now) and elapsed >= _SHORTEST_S):
            return 0.0
        self._latest_time = now
        return min(elapsed, self._period_s)


def _are_equal(first: np.ndarray, second: np.ndarray) -> bool:
    """True if two targets or displacements (J,) are equal, apart from rounding."""
    return np.allclose(first, second, rtol=0.0, atol=_EQUAL)
