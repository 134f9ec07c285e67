"""Joints, and poses in the world frame, from the inputs of the node."""

import dataclasses
import sys
import time
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

import congrasp
from congrasp_ros2.bus import FRAMES, INPUTS

if TYPE_CHECKING:
    from congrasp_ros2.node import Arguments


_EPOCH = 1e9
"""Stamps before this, s, are not the time of day (2001), but that since the start of a
simulator.
"""


@dataclasses.dataclass(frozen=True)
class Pose:
    """A frame in another one: position (3,), m, and rotation."""

    position: np.ndarray
    rotation: Rotation

    def __matmul__(self, other: "Pose") -> "Pose":
        """Composes a pose in this frame with this one: the same pose in the frame that this one is
        in.
        """
        return Pose(
            self.position + self.rotation.apply(other.position), self.rotation * other.rotation
        )

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """Position and quaternion (4,), (w, x, y, z)."""
        return self.position, self.rotation.as_quat(scalar_first=True)

    def inverse(self) -> "Pose":
        """The other frame in this one."""
        return Pose(-self.rotation.inv().apply(self.position), self.rotation.inv())


class Sensors:
    """Newest measurements of the topics, in the world frame; None or NaN for missing and outdated
    ones.
    """

    def __init__(self, arguments: "Arguments", joints: list[str], object_age: float):
        """Reads the names and offsets.

        Args:
          arguments: options of the node.
          joints: names of the hand's joints.
          object_age: seconds after which the object or the cloud counts as not measured.

        Raises:
          CongraspError: an offset or a pair of joints cannot be read.
        """
        renamed = joints_of(arguments.joint_map, joints)
        self.names = [renamed.get(joint, joint) for joint in joints]
        """The robot's names of the joints, in the hand's order."""
        self.mount, self._hand_eye = offset_of(arguments.mount), offset_of(arguments.hand_eye)
        self.eyes = arguments.cloud_topic or "object_pose"
        """The topic that shows the object."""
        self.unseen = ""
        """Reason that no object was found in that topic's messages; empty if one was."""
        self.clock: float | None = None
        """Simulated time, s; None where no simulator publishes `clock`."""
        self._unsynchronised = False
        self._world, self._ages = arguments.world, dict.fromkeys(INPUTS, arguments.robot_age)
        self._ages[self.eyes] = object_age
        self._joints: dict[str, tuple[float, float, float]] = {}
        self._newest: dict[str, tuple[Any, float]] = {}
        self._frames: dict[str, tuple[str, Pose, float]] = {}

    def take(self, received: list[tuple[str, Any]]) -> None:
        """Stores received messages."""
        for topic, message in sorted(received, key=lambda pair: pair[0] != "clock"):
            if topic == "clock":
                self.clock = seconds(message.clock)
            elif topic == "joint_states":
                velocity = (
                    message.velocity
                    if len(message.velocity) == len(message.name)
                    else [np.nan] * len(message.name)
                )
                rows = zip(message.name, message.position, velocity, strict=False)
                self._joints |= {
                    name: (q, v, self._when(topic, message.header)) for name, q, v in rows
                }
            elif INPUTS.get(topic) != FRAMES:
                self._newest[topic] = message, self._when(topic, message.header)
            else:
                for part in message.transforms:
                    pose = read_pose(part.transform.translation, part.transform.rotation)
                    when = np.inf if topic == "tf_static" else self._when(topic, part.header)
                    if pose is not None:
                        self._frames[part.child_frame_id] = part.header.frame_id, pose, when

    def joints(self) -> np.ndarray:
        """(2, F) angles and velocities, rad and rad/s."""
        earliest = time.monotonic() - self._ages["joint_states"]
        rows = (self._joints.get(name, (np.nan, np.nan, -np.inf)) for name in self.names)
        return np.array([(q, v) if when >= earliest else (np.nan, np.nan) for q, v, when in rows]).T

    def palm(self) -> Pose | None:
        """The palm in the world."""
        message, frame = self._framed("wrist_pose")
        pose = frame and read_pose(message.pose.position, message.pose.orientation)
        return frame @ pose @ self.mount if frame and pose else None

    def sight(self) -> tuple[Any, Pose | None]:
        """The newest message that shows the object, and the camera's frame in the world; no frame
        if too old.
        """
        message, frame = self._framed(self.eyes)
        return message, frame and frame @ self._hand_eye

    def missing(self) -> str:
        """Text that lists the missing measurements; empty if there are none."""
        lacking = []
        if absent := [
            name for name, q in zip(self.names, self.joints()[0], strict=True) if not np.isfinite(q)
        ]:
            others = ", ".join(sorted(set(self._joints) - set(absent))) or "none"
            lacking.append(
                f"the joints {', '.join(absent)} in joint_states (there: {others}; see --joint-map)"
            )
        for topic, found in (("wrist_pose", self.palm()), (self.eyes, self.sight()[1])):
            message, when = self._newest.get(topic, (None, 0.0))
            if message is None:
                lacking.append(topic)
            elif time.monotonic() - when > self._ages[topic]:
                lacking.append(
                    f"{topic} (the last one is {time.monotonic() - when:.1f} s old by its stamp)"
                )
            elif found is None:
                lacking.append(
                    f"{topic}: a pose, and tf from its frame '{message.header.frame_id}' to "
                    f"'{self._world}'"
                )
            elif topic == self.eyes and self.unseen:
                lacking.append(f"{topic}: {self.unseen}")
        return "; ".join(lacking)

    def _when(self, topic: str, header: Any) -> float:
        """See `stamped`; reports the first stamp of a simulator that publishes no clock."""
        if self.clock is None and 0 < seconds(header.stamp) < _EPOCH and not self._unsynchronised:
            self._unsynchronised = True
            print(
                f"{topic}: its stamps are a simulator's, which publishes no clock: messages count "
                f"from their arrival.",
                file=sys.stderr,
            )
        return stamped(header, self.clock)

    def _framed(self, topic: str) -> tuple[Any, Pose | None]:
        """A topic's newest message, and the pose of its frame in the world; no pose if it is too
        old.
        """
        message, when = self._newest.get(topic, (None, -np.inf))
        fresh = time.monotonic() - when <= self._ages[topic]
        return message, self._frame(message.header.frame_id) if fresh else None

    def _frame(self, name: str) -> Pose | None:
        """A frame in the world; None if no chain of fresh transforms leads there."""
        pose = Pose(np.zeros(3), Rotation.identity())
        for _ in range(len(self._frames) + 1):
            if name in ("", self._world):
                return pose
            name, own, when = self._frames.get(name, (name, pose, -np.inf))
            if time.monotonic() - when > self._ages["tf"]:
                return None
            pose = own @ pose
        return None


