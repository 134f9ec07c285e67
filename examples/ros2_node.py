"""A ROS 2 node between a policy server and a robot; without ROS 2 the same messages go over Zenoh.

    congrasp serve --hand allegro
    python examples/ros2_node.py mug:7 --hand allegro --dry-run                       # where there is rclpy
    python examples/ros2_node.py mug:7 --hand allegro --zenoh tcp/127.0.0.1:7447      # zenoh-bridge-ros2dds, or a robot

| topic | type | what |
|---|---|---|
| in: `joint_states` | sensor_msgs/JointState | the finger joints, by name, any order |
| in: `wrist_pose` | geometry_msgs/PoseStamped | what carries the hand; its palm without `--mount` |
| in: `object_pose` | geometry_msgs/PoseStamped | the frame of the object's file |
| in: `tf`, `tf_static` | tf2_msgs/TFMessage | the frames of these poses in `--world`: z up, the table at z = 0 |
| out: `joint_command` | sensor_msgs/JointState | finger targets (`position`) and torques (`effort`) |
| out: `wrist_command` | geometry_msgs/PoseStamped | where what carries the hand should be, in `--world` |

The episode begins where the hand is when all have come: before the object, open. Commands keep to the limits that the
server names. While a topic is silent, or the policy, the hand holds; then it freezes, or opens if nothing was lifted,
until the node is started again. It is for hands with a motor for each joint.
"""

import contextlib
import dataclasses
import pathlib
import sys
import time
from typing import Annotated, Any

import numpy as np
import tyro
from ros2_bus import INPUTS, JOINTS, POSE, Bus, RosBus, ZenohBus
from scipy.spatial.transform import Rotation

import congrasp
from congrasp.common.hands import get_hand
from congrasp.services.assets.objects.named import find_object
from congrasp.services.cli.grasp import Constraints
from congrasp.services.grasp.parse import read_request
from congrasp.services.ops.logs import announced

WAITING = 2.0
"""Seconds after which the node says what it waits for."""
LIFT_SPEED = 0.1
"""m/s, the mean."""
TRACKER_AGE = 0.5
"""Seconds that a student's object may be old: it learnt with 10 Hz, 100 ms, and samples that are lost."""


@dataclasses.dataclass(frozen=True)
class Pose:
    """A frame in another one: position (3,), m, and rotation."""

    position: np.ndarray
    rotation: Rotation

    def __matmul__(self, other: "Pose") -> "Pose":
        """A pose in this frame, in the other one."""
        return Pose(self.position + self.rotation.apply(other.position), self.rotation * other.rotation)

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """Position and quaternion (4,), (w, x, y, z)."""
        return self.position, self.rotation.as_quat(scalar_first=True)

    def inverse(self) -> "Pose":
        """The other frame in this one."""
        return Pose(-self.rotation.inv().apply(self.position), self.rotation.inv())


@dataclasses.dataclass
class Arguments:
    """What is grasped, with what, and where the robot is."""

    object: tyro.conf.Positional[str]
    """A mesh, an object file, or FAMILY:SEED."""
    hand: str = "allegro"
    """Name of the hand."""
    constraint: Annotated[Constraints, tyro.conf.OmitArgPrefixes] = dataclasses.field(default_factory=Constraints)
    """What the grasp must keep to; the hand comes along the object's -z axis where nothing guides it."""
    connect: str = "tcp/127.0.0.1:7457"
    """The policy server's endpoint."""
    wait: float = 120.0
    """Seconds to wait for the server, which compiles its policy first."""
    certs: pathlib.Path | None = None
    """Folder of a client's certificate, for a server that asks for one."""
    zenoh: str = ""
    """Endpoint of a Zenoh router, bridge or robot; ROS 2 otherwise."""
    joint_map: tuple[str, ...] = ()
    """HAND=ROBOT pairs: the robot's names of joints that it calls otherwise."""
    world: str = "world"
    """Name of the world frame."""
    mount: str = "0 0 0 0 0 0"
    """X Y Z ROLL PITCH YAW of the palm in the frame of `wrist_pose`: metres, degrees."""
    hand_eye: str = "0 0 0 0 0 0"
    """X Y Z ROLL PITCH YAW by which the camera is off, in its own frame: metres, degrees."""
    approach: float = 0.0
    """Seconds of fresh answers, at full speed, until the object may leave the table; 0: as in training."""
    lift: float = 0.0
    """Metres by which the hand then rises."""
    slow: float = 1.0
    """Share of the speed: of the policy's steps and of the limits; 0.25 to begin with."""
    dry_run: bool = False
    """Publish nothing; print once a second what would be commanded."""
    stale: float = 0.05
    """Seconds that the state of an answer may be old; more over slow networks."""
    hold: float = 0.5
    """Seconds without an answer after which the hand freezes or opens."""
    robot_age: float = 0.1
    """Seconds after which joints and wrist count as not measured, from their arrival and by their stamps."""
    object_age: float = 0.0
    """The same of the object; 0: that of the robot, or 0.5 for a student (10 Hz, 100 ms, lost samples)."""


