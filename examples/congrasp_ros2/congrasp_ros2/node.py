"""A ROS 2 node between a policy server and a robot; without ROS 2 the same messages go over Zenoh.

    congrasp serve --policy allegro-student
    ros2 run congrasp_ros2 grasp_node mug:7 --hand allegro --dry-run    # with rclpy
    # with zenoh-bridge-ros2dds, or a robot that uses Zenoh:
    grasp_node mug:7 --hand allegro --zenoh tcp/127.0.0.1:7447

| topic | type | what |
|---|---|---|
| in: `joint_states` | sensor_msgs/JointState | the finger joints, by name, any order |
| in: `wrist_pose` | geometry_msgs/PoseStamped | pose of the palm, or of the flange with `--mount` |
| in: `object_pose` | geometry_msgs/PoseStamped | the frame of the object's file |
| in: `--cloud-topic` | sensor_msgs/PointCloud2 | instead of `object_pose`, for a policy with a
camera |
| in: `tf`, `tf_static` | tf2_msgs/TFMessage | the frames of these poses in `--world`: z up, the
table at z = 0 |
| in: `clock` | rosgraph_msgs/Clock | a simulator's time, to which all stamps then refer; the time
of day otherwise |
| out: `joint_command` | sensor_msgs/JointState | finger targets (`position`) and torques (`effort`)
|
| out: `wrist_command` | geometry_msgs/PoseStamped | target pose of the palm, or of the flange with
`--mount`, in `--world` |

The episode begins at the hand's current pose when all inputs have arrived. The hand must then be
open and in front of the object. Commands keep to the limits in the server's metadata. While a topic
or the policy is silent, the hand holds its last targets. If the silence lasts, it freezes, or opens
if the object was not lifted, until the node is restarted. The node supports hands with a motor for
each joint.
"""

import contextlib
import dataclasses
import pathlib
import sys
import time
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Protocol

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

import congrasp
from congrasp.common.hands import get_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.sampling.headings import INWARD
from congrasp.services.assets.objects.named import find_object
from congrasp.services.cli.grasp import Constraints
from congrasp.services.grasp.parse import read_request
from congrasp.services.ops.logs import announce_progress
from congrasp_ros2.bus import CLOUD, INPUTS, JOINTS, POSE, Bus, RosBus, ZenohBus
from congrasp_ros2.cloud import Eye, labelled, seen_object
from congrasp_ros2.sensors import Pose, Sensors, read_pose

WAITING = 2.0
"""Seconds after which the node prints what it is waiting for."""
LIFT_SPEED = 0.1
"""Mean speed of the lift, m/s."""
_POLL, _TOGETHER = 0.0005, 0.001
"""Seconds between two polls of the topics, and within which measurements of one moment arrive."""
_MET = 0.01  # m around the line of approach within which the surface is met
SETTLING_STEPS = 100
"""Control steps after the rise until the targets freeze."""
TRACKER_AGE = 0.5
"""Greatest age of a student's object or cloud, s: it was trained with 10 Hz, 100 ms delay and lost
samples.
"""


