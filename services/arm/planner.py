"""Grasp motions on an arm: the arm along the motion, or the limit that forbids it."""

import dataclasses
import hashlib
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.episode.arm import MovedArm
from congrasp.common.episode.episode import Episode
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.io.arrays import numbers_in
from congrasp.common.objects.spec import GraspObject
from congrasp.services.arm import ArmOptions
from congrasp.services.arm.description import arm_file, load_arm
from congrasp.services.arm.moved_arm import moved_arm
from congrasp.services.arm.path_tracking import Path, Track, follow
from congrasp.services.arm.robot import Pose, Robot, build_robot, default_mount
from congrasp.services.export.frames import NOT_LINKS

_REMOVED_TABLE_M = -10.0  # height of a removed table in the frame of the base, out of reach


@dataclasses.dataclass(frozen=True, eq=False)
class ArmMotion:
    """An arm along a grasp motion."""

    moved: MovedArm
    base: Pose
    """Relative to the object on the table."""
    track: Track

    def facts(self) -> dict[str, Any]:
        """Returns arm, base (m and degrees), errors and shares of the limits, for `result.json`."""
        yaw = float(self.base.rotation.as_euler("xyz", degrees=True)[2])
        base = [*self.base.position.tolist(), yaw]
        fastest = int(self.track.speed.argmax())
        return {
            "arm": self.moved.name,
            "arm_base": [round(value, 6) for value in base],
            "arm_error_mm": 1e3 * self.track.position_error,
            "arm_error_deg": float(np.degrees(self.track.rotation_error)),
            "arm_speed_share": float(self.track.speed[fastest]),
            "arm_speed_joint": str(self.moved.joint_names[fastest]),
            "arm_acceleration": float(self.track.acceleration.max()),
        }

    def note(self) -> str:
        """Describes the arm's distance from its limits."""
        facts = self.facts()
        error = f"{facts['arm_error_mm']:.1f} mm and {facts['arm_error_deg']:.1f}°"
        percent = 100 * facts["arm_speed_share"]
        speed = f"{facts['arm_speed_joint']} at {percent:.0f}% of its speed limit at most"
        return f"{facts['arm']} carries the hand within {error} of its path, {speed}"


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
            mount = _numbers("--mount", options.mount, "X Y Z ROLL PITCH YAW")
            self._mount = Pose(mount[:3], Rotation.from_euler("xyz", mount[3:], degrees=True))
        self._hand = hand
        self._seed = seed
        self._obj: GraspObject | None = None
        self._robot: Robot | None = None
        self.identity = (
            hashlib.sha256(file.read_bytes()).hexdigest(),
            dataclasses.astuple(options),
        )
        """Content of the file and options; equal for planners with the same results."""

    @property
    def name(self) -> str:
        """The arm's name."""
        return self._arm.name

    @property
    def side(self) -> float:
        """Direction from the object to the base, rad from the x axis of the world frame."""
        return float(np.arctan2(self._base.position[1], self._base.position[0]))

    def require_reach(self, obj: GraspObject) -> None:
        """Raises a CongraspError if the object on the table is farther away from the base than arm
        and hand are long.
        """
        reach = self._robot_with(obj).reach
        radius = float(np.linalg.norm(obj.points, axis=1).max())
        distance = float(np.linalg.norm(self._base.position))
        # The nearest point is at most a radius from the object's origin, which is at most a radius
        # above the table.
        nearest = distance - 2.0 * radius
        if nearest > reach:
            raise CongraspError(
                f"{self.name}'s base is {distance:.2f} m away from '{obj.name}', and arm and hand "
                f"are at most {reach:.2f} m long.",
                "Set another --base.",
            )

    def plan(self, obj: GraspObject, motion: Episode) -> ArmMotion:
        """Computes the joints along a motion.

        Raises:
          Infeasible: the arm cannot follow it.
        """
        robot = self._robot_with(obj)
        start = motion.object_position[0].astype(float) * [1.0, 1.0, 0.0]
        base = dataclasses.replace(self._base, position=self._base.position + start)
        track = follow(robot, _path(motion, base), np.random.default_rng(self._seed))
        reserved = {*motion.link_names.tolist(), *NOT_LINKS}
        arm = moved_arm(robot, track.q, base, self._mount, reserved)
        return ArmMotion(arm, self._base, track)

    def _robot_with(self, obj: GraspObject) -> Robot:
        """Returns the robot with this object; that of the last call if it has the same object."""
        if self._robot is None or self._obj is not obj:
            self._robot = build_robot(self._arm, self._hand, self._mount, obj)
            self._obj = obj
        return self._robot


def _path(motion: Episode, base: Pose) -> Path:
    """Wrist, object and table of a motion in the frame of a base that is fixed in the world."""
    to_base = base.rotation.inv()
    wrist = Rotation.from_quat(motion.wrist_quaternion, scalar_first=True)
    obj = Rotation.from_quat(motion.object_quaternion, scalar_first=True)
    return Path(
        position=to_base.apply(motion.wrist_position - base.position),
        rotation=to_base * wrist,
        q=motion.joint_position.astype(float),
        object_position=to_base.apply(motion.object_position - base.position),
        object_quaternion=(to_base * obj).as_quat(scalar_first=True),
        table=np.where(motion.table, -base.position[2], _REMOVED_TABLE_M),
        dt=motion.control_dt,
    )


def _numbers(option: str, text: str, form: str) -> np.ndarray:
    """Parses the numbers of an option, as many as its form has words.

    Raises:
      CongraspError: the text does not match the form.
    """
    numbers = numbers_in(text)
    if len(numbers) != len(form.split()):
        raise CongraspError(f"{option} is '{text}'.", f'Write "{form}" in metres and degrees.')
    return numbers