class Sensors:
    """What the topics say, in the world frame; None or NaN for what is not there, or too old."""

    def __init__(self, arguments: Arguments, joints: list[str], origin: np.ndarray, object_age: float):
        """Args: names and offsets; the hand's joints; (3,) the object frame's origin in its file, m; s."""
        renamed = joints_of(arguments.joint_map, joints)
        self.names = [renamed.get(joint, joint) for joint in joints]
        """The robot's names of the joints, in the hand's order."""
        self.mount, self._hand_eye = offset_of(arguments.mount), offset_of(arguments.hand_eye)
        self._centre = Pose(-np.asarray(origin), Rotation.identity())
        self._world, self._ages = arguments.world, dict.fromkeys(INPUTS, arguments.robot_age)
        self._ages["object_pose"] = object_age
        self._joints: dict[str, tuple[float, float, float]] = {}
        self._poses: dict[str, tuple[Any, float]] = {}
        self._frames: dict[str, tuple[str, Pose, float]] = {}

    def take(self, received: list[tuple[str, Any]]) -> None:
        """Takes messages in."""
        for topic, message in received:
            if topic == "joint_states":
                velocity = (
                    message.velocity if len(message.velocity) == len(message.name) else [np.nan] * len(message.name)
                )
                rows = zip(message.name, message.position, velocity, strict=False)
                self._joints |= {name: (q, v, stamped(message.header)) for name, q, v in rows}
            elif INPUTS[topic] == POSE:
                self._poses[topic] = message, stamped(message.header)
            else:
                for part in message.transforms:
                    pose = read_pose(part.transform.translation, part.transform.rotation)
                    when = np.inf if topic == "tf_static" else stamped(part.header)
                    if pose is not None:
                        self._frames[part.child_frame_id] = part.header.frame_id, pose, when

    def joints(self) -> np.ndarray:
        """(2, F) angles and velocities, rad and rad/s."""
        earliest = time.monotonic() - self._ages["joint_states"]
        rows = (self._joints.get(name, (np.nan, np.nan, -np.inf)) for name in self.names)
        return np.array([(q, v) if when >= earliest else (np.nan, np.nan) for q, v, when in rows]).T

    def palm(self) -> Pose | None:
        """The palm in the world."""
        pose = self._pose("wrist_pose", Pose(np.zeros(3), Rotation.identity()))
        return pose and pose @ self.mount

    def object(self) -> Pose | None:
        """The object in the world."""
        pose = self._pose("object_pose", self._hand_eye)
        return pose and pose @ self._centre

    def missing(self) -> str:
        """What is not there, in words; empty when all is."""
        lacking = []
        if absent := [name for name, q in zip(self.names, self.joints()[0], strict=True) if not np.isfinite(q)]:
            others = ", ".join(sorted(set(self._joints) - set(absent))) or "none"
            lacking.append(f"the joints {', '.join(absent)} in joint_states (there: {others}; see --joint-map)")
        for topic, found in (("wrist_pose", self.palm()), ("object_pose", self.object())):
            message, when = self._poses.get(topic, (None, 0.0))
            if message is None:
                lacking.append(topic)
            elif time.monotonic() - when > self._ages[topic]:
                lacking.append(f"{topic} (the last one is {time.monotonic() - when:.1f} s old by its stamp)")
            elif found is None:
                lacking.append(f"{topic}: a pose, and tf from its frame '{message.header.frame_id}' to '{self._world}'")
        return "; ".join(lacking)

    def _pose(self, topic: str, offset: Pose) -> Pose | None:
        """A topic's pose in the world, by way of an offset of the frame that it is in."""
        message, when = self._poses.get(topic, (None, -np.inf))
        if time.monotonic() - when > self._ages[topic]:
            return None
        frame, pose = self._frame(message.header.frame_id), read_pose(message.pose.position, message.pose.orientation)
        return frame @ offset @ pose if frame and pose else None

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


