"""Limits of commands to a robot for any input; needs NumPy only.

NaN fails every comparison: a target that is NaN, infinite or of the wrong shape holds the joint at
its last target.
"""

import dataclasses
import math
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.request import Pose

if TYPE_CHECKING:
    from congrasp.common.hands.spec import Hand
    from congrasp.common.task.config import ControlConfig

_EQUAL = 1e-12
"""Tolerance of equal targets, m or rad: norms are subject to rounding."""
_SHORTEST = 1e-9
"""Resolution of a clock, s; quotients of less overflow."""


@dataclasses.dataclass(frozen=True, eq=False)
class JointLimits:
    """Limits and servo gains of F finger joints, then the wrist's three slides and three hinges: J
    = F + 6.

    SI units: N and m for slides, N.m and rad for hinges and fingers. For the slides, the norm of
    speed, acceleration and torque is limited, to the least of the three limits; likewise for the
    hinges.
    """

    lower: np.ndarray
    """(J,) least target."""
    upper: np.ndarray
    """(J,) greatest target."""
    speed: np.ndarray
    """(J,) greatest speed of a target."""
    torque: np.ndarray
    """(J,) greatest torque."""
    kp: np.ndarray
    """(J,) stiffness of the servo: torque = kp (target - position) - kv velocity."""
    kv: np.ndarray
    """(J,) damping of the servo."""
    acceleration: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    """(J,) greatest acceleration of a target; 0, the default, for no limit."""
    palm: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((1, 4)))
    """(K, 4) m: centres in the wrist frame and radii of spheres that must stay above the table
    (`Guard`).
    """

    def __post_init__(self) -> None:
        if not np.size(self.acceleration):
            object.__setattr__(self, "acceleration", np.zeros(np.shape(self.lower)))
        for field in dataclasses.fields(self):
            value = np.array(getattr(self, field.name), float)
            fits = (
                value.shape[1:] == (4,)
                if field.name == "palm"
                else value.shape == np.shape(self.lower)
            )
            if not fits or not np.isfinite(value).all():
                raise CongraspError(
                    f"The limits' '{field.name}' must be finite numbers of the documented shape."
                )
            if field.name not in ("lower", "upper", "palm") and not (value >= 0.0).all():
                raise CongraspError(f"The limits' '{field.name}' must not be negative.")
            value.flags.writeable = False
            object.__setattr__(self, field.name, value)
        if self.lower.ndim != 1 or len(self.lower) < 6:
            raise CongraspError(
                "The limits are of the finger joints and the six joints of the wrist."
            )
        if not (self.lower <= self.upper).all() or not (self.kp > 0.0).all():
            raise CongraspError(
                "The limits have a lower bound above the upper one, or a kp that is not positive."
            )

    @classmethod
    def of_hand(  # noqa: PLR0913
        cls,
        hand: "Hand",
        control: "ControlConfig | None" = None,
        *,
        finger_speed: float = 8.0,
        wrist_speed: float = 1.5,
        wrist_angular_speed: float = 6.0,
        reach: float = 0.4,
        turn: float = 2.5,
        margin: float = 0.03,
        grip: float = math.inf,
    ) -> Self:
        """Limits of the fingers' motors, then of the six wrist joints, with gains and torques of
        the hand's model.

        The wrist's targets have the task's acceleration limits (`ControlConfig`); its force and
        torque are limited to those that accelerate the hand's inertia as much. Most hands have a
        motor for each finger joint; see `common.hands.motors` for others.

        Args:
          hand: the hand (`common.hands.get_hand`).
          control: the control of the policy's training; the default one if absent.
          finger_speed: speed limit of the fingers, rad/s.
          wrist_speed: speed limit of the wrist, m/s.
          wrist_angular_speed: angular speed limit of the wrist, rad/s.
          reach: largest displacement of the wrist since the start of the episode, along each axis,
            m.
          turn: largest rotation, likewise, rad.
          margin: distance of finger targets from the ends of their joints, rad; narrow joints stay
            in their middle.
          grip: limit of the force of a straight finger at its tip, N; that of a bent one is larger,
            as its lever is shorter.
        """
        from congrasp.common.hands.motors import motor_limits
        from congrasp.common.task.config import ControlConfig

        wrist, motors, control = hand.wrist, hand.motors, control or ControlConfig()
        allowed = np.array([control.wrist_acceleration, control.wrist_angular_acceleration])
        strongest = np.where(allowed > 0.0, allowed * hand.wrist_inertia, np.inf)
        force = np.minimum(strongest, [wrist.slide_limit, wrist.hinge_limit])
        levers = _levers(hand)
        fingers = [
            min(m.torque_limit, grip * max(levers.get(name, 0.0) for name in m.joints))
            for m in motors
        ]
        lower, upper = motor_limits(hand)
        middle = (lower + upper) / 2
        palm = [(*end, c.radius) for c in hand.links[0].capsules for end in (c.start, c.end)]
        return cls(
            lower=np.append(np.minimum(lower + margin, middle), np.repeat([-reach, -turn], 3)),
            upper=np.append(np.maximum(upper - margin, middle), np.repeat([reach, turn], 3)),
            speed=np.append(
                np.full(len(motors), finger_speed), np.repeat([wrist_speed, wrist_angular_speed], 3)
            ),
            torque=np.append(fingers, np.repeat(force, 3)),
            kp=np.append([m.kp for m in motors], np.repeat([wrist.slide_kp, wrist.hinge_kp], 3)),
            kv=np.append([m.kv for m in motors], np.repeat([wrist.slide_kv, wrist.hinge_kv], 3)),
            acceleration=np.append(np.zeros(len(motors)), np.repeat(allowed, 3)),
            palm=np.array(palm).reshape(-1, 4),
        )

    def as_lists(self) -> dict[str, Any]:
        """The fields as lists, for JSON; `JointLimits(**fields)` is the inverse."""
        return {
            field.name: getattr(self, field.name).tolist() for field in dataclasses.fields(self)
        }


