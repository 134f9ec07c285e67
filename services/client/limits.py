"""Limits of a robot's commands, for any input; needs nothing but numpy.

Every comparison is written so that what is not a number fails it: a target that is NaN, infinite or of the wrong shape
holds the joint where it was told to be last.
"""

import dataclasses
import math
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from congrasp.common.errors import CongraspError

if TYPE_CHECKING:
    from congrasp.common.hands.spec import Hand


@dataclasses.dataclass(frozen=True, eq=False)
class JointLimits:
    """Limits and servo gains of J joints; SI units, N and m for slides, N.m and rad for hinges."""

    lower: np.ndarray
    """(J,) least target."""
    upper: np.ndarray
    """(J,) greatest target."""
    speed: np.ndarray
    """(J,) at which a target moves at most."""
    torque: np.ndarray
    """(J,) greatest torque."""
    kp: np.ndarray
    """(J,) of the servo: torque = kp (target - position) - kv velocity."""
    kv: np.ndarray
    """(J,)."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = np.array(getattr(self, field.name), float)
            if value.ndim != 1 or value.shape != np.shape(self.lower) or not np.isfinite(value).all():
                raise CongraspError(f"The limits' '{field.name}' must be one finite number for each joint.")
            if field.name not in ("lower", "upper") and not (value >= 0.0).all():
                raise CongraspError(f"The limits' '{field.name}' must not be negative.")
            value.flags.writeable = False
            object.__setattr__(self, field.name, value)
        if not (self.lower <= self.upper).all() or not (self.kp > 0.0).all():
            raise CongraspError("The limits have a lower bound above the upper one, or a kp that is not positive.")

    @classmethod
    def of_hand(
        cls,
        hand: "Hand",
        *,
        finger_speed: float = 8.0,
        wrist_speed: float = 1.5,
        wrist_angular_speed: float = 6.0,
        reach: float = 0.4,
        turn: float = 2.5,
        margin: float = 0.03,
    ) -> Self:
        """Limits of the fingers' motors, then of the six wrist joints, with the gains and torques of the hand's model.

        Most hands have a motor for each finger joint; see `common.hands.motors` for others.

        Args:
          hand: the hand (`common.hands.get_hand`).
          finger_speed: rad/s.
          wrist_speed: m/s along each axis of the wrist.
          wrist_angular_speed: rad/s about each.
          reach: m that the wrist may be from where it was at the episode's begin, along each axis.
          turn: rad, likewise.
          margin: rad that finger targets keep from the ends of their joints; narrow joints stay in their middle.
        """
        from congrasp.common.hands.motors import motor_limits

        wrist, motors = hand.wrist, hand.motors
        lower, upper = motor_limits(hand)
        middle = (lower + upper) / 2
        return cls(
            lower=np.append(np.minimum(lower + margin, middle), np.repeat([-reach, -turn], 3)),
            upper=np.append(np.maximum(upper - margin, middle), np.repeat([reach, turn], 3)),
            speed=np.append(np.full(len(motors), finger_speed), np.repeat([wrist_speed, wrist_angular_speed], 3)),
            torque=np.append([m.torque_limit for m in motors], np.repeat([wrist.slide_limit, wrist.hinge_limit], 3)),
            kp=np.append([m.kp for m in motors], np.repeat([wrist.slide_kp, wrist.hinge_kp], 3)),
            kv=np.append([m.kv for m in motors], np.repeat([wrist.slide_kv, wrist.hinge_kv], 3)),
        )


class Limited(NamedTuple):
    """A command within the limits."""

    target: np.ndarray
    """(J,) positions, within the limits of position and speed."""
    torque: np.ndarray
    """(J,) what the servos give at that target, within the limits; 0 where the measurement is not finite."""
    by: tuple[str, ...]
    """Limits that were applied to a target: of `not_finite`, `torque`, `speed`, `position`."""


class Limiter:
    """Targets within limits.

    A target moves no faster than the limits allow, never leaves them, and is drawn back to where the servo's torque is
    within its limit as far as that does not make it too fast. So a joint that something holds is not wound up, and
    a measurement that jumps moves a target no faster than any other.

    Attributes:
      target: (J,) the last one.
    """

    def __init__(self, limits: JointLimits, start: np.ndarray, *, period: float = 0.01):
        """Starts from a position that is brought within the limits.

        Args:
          limits: the limits.
          start: (J,) where the joints are told to be now.
          period: seconds from one target to the next.

        Raises:
          CongraspError: the start is not a finite number for each joint, or the period not positive.
        """
        first = as_numbers(start, len(limits.lower))
        if not np.isfinite(first).all() or not 0.0 < period < math.inf:
            raise CongraspError("A limiter starts from one finite number for each joint, and has a positive period.")
        self._limits, self._period, self._latest = limits, period, -math.inf
        self.target = np.clip(first, limits.lower, limits.upper)

    def limit(self, target: Any, position: Any, velocity: Any, now: float) -> Limited:
        """The target and torque that the limits allow.

        Args:
          target: (J,) what is wanted.
          position: (J,) measured.
          velocity: (J,) measured.
          now: s; a clock that goes back stops the targets until it has caught up.
        """
        limits, last = self._limits, self.target
        size = len(last)
        given, q, v = (as_numbers(value, size) for value in (target, position, velocity))
        wanted = np.where(np.isfinite(given), given, last)
        with np.errstate(all="ignore"):
            steady, reach = q + v * (limits.kv / limits.kp), limits.torque / limits.kp
            within = np.clip(wanted, steady - reach, steady + reach)
            within = np.where(np.isfinite(within), within, last)
            step = limits.speed * self._elapsed(now)
            slower = np.clip(within, last - step, last + step)
            self.target = np.clip(slower, limits.lower, limits.upper)
            torque = np.clip(limits.kp * (self.target - q) - limits.kv * v, -limits.torque, limits.torque)
        changed = {
            "not_finite": not (np.isfinite(given) & np.isfinite(q) & np.isfinite(v)).all(),
            "torque": (within != wanted).any(),
            "speed": (slower != within).any(),
            "position": (self.target != slower).any(),
        }
        by = tuple(name for name, did in changed.items() if did)
        return Limited(self.target.copy(), np.where(np.isfinite(torque), torque, 0.0), by)

    def _elapsed(self, now: float) -> float:
        """Seconds since the last target, at most a period, so that no pause is caught up; 0 if time did not pass."""
        if not math.isfinite(now):
            return 0.0
        spent = now - self._latest
        self._latest = max(self._latest, now)
        return min(max(spent, 0.0), self._period)


def as_numbers(value: Any, size: int) -> np.ndarray:
    """(size,) float64; NaN throughout for what is no such array."""
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError, OverflowError):
        return np.full(size, np.nan)
    return array if array.shape == (size,) else np.full(size, np.nan)