class PolicyNode:
    """Commands of a guarded policy for what the topics say."""

    def __init__(self, bus: Bus, guard: congrasp.Guard, sensors: Sensors, request: congrasp.GraspRequest, plan: "Plan"):
        """Args: the request lacks where all is."""
        self._bus, self._guard, self._sensors, self._request, self._plan = bus, guard, sensors, request, plan
        self._base: Pose | None = None
        self._followed = 0

    def step(self) -> congrasp.Command | None:
        """Reads the topics and commands; None until the episode has begun."""
        sensors = self._sensors
        sensors.take(self._bus.receive())
        (q, velocity), palm, thing = sensors.joints(), sensors.palm(), sensors.object()
        if self._base is None:
            if palm is None or thing is None or not np.isfinite(q).all():
                return None
            self._base = palm
            self._guard.reset(dataclasses.replace(self._request, q=q, wrist=palm.arrays(), object_pose=thing.arrays()))
        state = {"q": q, "table": np.asarray(self._followed < self._plan.approach_steps)}
        if np.isfinite(velocity).all():
            state["q_velocity"] = velocity
        down = Pose(-self._plan.rise(self._followed), Rotation.identity())  # the policy rises with the hand
        if palm is not None:
            seen = self._base.inverse() @ down @ palm
            state["u"] = np.append(seen.position, seen.rotation.as_euler("XYZ"))
        if thing is not None:
            state["object_position"], state["object_quaternion"] = (down @ thing).arrays()
        command = self._guard.step(state)
        if not self._plan.dry_run:
            self._publish(command, down)
        self._followed += command.mode == "follow"
        return command

    def _publish(self, command: congrasp.Command, down: Pose) -> None:
        """Sends the targets."""
        assert self._base is not None
        make, stamp = self._bus.make, time.time_ns()
        now = make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        header = make("std_msgs/msg/Header", stamp=now, frame_id=self._plan.world)
        position, effort = command.q_target.tolist(), command.q_torque.tolist()
        joints = make(JOINTS, header=header, name=self._sensors.names, position=position, velocity=[], effort=effort)
        palm = self._base @ Pose(command.u_target[:3], Rotation.from_euler("XYZ", command.u_target[3:]))
        carrier = down.inverse() @ palm @ self._sensors.mount.inverse()
        place, turn = carrier.position.tolist(), carrier.rotation.as_quat().tolist()
        pose = make(
            "geometry_msgs/msg/Pose",
            position=make("geometry_msgs/msg/Point", **dict(zip("xyz", place, strict=True))),
            orientation=make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", turn, strict=True))),
        )
        self._bus.publish("joint_command", joints)
        self._bus.publish("wrist_command", make(POSE, header=header, pose=pose))


@dataclasses.dataclass(frozen=True)
class Plan:
    """The course of the episode."""

    world: str
    """Frame of the commands."""
    approach_steps: int
    """Control steps with fresh answers until the object may leave the table."""
    lift: float
    """m by which the hand then rises."""
    step: float
    """m of the way up in a control step, the mean."""
    dry_run: bool

    def rise(self, followed: int) -> np.ndarray:
        """(3,) m by which the hand has risen after so many control steps: a smooth step."""
        share = np.clip((followed - self.approach_steps) * self.step / self.lift, 0.0, 1.0) if self.lift else 0.0
        return np.array([0.0, 0.0, self.lift * share**2 * (3.0 - 2.0 * share)])


def stamped(header: Any) -> float:
    """When a message was stamped, by `time.monotonic`; now without a stamp, or with one that is yet to come."""
    stamp = header.stamp.sec + 1e-9 * header.stamp.nanosec
    return time.monotonic() - (max(time.time() - stamp, 0.0) if stamp else 0.0)


def read_pose(place: Any, turn: Any) -> Pose | None:
    """The pose of a message's vector and quaternion; None if it is none."""
    position, quaternion = np.array([place.x, place.y, place.z]), np.array([turn.x, turn.y, turn.z, turn.w])
    if not (np.isfinite(position).all() and 0.5 < np.linalg.norm(quaternion) < 2.0):
        return None
    return Pose(position, Rotation.from_quat(quaternion))


def offset_of(text: str) -> Pose:
    """The pose of X Y Z ROLL PITCH YAW, metres and degrees."""
    try:
        x, y, z, *angles = map(float, text.split())
        return Pose(np.array([x, y, z]), Rotation.from_euler("xyz", angles, degrees=True))
    except ValueError:
        raise congrasp.CongraspError(f"'{text}' is no offset.", "Write X Y Z ROLL PITCH YAW: 0 0 0.1 0 0 90.") from None