@dataclasses.dataclass
class Arguments:
    """Options of the node."""

    object: tyro.conf.Positional[str] = ""
    """A mesh, an object file, or FAMILY:SEED; none for a policy with a camera."""
    hand: str = "allegro"
    """Name of the hand."""
    constraint: Annotated[Constraints, tyro.conf.OmitArgPrefixes] = dataclasses.field(
        default_factory=Constraints
    )
    """Constraints on the grasp, in `--world` for a policy with a camera; without a heading the hand
    approaches along -z."""
    connect: str = "tcp/127.0.0.1:7457"
    """The policy server's endpoint."""
    wait: float = 120.0
    """Seconds to wait for the server, which compiles its policy first."""
    certs: pathlib.Path | None = None
    """Folder of a client's certificate, for a server that asks for one."""
    zenoh: str = ""
    """Endpoint of a Zenoh router, bridge or robot; ROS 2 otherwise."""
    joint_map: tuple[str, ...] = ()
    """HAND=ROBOT pairs: the robot's names of joints that it names differently."""
    world: str = "world"
    """Name of the world frame."""
    cloud_topic: str = ""
    """Topic of the camera's point clouds, for a policy with a camera."""
    box: str = "0 0 0.2 0.5 0.5 0.4"
    """X Y Z DX DY DZ: middle and sides of the box in `--world` whose points are the object's, m."""
    mount: str = "0 0 0 0 0 0"
    """X Y Z ROLL PITCH YAW of the palm in the frame of `wrist_pose`: metres, degrees."""
    hand_eye: str = "0 0 0 0 0 0"
    """X Y Z ROLL PITCH YAW of the true camera frame in the frame of its messages: metres,
    degrees.
    """
    approach: float = 0.0
    """Seconds of fresh answers, at full speed, until the object may leave the table; 0: twice as
    long as in training, since the hand is slower by what the robot is late."""
    lift: float = 0.0
    """Metres by which the hand then rises; a second after the rise its targets freeze."""
    slow: float = 1.0
    """Share of the speed: of the policy's steps and of the limits; 0.25 to begin with."""
    dry_run: bool = False
    """Publish nothing; print once a second what would be commanded."""
    stale: float = 0.05
    """Seconds that the state of an answer may be old; more over slow networks."""
    hold: float = 0.5
    """Seconds without an answer after which the hand freezes or opens."""
    robot_age: float = 0.1
    """Seconds after which joints and wrist count as not measured, from their stamps; without a
    stamp, from arrival.
    """
    object_age: float = 0.0
    """The same for object or cloud; 0: as `--robot-age`, or 0.5 for a student (10 Hz, 100 ms, lost
    samples).
    """


Read = Callable[[GraspObject, np.ndarray], congrasp.GraspRequest]
"""Reads the constraints on an object whose middle (3,) is given."""


class Target(Protocol):
    """The object, as the policy observes it."""

    def fields(self, down: Pose, palm: Pose | None, q: np.ndarray) -> dict[str, np.ndarray]:
        """The state's fields of the object; not finite where it is not measured.

        Args:
          down: the world in the frame that rises with the hand.
          palm: the palm in the world; None if it is not measured.
          q: (F,) finger angles, rad.
        """
        ...

    def request(self, fields: dict[str, np.ndarray]) -> congrasp.GraspRequest:
        """The request for an object with these fields, without the hand's pose."""
        ...


class Tracked:
    """An object whose pose is measured."""

    def __init__(self, sensors: Sensors, request: congrasp.GraspRequest, origin: np.ndarray):
        """Stores the request.

        Args:
          sensors: the measurements.
          request: constraints and surface, without poses.
          origin: (3,) coordinates of the file's origin in the object frame, m.
        """
        self._sensors, self._request = sensors, request
        self._centre = Pose(-np.asarray(origin), Rotation.identity())

    def fields(self, down: Pose, palm: Pose | None, q: np.ndarray) -> dict[str, np.ndarray]:
        """See `Target.fields`."""
        message, frame = self._sensors.sight()
        pose = frame and read_pose(message.pose.position, message.pose.orientation)
        found = (
            (down @ frame @ pose @ self._centre).arrays()
            if frame and pose
            else (np.full(3, np.nan), np.full(4, np.nan))
        )
        return dict(zip(("object_position", "object_quaternion"), found, strict=True))

    def request(self, fields: dict[str, np.ndarray]) -> congrasp.GraspRequest:
        """See `Target.request`."""
        return dataclasses.replace(
            self._request, object_pose=(fields["object_position"], fields["object_quaternion"])
        )