def seconds(stamp: Any) -> float:
    """A message's time in s."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def stamped(header: Any, clock: float | None = None) -> float:
    """Time of a message's stamp on the clock of `time.monotonic`; now if it has no stamp, or one in
    the future.

    Args:
      header: the message's.
      clock: simulated time, s, to which stamps refer. Without it they refer to the time of day;
        those of a simulator then count as now.
    """
    stamp = seconds(header.stamp)
    now = time.time() if clock is None else clock
    timed = stamp > 0 if clock is not None else stamp > _EPOCH
    return time.monotonic() - (max(now - stamp, 0.0) if timed else 0.0)


def read_pose(place: Any, turn: Any) -> Pose | None:
    """The pose of a message's vector and quaternion; None if it is not finite, or the quaternion is
    far from unit.
    """
    position, quaternion = (
        np.array([place.x, place.y, place.z]),
        np.array([turn.x, turn.y, turn.z, turn.w]),
    )
    if not (np.isfinite(position).all() and 0.5 < np.linalg.norm(quaternion) < 2.0):
        return None
    return Pose(position, Rotation.from_quat(quaternion))


def offset_of(text: str) -> Pose:
    """The pose of X Y Z ROLL PITCH YAW, metres and degrees.

    Raises:
      CongraspError: the text is no such six numbers.
    """
    try:
        x, y, z, *angles = map(float, text.split())
        return Pose(np.array([x, y, z]), Rotation.from_euler("xyz", angles, degrees=True))
    except ValueError:
        raise congrasp.CongraspError(
            f"'{text}' is no offset.", "Write X Y Z ROLL PITCH YAW: 0 0 0.1 0 0 90."
        ) from None


def joints_of(pairs: tuple[str, ...], joints: list[str]) -> dict[str, str]:
    """The robot's names of the hand's joints, from HAND=ROBOT pairs.

    Raises:
      CongraspError: a pair names none of the hand's joints, or no joint of the robot.
    """
    renamed = {hand: robot for hand, _, robot in (pair.partition("=") for pair in pairs)}
    for hand, robot in renamed.items():
        if hand not in joints or not robot:
            raise congrasp.CongraspError(
                f"--joint-map has '{hand}={robot}'.",
                f"Write HAND=ROBOT; the hand's are {', '.join(joints)}.",
            )
    return renamed