def _levers(hand: "Hand") -> dict[str, float]:
    """Distances, m, from joints by name to the farthest fingertip that they move, with every joint
    at zero.
    """
    links, found = {link.name: link for link in hand.links}, dict[str, float]()
    for tip in (link for link in hand.links if link.tip is not None):
        link = tip
        while link.joints:
            for joint in link.joints:
                found[joint.name] = max(
                    found.get(joint.name, 0.0), math.dist(joint.anchor, tip.tip or ())
                )
            link = links[link.parent]
    return found


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


class Speeds:
    """Velocities of J joints, from successive measured positions."""

    def __init__(self, most: np.ndarray, lasting: float):
        """Starts without a measurement.

        Args:
          most: (J,) largest plausible speed, rad/s or m/s.
          lasting: seconds for which a speed counts after the change of the position; measurements
            may arrive at a lower rate than steps.
        """
        self._most, self._lasting = most, lasting
        self._position, self._when = np.full(len(most), np.nan), np.full(len(most), -math.inf)
        self._speed = np.zeros(len(most))

    def of(self, position: np.ndarray, now: float) -> np.ndarray:
        """Speeds (J,) at a measurement: each joint's displacement since its last change over the
        time; zero at first.

        Args:
          position: (J,) measured; the last three are angles modulo full turns.
          now: s.
        """
        elapsed, way = now - self._when, position - self._position
        way[-3:] = np.remainder(way[-3:] + np.pi, 2 * np.pi) - np.pi
        known = np.isfinite(way) & (elapsed > 0.0)
        changed = position != self._position  # also where it is not finite
        speed = np.where(known, way / np.maximum(elapsed, 1e-6), 0.0)
        self._speed = _bounded(
            np.where(changed, speed, np.where(elapsed <= self._lasting, self._speed, 0.0)),
            self._most,
        )
        self._position, self._when = position, np.where(changed, now, self._when)
        return self._speed


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
        floor: "Floor | None" = None,
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
        self._limits, self._period, self._floor, self._latest = limits, period, floor, -math.inf
        self.target = np.clip(first, limits.lower, limits.upper)
        self._position, self._speed = self.target, np.zeros(len(first))

    def limit(self, target: Any, position: Any, velocity: Any, now: float) -> Limited:
        """Returns target and torque within the limits.

        Args:
          target: (J,) requested targets.
          position: (J,) measured.
          velocity: (J,) measured.
          now: s; if the clock is set back, the targets stop until it has caught up.
        """
        limits, last, elapsed = self._limits, self.target, self._elapsed(now)
        given, q, v = (as_numbers(value, len(last)) for value in (target, position, velocity))
        known, measured = np.isfinite(given), np.isfinite(q) & np.isfinite(v)
        wanted = np.where(known, given, last)
        with np.errstate(all="ignore"):
            self._position, v = np.where(measured, q, self._position), np.where(measured, v, 0.0)
            steady = self._position + v * (limits.kv / limits.kp)
            within = steady + _bounded(wanted - steady, limits.torque / limits.kp)
            within = np.where(measured & np.isfinite(within), within, last)
            way, soft = self._allowed(within - last, elapsed)
            inside = np.clip(last + soft, limits.lower, limits.upper)
            self.target = self._above(inside, last)
            self._speed = (self.target - last) / elapsed if elapsed else np.zeros(len(last))
            torque = _bounded(
                limits.kp * (self.target - self._position) - limits.kv * v, limits.torque
            )
        changed = {
            "not_finite": not (known & measured).all(),
            "torque": not np.allclose(within, wanted, rtol=0.0, atol=_EQUAL),
            "acceleration": not np.allclose(soft, way, rtol=0.0, atol=_EQUAL),
            "speed": not np.allclose(last + way, within, rtol=0.0, atol=_EQUAL),
            "position": not np.allclose(inside, last + soft, rtol=0.0, atol=_EQUAL),
            "table": not np.array_equal(self.target, inside),
        }
        by = tuple(name for name, did in changed.items() if did)
        return Limited(self.target.copy(), np.where(np.isfinite(torque), torque, 0.0), by)

    def _allowed(self, way: np.ndarray, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
        """Returns the displacements (J,) within the limits of speed, and within those of speed and
        acceleration.
        """
        limits = self._limits
        bounded = _bounded(way, limits.speed * elapsed)
        if not elapsed or not limits.acceleration.any():
            return bounded, bounded
        # M/s and rad/s in one step
        free, gain = (
            limits.acceleration == 0.0,
            limits.acceleration * elapsed,
        )
        distance = np.append(
            np.abs(way[:-6]), np.repeat(np.linalg.norm(way[-6:].reshape(2, 3), axis=1), 3)
        )
        # From v, v - gain, v - 2 gain, … a target comes to rest where the way ends, after this many
        # steps.
        steps = np.maximum(np.ceil((np.sqrt(1 + 8 * distance / (gain * elapsed)) - 1) / 2), 1)
        braking = distance / (steps * elapsed) + (steps - 1) * gain / 2
        speed = (
            _bounded(way, np.where(free, limits.speed, np.minimum(limits.speed, braking)) * elapsed)
            / elapsed
        )
        change = _bounded(speed - self._speed, np.where(free, np.inf, gain))
        return bounded, (self._speed + change) * elapsed

    def _above(self, target: np.ndarray, last: np.ndarray) -> np.ndarray:
        """Returns the target, or the nearest one without further rotation that keeps the palm above
        the floor.
        """
        if self._floor is None:
            return target
        limits, floor = self._limits, self._floor
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
        if not (math.isfinite(now) and spent >= _SHORTEST):
            return 0.0
        self._latest = now
        return min(spent, self._period)


def _bounded(values: np.ndarray, most: np.ndarray) -> np.ndarray:
    """(J,) values clipped to limits: those of fingers separately, those of the wrist's slides and
    hinges by norm.
    """
    bounded = np.clip(values, -most, most)
    for three in (slice(-6, -3), slice(-3, None)):
        length, longest = np.linalg.norm(values[three]), most[three].min()
        if not length <= longest:
            # Rounding
            bounded[three] = np.clip(values[three] * (longest / length), -longest, longest)
    return bounded


def as_numbers(value: Any, size: int) -> np.ndarray:
    """(size,) float64; all NaN if `value` is no such array."""
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError, OverflowError):
        return np.full(size, np.nan)
    return array if array.shape == (size,) else np.full(size, np.nan)