def joints_of(pairs: tuple[str, ...], joints: list[str]) -> dict[str, str]:
    """The robot's names of the hand's joints, from HAND=ROBOT."""
    renamed = {hand: robot for hand, _, robot in (pair.partition("=") for pair in pairs)}
    for hand, robot in renamed.items():
        if hand not in joints or not robot:
            raise congrasp.CongraspError(
                f"--joint-map has '{hand}={robot}'.", f"Write HAND=ROBOT; the hand's are {', '.join(joints)}."
            )
    return renamed


def slowed(limits: congrasp.JointLimits, share: float) -> congrasp.JointLimits:
    """Limits of a hand that does everything at a share of the speed."""
    return dataclasses.replace(limits, speed=limits.speed * share, acceleration=limits.acceleration * share**2)


def run(arguments: Arguments, bus: Bus, client: congrasp.PolicyClient, described: dict[str, Any]) -> None:
    """Commands by a policy and its metadata until it is interrupted, and prints what changes."""
    slow = arguments.slow
    if described["limits"] is None:
        raise congrasp.CongraspError(f"Joints of the hand '{arguments.hand}' share motors.", "This node is for others.")
    if described["observation"] == "camera":
        raise congrasp.CongraspError(
            "The server's policy observes a point cloud, this node an object's pose.",
            "Serve the hand's other policy or a student, or see examples/depth_grasp.py.",
        )
    obj, period = find_object(arguments.object), described["period"] / slow
    hand, waypoints = get_hand(arguments.hand), described["trajectory_points"]
    request = read_request(obj, hand, waypoints, **dataclasses.asdict(arguments.constraint))
    heading = {"position": np.zeros(3), "direction": np.array([0.0, 0.0, -1.0]), **request.constraints["heading"]}
    constraints = {**request.constraints, "heading": heading}
    request = dataclasses.replace(request, constraints=constraints, surface=obj.points)
    object_age = arguments.object_age or (TRACKER_AGE if described["observation"] == "tracked" else arguments.robot_age)
    sensors = Sensors(arguments, described["joints"], np.asarray(obj.origin), object_age)
    steps = round(arguments.approach / described["period"]) or described["approach_steps"]
    plan = Plan(arguments.world, steps, arguments.lift, LIFT_SPEED * described["period"], arguments.dry_run)
    limits = slowed(congrasp.JointLimits(**described["limits"]), slow)
    times = {"period": period, "wait": 0.6 * period, "stale": arguments.stale / slow, "hold": arguments.hold / slow}
    with congrasp.Guard(client, limits, np.array(described["open_pose"]), fallback="open", **times) as guard:
        node, ticker, printed = PolicyNode(bus, guard, sensors, request, plan), congrasp.Ticker(1.0 / period), ""
        begin = last = ticker.wait()
        try:
            while True:
                now, command = ticker.wait(), node.step()
                waiting = "wait" if now > begin + WAITING else ""
                mode = waiting if command is None else command.mode
                if mode != printed or (mode in ("wait", "follow") and arguments.dry_run and now > last + 1.0):
                    print(report(command, guard, sensors), flush=True)
                    printed, last = mode, now
        except KeyboardInterrupt:
            print(f"{guard.counters}, {ticker.missed} deadlines missed")


def report(command: congrasp.Command | None, guard: congrasp.Guard, sensors: Sensors) -> str:
    """What the node does, in a line."""
    missing = sensors.missing()
    if command is None:
        return f"Waiting for {missing}."
    if command.mode != "follow":
        return f"{command.mode}: {guard.trouble or missing}"
    way, turn = np.linalg.norm(command.u_target.reshape(2, 3), axis=1)
    return f"follow: the wrist is to be {100 * way:.1f} cm and {np.degrees(turn):.0f} degrees from where it began"


def main() -> int:
    """Runs the node until it is interrupted."""
    arguments = tyro.cli(Arguments, description=__doc__)
    if not 0.0 < arguments.slow <= 1.0 or not 0.0 <= arguments.lift <= 0.3:
        raise congrasp.CongraspError("--slow is above 0 and at most 1, --lift from 0 to 0.3 m.")
    with contextlib.ExitStack() as stack:
        bus: Bus = stack.enter_context(contextlib.closing(ZenohBus(arguments.zenoh) if arguments.zenoh else RosBus()))
        with announced(f"Waiting for the policy server at {arguments.connect}", first=WAITING):
            client = stack.enter_context(
                congrasp.PolicyClient(
                    arguments.connect, hand=arguments.hand, timeout=0.2, wait=arguments.wait, certs=arguments.certs
                )
            )
            described = client.metadata()
        run(arguments, bus, client, described)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except congrasp.CongraspError as error:
        sys.exit(str(error))
