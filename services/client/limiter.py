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
"""Tolerance of equal targets, m or rad: norms are subject to rounding."""
_SHORTEST_S = 1e-9
"""Resolution of a clock, s; quotients of less overflow."""


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

    A target stays within the limits of position and speed. Within those of speed, it is moved to
    where the servo's torque is within its limit, so that a blocked joint is not wound up, and a
    jump of a measurement moves no target faster than usual. Limits of position and the table have
    priority over those of acceleration: a target stops there at once.

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
        self._period = period
        self._floor = floor
        self._latest = -math.inf  # time of the last target
        self.target = np.clip(first, limits.lower, limits.upper)
        self._position = self.target
        self._speed = np.zeros(len(first))

    def limit(self, target: Any, position: Any, velocity: Any, now: float) -> Limited:
        """Returns target and torque within the limits.

        Args:
          target: (J,) requested targets.
          position: (J,) measured.
          velocity: (J,) measured.
          now: s; if the clock is set back, the targets stop until it has caught up.
        """
        limits = self._limits
        last = self.target
        elapsed = self._elapsed(now)
        requested = as_numbers(target, len(last))
        q = as_numbers(position, len(last))
        v = as_numbers(velocity, len(last))
        is_requested = np.isfinite(requested)
        measured = np.isfinite(q) & np.isfinite(v)
        goal = np.where(is_requested, requested, last)
        with np.errstate(all="ignore"):
            self._position = np.where(measured, q, self._position)
            v = np.where(measured, v, 0.0)
            steady = self._position + v * (limits.kv / limits.kp)
            within = steady + bounded(goal - steady, limits.torque / limits.kp)
            within = np.where(measured & np.isfinite(within), within, last)
            way, soft = self._allowed(within - last, elapsed)
            inside = np.clip(last + soft, limits.lower, limits.upper)
            self.target = self._above(inside, last)
            self._speed = (self.target - last) / elapsed if elapsed else np.zeros(len(last))
            servo_torque = limits.kp * (self.target - self._position) - limits.kv * v
            torque = bounded(servo_torque, limits.torque)
        changed = {
            "not_finite": not (is_requested & measured).all(),
            "torque": not np.allclose(within, goal, rtol=0.0, atol=_EQUAL),
            "acceleration": not np.allclose(soft, way, rtol=0.0, atol=_EQUAL),
            "speed": not np.allclose(last + way, within, rtol=0.0, atol=_EQUAL),
            "position": not np.allclose(inside, last + soft, rtol=0.0, atol=_EQUAL),
            "table": not np.array_equal(self.target, inside),
        }
        return Limited(
            target=self.target.copy(),
            torque=np.where(np.isfinite(torque), torque, 0.0),
            by=tuple(name for name, is_applied in changed.items() if is_applied),
        )

    def _allowed(self, way: np.ndarray, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
        """Returns the displacements (J,) within the limits of speed, and within those of speed and
        acceleration.
        """
        limits = self._limits
        fast = bounded(way, limits.speed * elapsed)
        if not elapsed or not limits.acceleration.any():
            return fast, fast
        free = limits.acceleration == 0.0
        gain = limits.acceleration * elapsed  # m/s and rad/s in one step
        of_wrist = np.linalg.norm(way[-6:].reshape(2, 3), axis=1)
        distance = np.append(np.abs(way[:-6]), np.repeat(of_wrist, 3))
        # From v, v - gain, v - 2 gain, … a target comes to rest where the way ends, after this many
        # steps.
        steps = np.maximum(np.ceil((np.sqrt(1 + 8 * distance / (gain * elapsed)) - 1) / 2), 1)
        braking = distance / (steps * elapsed) + (steps - 1) * gain / 2
        most = np.where(free, limits.speed, np.minimum(limits.speed, braking))
        speed = bounded(way, most * elapsed) / elapsed
        change = bounded(speed - self._speed, np.where(free, np.inf, gain))
        return fast, (self._speed + change) * elapsed

    def _above(self, target: np.ndarray, last: np.ndarray) -> np.ndarray:
        """Returns the target, or the nearest one without further rotation that keeps the palm above
        the floor.
        """
        if self._floor is None:
            return target
        limits = self._limits
        floor = self._floor
        least = min(floor.clearance(last[-6:]), 0.0)
        if floor.clearance(target[-6:]) >= least:
            return target
        raised = np.append(target[:-3], last[-3:])
        raised[-6:-3] += floor.normal * max(least - floor.clearance(raised[-6:]), 0.0)
        inside = (raised >= limits.lower).all() and (raised <= limits.upper).all()
        return raised if inside else np.append(target[:-6], last[-6:])

    def _elapsed(self, now: float) -> float:
        """Seconds since the last target, at most a period, so that targets do not catch up after a
        pause.
        """
        spent = now - self._latest
        if not (math.isfinite(now) and spent >= _SHORTEST_S):
            return 0.0
        self._latest = now
        return min(spent, self._period)