class Floor:
    """Clearance of the palm above a plane, as a function of the wrist joints."""

    def __init__(self, plane: np.ndarray, wrist: Pose, palm: np.ndarray):
        """Takes the poses of an episode.

        Args:
          plane: (4,) a, b, c, d, world frame: points with a x + b y + c z >= d are above; (a, b, c)
            of length 1.
          wrist: the base of the wrist joints, world frame.
          palm: see `JointLimits`.

        Raises:
          CongraspError: the normal is not of length 1, or a number is not finite.
        """
        plane, position, quaternion = (
            as_numbers(x, n) for x, n in ((plane, 4), (wrist[0], 3), (wrist[1], 4))
        )
        if (
            not abs(np.linalg.norm(plane[:3]) - 1.0) < 1e-3
            or not abs(np.linalg.norm(quaternion) - 1.0) < 0.02
        ):
            raise CongraspError(
                "The table's normal and the wrist's quaternion must have the length 1."
            )
        self.normal = _matrix(quaternion).T @ plane[:3]
        """(3,) normal of the plane in the frame of the base."""
        self._offset, self._palm = plane[3] - plane[:3] @ position, palm
        if not math.isfinite(self._offset):
            raise CongraspError("The table's height and the wrist's position must be finite.")

    def clearance(self, u: np.ndarray) -> float:
        """Least distance, m, of the palm from the plane at wrist joints (6,); negative below it."""
        places = u[:3] + self._palm[:, :3] @ _turned(u[3:]).T
        return float((places @ self.normal - self._palm[:, 3]).min() - self._offset)


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    """(3, 3) rotation of a quaternion (4,), (w, x, y, z)."""
    w, (x, y, z) = quaternion[0], quaternion[1:]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def _turned(angles: np.ndarray) -> np.ndarray:
    """(3, 3) rotation by intrinsic x-y-z angles (3,)."""
    turns = (
        np.append(np.cos(half := angle / 2), np.sin(half) * np.eye(3)[axis])
        for axis, angle in enumerate(angles)
    )
    x, y, z = map(_matrix, turns)
    return x @ y @ z
