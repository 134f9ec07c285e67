"""Grasp motions on an arm: the arm along the motion, or the limit that forbids it."""

import dataclasses
import hashlib
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError, MissingPackageError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.services.arm.description import arm_file, load_arm
from congrasp.services.arm.links import moved_arm
from congrasp.services.arm.options import ArmOptions
from congrasp.services.arm.robot import Pose, Robot, build_robot, default_mount
from congrasp.services.export.frames import NOT_LINKS
from congrasp.services.export.motion_file import GraspMotion
from congrasp.services.record.moved_arm import MovedArm

try:
    from congrasp.services.arm.tracking import Path, Track, follow
except ModuleNotFoundError as error:
    raise MissingPackageError("--arm", error.name or "mink") from None

_FAR_BELOW = -10.0  # m, of a table that was removed


@dataclasses.dataclass(frozen=True, eq=False)
class ArmMotion:
    """An arm along a grasp motion."""

    moved: MovedArm
    base: Pose
    """Relative to the object on the table."""
    track: Track

    def facts(self) -> dict[str, Any]:
        """Arm, base, errors and shares of the limits, for `result.json`."""
        yaw = float(self.base.rotation.as_euler("xyz", degrees=True)[2])
        fastest = int(self.track.speed.argmax())
        return {
            "arm": self.moved.name,
            "arm_base": [*(round(float(x), 6) for x in self.base.position), round(yaw, 6)],
            "arm_error_mm": 1e3 * self.track.position_error,
            "arm_error_deg": float(np.degrees(self.track.rotation_error)),
            "arm_speed_share": float(self.track.speed[fastest]),
            "arm_speed_joint": str(self.moved.joint_names[fastest]),
            "arm_acceleration": float(self.track.acceleration.max()),
        }

    def note(self) -> str:
        """Describes the arm's distance from its limits."""
        facts = self.facts()
        off = f"{facts['arm_error_mm']:.1f} mm and {facts['arm_error_deg']:.1f}°"
        speed = f"{facts['arm_speed_joint']} at {100 * facts['arm_speed_share']:.0f}% of its speed limit at most"
        return f"{facts['arm']} carries the hand within {off} of its path, {speed}"


class ArmPlanner:
    """Plans the joints of an arm with a hand along grasp motions."""

    def __init__(self, options: ArmOptions, hand: Hand, seed: int = 0):
        """Reads the arm.

        Args:
          options: file, base, flange, mount and speeds.
          hand: the hand that it carries.
          seed: seed of the initial postures.

        Raises:
          CongraspError: the arm cannot be read, or an option is not valid.
        """
        file = arm_file(options.arm)
        self._arm = load_arm(file, options.flange, options.arm_speed)
        x, y, z, yaw = _numbers("--base", options.base, "X Y Z YAW")
        self._base = Pose(np.array([x, y, z]), Rotation.from_euler("z", yaw, degrees=True))
        self._mount = default_mount(hand)
        if options.mount:
            given = _numbers("--mount", options.mount, "X Y Z ROLL PITCH YAW")
            self._mount = Pose(np.array(given[:3]), Rotation.from_euler("xyz", given[3:], degrees=True))
        self._hand, self._seed = hand, seed
        self._robot: tuple[GraspObject, Robot] | None = None
        self.identity = (hashlib.sha256(file.read_bytes()).hexdigest(), dataclasses.astuple(options))

    @property
    def name(self) -> str:
        """The arm's name."""
        return self._arm.name

    @property
    def side(self) -> float:
        """Side of the object on which the base is, rad from the x axis of the world frame."""
        return float(np.arctan2(self._base.position[1], self._base.position[0]))

    def plan(self, obj: GraspObject, motion: GraspMotion) -> ArmMotion:
        """Computes the joints along a motion.

        Raises:
          Infeasible: the arm cannot follow it.
        """
        if self._robot is None or self._robot[0] is not obj:
            self._robot = obj, build_robot(self._arm, self._hand, self._mount, obj)
        robot = self._robot[1]
        start = motion.object_position[0].astype(float) * [1.0, 1.0, 0.0]
        base = dataclasses.replace(self._base, position=self._base.position + start)
        track = follow(robot, _path(motion, base), np.random.default_rng(self._seed))
        arm = moved_arm(robot, track.q, base, self._mount, {*motion.link_names.tolist(), *NOT_LINKS})
        return ArmMotion(arm, self._base, track)


def _path(motion: GraspMotion, base: Pose) -> Path:
    """Wrist, object and table of a motion in the frame of a base that is fixed in the world."""
    back = base.rotation.inv()
    wrist = Rotation.from_quat(motion.wrist_quaternion, scalar_first=True)
    turned = back * Rotation.from_quat(motion.object_quaternion, scalar_first=True)
    return Path(
        back.apply(motion.wrist_position - base.position),
        back * wrist,
        motion.joint_position.astype(float),
        back.apply(motion.object_position - base.position),
        turned.as_quat(scalar_first=True),
        np.where(motion.table, -base.position[2], _FAR_BELOW),
        motion.control_dt,
    )


def _numbers(option: str, text: str, form: str) -> list[float]:
    """Parses the numbers of an option, as many as its form has words.

    Raises:
      CongraspError: the text does not match the form.
    """
    try:
        found = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        found = []
    if len(found) != len(form.split()) or not np.isfinite(found).all():
        raise CongraspError(f"{option} is '{text}'.", f'Write "{form}" in metres and degrees.')
    return found