class Pictured:
    """An object of which a camera sees a part."""

    def __init__(self, sensors: Sensors, eye: Eye, read: Read):
        self._sensors, self._eye, self._read = sensors, eye, read
        self._first: tuple[np.ndarray, np.ndarray] | None = None

    def fields(self, down: Pose, palm: Pose | None, q: np.ndarray) -> dict[str, np.ndarray]:
        """See `Target.fields`."""
        message, frame = self._sensors.sight()
        if frame and palm and np.isfinite(q).all():
            self._eye.look(message, down @ frame, down @ palm, q)
        points = self._eye.points
        self._sensors.unseen = self._eye.seen if points is None else ""
        if frame is None or points is None:
            return {"cloud": np.full((1, 3), np.nan)}
        avoid = {"surface_avoid": labelled(points, *self._first)} if self._first else {}
        return {"cloud": points, **self._eye.camera, **avoid}

    def request(self, fields: dict[str, np.ndarray]) -> congrasp.GraspRequest:
        """See `Target.request`."""
        points = fields["cloud"]
        request = self._read(seen_object(points), points.mean(0))
        self._first = None if request.avoid is None else (points, request.avoid)
        return dataclasses.replace(request, cloud=points, camera=fields.get("camera_position"))


class PolicyNode:
    """Commands of a guarded policy, from the measurements of the topics.

    Attributes:
      guard: the guarded policy.
      sensors: the measurements.
      plan: course of the episode.
      followed: control steps that followed an answer.
    """

    def __init__(
        self, bus: Bus, guard: congrasp.Guard, sensors: Sensors, target: Target, plan: "Plan"
    ):
        self.guard = guard
        self.sensors = sensors
        self.plan = plan
        self.followed = 0
        self._bus = bus
        self._target = target
        self._base: Pose | None = None
        self._last = time.monotonic()

    def wait(self, period: float) -> float:
        """Waits for the joints of the coming control step, at most half a period longer; returns
        the time then.

        Steps that are not in time with the measurements see some of them twice and others never,
        and are late by up to a period: with both, a policy loses its grasp.
        """
        due = self._last + period
        while (now := time.monotonic()) < due + 0.5 * period:
            received = self._bus.receive()
            self.sensors.take(received)
            if now >= due - 0.5 * period and any(topic == "joint_states" for topic, _ in received):
                time.sleep(_TOGETHER)
                break
            time.sleep(_POLL)
        self._last = time.monotonic()
        return self._last

    def step(self) -> congrasp.Command | None:
        """Reads the topics and commands; None until the episode has begun."""
        sensors = self.sensors
        sensors.take(self._bus.receive())
        (q, velocity), palm = sensors.joints(), sensors.palm()
        # The policy rises with the hand
        down = Pose(-self.plan.rise(self.followed), Rotation.identity())
        seen = self._target.fields(down, palm, q)
        if self._base is None:
            if palm is None or not all(np.isfinite(x).all() for x in (q, *seen.values())):
                return None
            self._base = palm
            self.guard.reset(
                dataclasses.replace(self._target.request(seen), q=q, wrist=palm.arrays())
            )
        if self.plan.lifted(self.followed):
            self.guard.freeze()
        table = np.asarray(self.followed < self.plan.approach_steps)
        state = {
            "q": q,
            "time": np.asarray(self.plan.time(self.followed)),
            "table": table,
            **seen,
        }
        if np.isfinite(velocity).all():
            state["q_velocity"] = velocity
        if palm is not None:
            moved = self._base.inverse() @ down @ palm
            state["u"] = np.append(moved.position, moved.rotation.as_euler("XYZ"))
        command = self.guard.step(state)
        if not self.plan.dry_run:
            self._publish(command, down)
        self.followed += command.mode == "follow"
        return command

    def _publish(self, command: congrasp.Command, down: Pose) -> None:
        """Sends the targets."""
        assert self._base is not None
        make, clock = self._bus.make, self.sensors.clock
        stamp = time.time_ns() if clock is None else round(1e9 * clock)
        now = make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        header = make("std_msgs/msg/Header", stamp=now, frame_id=self.plan.world)
        position, effort = command.q_target.tolist(), command.q_torque.tolist()
        joints = make(
            JOINTS,
            header=header,
            name=self.sensors.names,
            position=position,
            velocity=[],
            effort=effort,
        )
        palm = self._base @ Pose(
            command.u_target[:3], Rotation.from_euler("XYZ", command.u_target[3:])
        )
        carrier = down.inverse() @ palm @ self.sensors.mount.inverse()
        place, turn = carrier.position.tolist(), carrier.rotation.as_quat().tolist()
        pose = make(
            "geometry_msgs/msg/Pose",
            position=make("geometry_msgs/msg/Point", **dict(zip("xyz", place, strict=True))),
            orientation=make(
                "geometry_msgs/msg/Quaternion", **dict(zip("xyzw", turn, strict=True))
            ),
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
    trained_steps: int
    """The same in the policy's training."""
    lift: float
    """Height by which the hand then rises, m."""
    step: float
    """Mean rise per control step, m."""
    dry_run: bool

    def rise(self, followed: int) -> np.ndarray:
        """(3,) rise of the hand after a number of control steps, m: a smooth step."""
        share = (
            np.clip((followed - self.approach_steps) * self.step / self.lift, 0.0, 1.0)
            if self.lift
            else 0.0
        )
        return np.array([0.0, 0.0, self.lift * share**2 * (3.0 - 2.0 * share)])

    def time(self, followed: int) -> float:
        """Control steps on the policy's clock, which runs slower or faster until the object may
        leave the table.
        """
        over = followed - self.approach_steps
        return self.trained_steps + (
            over if over > 0 else over * self.trained_steps / self.approach_steps
        )

    def lifted(self, followed: int) -> bool:
        """True a second after the end of the rise: no policy was trained to hold longer than two
        seconds.
        """
        steps = self.approach_steps + self.lift / self.step + SETTLING_STEPS
        return self.lift > 0.0 and followed >= steps


def slowed(limits: congrasp.JointLimits, share: float) -> congrasp.JointLimits:
    """Limits of a hand that moves at a share of the speed."""
    return dataclasses.replace(
        limits, speed=limits.speed * share, acceleration=limits.acceleration * share**2
    )


def below_surface(points: np.ndarray, middle: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """(3,) m, where a hand's centre that moves along `direction` towards the middle should stop.

    As in training this is `INWARD` below the surface (N, 3) that it meets: the fingers do not reach
    the middle of a thick object. A thin one is grasped at its middle.
    """
    ahead = (points - middle) @ direction
    off = np.linalg.norm(points - middle - ahead[:, None] * direction, axis=1)
    met = ahead[off <= max(_MET, 1.5 * off.min())].min()
    return np.asarray(middle + min(met + INWARD, 0.0) * direction)


def target_of(
    arguments: Arguments, sensors: Sensors, hand: Hand, described: dict[str, Any]
) -> Target:
    """The object, as a policy with this metadata observes it."""
    camera = described["observation"] == "camera"
    if camera != bool(arguments.cloud_topic) or camera == bool(arguments.object):
        raise congrasp.CongraspError(
            f"The server's policy observes "
            f"{'a point cloud' if camera else 'the pose of an object'}.",
            "Set --cloud-topic and name no object."
            if camera
            else "Name an object and leave out --cloud-topic.",
        )

    def read(obj: GraspObject, middle: np.ndarray) -> congrasp.GraspRequest:
        """The constraints on an object; by default the hand comes down towards its middle (3,)."""
        request = read_request(
            obj, hand, described["trajectory_points"], **dataclasses.asdict(arguments.constraint)
        )
        heading = {"direction": np.array([0.0, 0.0, -1.0]), **request.constraints["heading"]}
        heading = {"position": below_surface(obj.points, middle, heading["direction"]), **heading}
        return dataclasses.replace(request, constraints={**request.constraints, "heading": heading})

    if camera:
        return Pictured(
            sensors, Eye(hand, described["surface_points"], arguments.box, arguments.world), read
        )
    obj = find_object(arguments.object)
    request = dataclasses.replace(read(obj, np.zeros(3)), surface=obj.points)
    return Tracked(sensors, request, np.asarray(obj.origin))


def run(
    arguments: Arguments, bus: Bus, client: congrasp.PolicyClient, described: dict[str, Any]
) -> None:
    """Commands the robot by a policy with this metadata until interrupted, and prints changes of
    the mode.
    """
    slow = arguments.slow
    if described["limits"] is None:
        raise congrasp.CongraspError(
            f"Joints of the hand '{arguments.hand}' share motors.", "This node is for others."
        )
    period, hand = described["period"] / slow, get_hand(arguments.hand)
    student = described["observation"] in ("tracked", "camera")
    object_age = arguments.object_age or (TRACKER_AGE if student else arguments.robot_age)
    sensors = Sensors(arguments, described["joints"], object_age)
    target = target_of(arguments, sensors, hand, described)
    trained = described["approach_steps"]
    steps = round(arguments.approach / described["period"]) or 2 * trained
    plan = Plan(
        arguments.world,
        steps,
        trained,
        arguments.lift,
        LIFT_SPEED * described["period"],
        arguments.dry_run,
    )
    limits = slowed(congrasp.JointLimits(**described["limits"]), slow)
    times = {
        "period": period,
        "wait": 0.6 * period,
        "stale": arguments.stale / slow,
        "hold": arguments.hold / slow,
    }
    with congrasp.Guard(
        client, limits, np.array(described["open_pose"]), fallback="open", **times
    ) as guard:
        node, printed = PolicyNode(bus, guard, sensors, target, plan), ""
        begin = last = time.monotonic()
        try:
            while True:
                now, command = node.wait(period), node.step()
                waiting = "wait" if now > begin + WAITING else ""
                mode = waiting if command is None else command.mode
                if mode != printed or (
                    mode in ("wait", "follow") and arguments.dry_run and now > last + 1.0
                ):
                    print(report(command, guard, sensors), flush=True)
                    printed, last = mode, now
        except KeyboardInterrupt:
            print(guard.counters)


def report(command: congrasp.Command | None, guard: congrasp.Guard, sensors: Sensors) -> str:
    """One line of text on the node's state."""
    missing = sensors.missing()
    if command is None:
        return f"Waiting for {missing}."
    if command.mode != "follow":
        return f"{command.mode}: {guard.trouble or missing}"
    way, turn = np.linalg.norm(command.u_target.reshape(2, 3), axis=1)
    return (
        f"follow: the wrist is to be {100 * way:.1f} cm and {np.degrees(turn):.0f} degrees from "
        f"where it began"
    )


def without_ros_arguments(words: Sequence[str]) -> list[str]:
    """Returns the node's own words of a command line: rclpy reads those from --ros-args to `--`, or
    to the end, such as names and remappings of a launch file.
    """
    own = []
    is_of_ros = False
    for word in words:
        if word == "--ros-args":
            is_of_ros = True
        elif is_of_ros and word == "--":
            is_of_ros = False
        elif not is_of_ros:
            own.append(word)
    return own


def main() -> int:
    """Entry point of the node: an error ends it with one line."""
    try:
        return serve(without_ros_arguments(sys.argv[1:]))
    except congrasp.CongraspError as error:
        sys.exit(str(error))


def serve(words: Sequence[str]) -> int:
    """Runs the node with these options until it is interrupted."""
    arguments = tyro.cli(Arguments, description=__doc__, args=words)
    if not 0.0 < arguments.slow <= 1.0 or not 0.0 <= arguments.lift <= 0.3:
        raise congrasp.CongraspError("--slow is above 0 and at most 1, --lift from 0 to 0.3 m.")
    with contextlib.ExitStack() as stack:
        inputs = {**INPUTS, **({arguments.cloud_topic: CLOUD} if arguments.cloud_topic else {})}
        made = ZenohBus(arguments.zenoh, inputs) if arguments.zenoh else RosBus(inputs)
        bus: Bus = stack.enter_context(contextlib.closing(made))
        with announce_progress(
            f"Waiting for the policy server at {arguments.connect}", first=WAITING
        ):
            client = stack.enter_context(
                congrasp.PolicyClient(
                    arguments.connect,
                    hand=arguments.hand,
                    timeout=0.2,
                    wait=arguments.wait,
                    certs=arguments.certs,
                )
            )
            described = client.metadata()
        run(arguments, bus, client, described)
    return 0


if __name__ == "__main__":
    sys.exit(main())
