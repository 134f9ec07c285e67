"""Limits and servo gains of a hand's joints; needs only NumPy."""

import dataclasses
import math
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from congrasp.common.errors import CongraspError

if TYPE_CHECKING:
    from congrasp.common.hands.spec import Hand
    from congrasp.common.task.config import ControlConfig


@dataclasses.dataclass(frozen=True, eq=False)
class JointLimits:
    """Limits and servo gains of F finger joints, then the wrist's three slides and three hinges: J
    = F + 6.

    SI units: N and m for slides, N.m and rad for hinges and fingers. The norms of the three slides'
    speeds, accelerations and torques are limited to the least of their three limits; likewise those
    of the hinges.
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
    """(J,) greatest acceleration of a target; 0 for no limit, which is the default."""
    palm: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((1, 4)))
    """(K, 4) m: centres in the wrist frame and radii of spheres that must stay above the table
    (`Guard`).
    """

    def __post_init__(self) -> None:
        if not np.size(self.acceleration):
            object.__setattr__(self, "acceleration", np.zeros(np.shape(self.lower)))
        for field in dataclasses.fields(self):
            value = np.array(getattr(self, field.name), float)
            self._check_field(field.name, value)
            value.flags.writeable = False
            object.__setattr__(self, field.name, value)
        if self.lower.ndim != 1 or len(self.lower) < 6:
            raise CongraspError("The limits must cover the finger joints and the six wrist joints.")
        if not (self.lower <= self.upper).all() or not (self.kp > 0.0).all():
            raise CongraspError(
                "The limits have a lower bound above an upper bound, or a kp that is not positive."
            )

    def _check_field(self, name: str, value: np.ndarray) -> None:
        """Raises a CongraspError for a field of the wrong shape, or with a number that it may not
        have.
        """
        shape = np.shape(self.lower)
        fits = value.shape[1:] == (4,) if name == "palm" else value.shape == shape
        if not fits or not np.isfinite(value).all():
            raise CongraspError(
                f"The limits' '{name}' must be finite numbers of the documented shape."
            )
        if name not in ("lower", "upper", "palm") and not (value >= 0.0).all():
            raise CongraspError(f"The limits' '{name}' must not be negative.")

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
        """Returns the limits of the fingers' motors, then of the six wrist joints, with gains and
        torques of the hand's model.

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

        control = control or ControlConfig()
        wrist = hand.wrist
        motors = hand.motors
        accelerations = np.array([control.wrist_acceleration, control.wrist_angular_acceleration])
        # Force and torque that accelerate the hand to the limit of acceleration
        accelerating = np.where(accelerations > 0.0, accelerations * hand.wrist_inertia, np.inf)
        wrist_torques = np.minimum(accelerating, [wrist.slide_limit, wrist.hinge_limit])
        levers = _levers(hand)
        finger_torques = []
        for motor in motors:
            lever = max(levers.get(name, 0.0) for name in motor.joints)
            finger_torques.append(min(motor.torque_limit, grip * lever))
        lower, upper = motor_limits(hand)
        middle = (lower + upper) / 2

        def joined(of_fingers: Any, of_wrist: Any) -> np.ndarray:
            """(J,) values of the fingers, then those of the slides and of the hinges (2,)."""
            return np.append(of_fingers, np.repeat(of_wrist, 3))

        palm = []
        for capsule in hand.links[0].capsules:
            palm.append((*capsule.start, capsule.radius))
            palm.append((*capsule.end, capsule.radius))
        return cls(
            lower=joined(np.minimum(lower + margin, middle), [-reach, -turn]),
            upper=joined(np.maximum(upper - margin, middle), [reach, turn]),
            speed=joined(np.full(len(motors), finger_speed), [wrist_speed, wrist_angular_speed]),
            torque=joined(finger_torques, wrist_torques),
            kp=joined([motor.kp for motor in motors], [wrist.slide_kp, wrist.hinge_kp]),
            kv=joined([motor.kv for motor in motors], [wrist.slide_kv, wrist.hinge_kv]),
            acceleration=joined(np.zeros(len(motors)), accelerations),
            palm=np.array(palm).reshape(-1, 4),
        )

    def as_lists(self) -> dict[str, Any]:
        """Returns the fields as lists, for JSON; `JointLimits(**fields)` is the inverse."""
        return {
            field.name: getattr(self, field.name).tolist() for field in dataclasses.fields(self)
        }


def _levers(hand: "Hand") -> dict[str, float]:
    """Returns the distance, m, from each joint, by its name, to the farthest fingertip that it
    moves, with every joint at zero.
    """
    links = {link.name: link for link in hand.links}
    levers: dict[str, float] = {}
    for finger in hand.links:
        if finger.tip is None:
            continue
        link = finger
        while link.joints:
            for joint in link.joints:
                distance = math.dist(joint.anchor, finger.tip)
                levers[joint.name] = max(levers.get(joint.name, 0.0), distance)
            link = links[link.parent]
    return levers
