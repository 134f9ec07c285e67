"""A ROS 2 node between a policy server and a robot; without ROS 2 the same messages go over Zenoh.

    congrasp serve --hand allegro
    python examples/ros2_node.py mug:7 --hand allegro                                 # where there is rclpy
    python examples/ros2_node.py mug:7 --hand allegro --zenoh tcp/127.0.0.1:7447      # zenoh-bridge-ros2dds, or a robot

| topic | type | what |
|---|---|---|
| in: `joint_states` | sensor_msgs/JointState | the finger joints, by name, any order |
| in: `wrist_pose` | geometry_msgs/PoseStamped | the hand's palm in the world: z up, the table's top at z = 0 |
| in: `object_pose` | geometry_msgs/PoseStamped | the frame of the object's file in the world |
| out: `joint_command` | sensor_msgs/JointState | finger targets (`position`) and torques (`effort`) |
| out: `wrist_command` | geometry_msgs/PoseStamped | where the palm should be |

The episode begins where the hand is when all three have come: before the object, open. Commands keep to the limits of
`congrasp.JointLimits`; while a topic is silent, or the policy, the hand holds and then opens, and stays open until the
node is started again. It is for hands with a motor for each joint. Over Zenoh the messages are CDR as in ROS 2, under
the topics' names, as zenoh-bridge-ros2dds has them.
"""

import contextlib
import dataclasses
import importlib
import pathlib
import sys
import time
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

import congrasp
from congrasp.common.hands import get_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.services.assets.objects.named import find_object

JOINTS, POSE = "sensor_msgs/msg/JointState", "geometry_msgs/msg/PoseStamped"
INPUTS = {"joint_states": JOINTS, "wrist_pose": POSE, "object_pose": POSE}
OUTPUTS = {"joint_command": JOINTS, "wrist_command": POSE}
Pose = tuple[np.ndarray, Rotation]
SILENT = 0.1
"""Seconds after which what a topic said last does not count any more."""


@dataclasses.dataclass
class Arguments:
    """What is grasped, with what, and where the robot is."""

    object: tyro.conf.Positional[str]
    """A mesh, an object file, or FAMILY:SEED."""
    hand: str = "allegro"
    """Name of the hand."""
    heading: tuple[float, float, float] = (0.0, 0.0, -1.0)
    """The way in which the hand comes, in the object frame."""
    connect: str = "tcp/127.0.0.1:7457"
    """The policy server's endpoint."""
    certs: pathlib.Path | None = None
    """Folder of a client's certificate, for a server that asks for one."""
    zenoh: str = ""
    """Endpoint of a Zenoh router, bridge or robot; ROS 2 otherwise."""
    approach: float = 0.5
    """Seconds of fresh answers after which the object is no longer taken to stand on the table."""
    rate: float = 100.0
    """Hz."""


class Bus(Protocol):
    """Topics of typed messages."""

    def make(self, kind: str, **fields: Any) -> Any:
        """A message of a type such as `geometry_msgs/msg/Point`; numbers of an array come as a list."""
        ...

    def latest(self) -> dict[str, tuple[Any, float]]:
        """The newest message of every input that has come, and the time of `time.monotonic` when it came."""
        ...

    def publish(self, topic: str, message: Any) -> None:
        """Sends a message."""
        ...

    def close(self) -> None:
        """Ends the subscriptions."""
        ...


class RosBus:
    """Topics of ROS 2 through rclpy."""

    def __init__(self) -> None:
        self._rclpy, qos = importlib.import_module("rclpy"), importlib.import_module("rclpy.qos")
        self._rclpy.init()
        self._node = self._rclpy.create_node("congrasp")
        self._latest: dict[str, tuple[Any, float]] = {}
        newest = qos.QoSProfile(depth=1, reliability=qos.ReliabilityPolicy.BEST_EFFORT)  # takes reliable ones, too
        for topic, kind in INPUTS.items():
            self._node.create_subscription(self._type(kind), topic, self._keep(topic), newest)
        self._publishers = {t: self._node.create_publisher(self._type(k), t, 1) for t, k in OUTPUTS.items()}

    def make(self, kind: str, **fields: Any) -> Any:
        """See `Bus.make`."""
        return self._type(kind)(**fields)

    def latest(self) -> dict[str, tuple[Any, float]]:
        """See `Bus.latest`."""
        for _ in INPUTS:
            self._rclpy.spin_once(self._node, timeout_sec=0.0)
        return self._latest

    def publish(self, topic: str, message: Any) -> None:
        """See `Bus.publish`."""
        self._publishers[topic].publish(message)

    def close(self) -> None:
        """See `Bus.close`."""
        self._node.destroy_node()
        self._rclpy.try_shutdown()

    def _type(self, kind: str) -> Any:
        """The class of a message."""
        package, folder, name = kind.split("/")
        return getattr(importlib.import_module(f"{package}.{folder}"), name)

    def _keep(self, topic: str) -> Callable[[Any], None]:
        """Takes a topic's messages."""

        def keep(message: Any) -> None:
            self._latest[topic] = message, time.monotonic()

        return keep


class ZenohBus:
    """The same topics over Zenoh, as CDR, which rosbags writes and reads."""

    def __init__(self, endpoint: str):
        import zenoh
        from rosbags.typesys import Stores, get_typestore
        from zenoh.handlers import RingChannel

        self._store = get_typestore(Stores.ROS2_HUMBLE)
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", f'["{endpoint}"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        self._session = zenoh.open(config)
        self._subscribers = {t: self._session.declare_subscriber(t, RingChannel(1)) for t in INPUTS}
        self._latest: dict[str, tuple[Any, float]] = {}

    def make(self, kind: str, **fields: Any) -> Any:
        """See `Bus.make`."""
        arrays = {name: np.array(x) for name, x in fields.items() if isinstance(x, list) and name != "name"}
        return self._store.types[kind](**{**fields, **arrays})

    def latest(self) -> dict[str, tuple[Any, float]]:
        """See `Bus.latest`; a message that is none of its topic's type does not count."""
        for topic, subscriber in self._subscribers.items():
            if (sample := subscriber.try_recv()) is not None:
                try:
                    message = self._store.deserialize_cdr(sample.payload.to_bytes(), INPUTS[topic])
                except Exception as error:
                    print(f"{topic}: not a {INPUTS[topic]} ({type(error).__name__})", file=sys.stderr)
                    continue
                self._latest[topic] = message, time.monotonic()
        return self._latest

    def publish(self, topic: str, message: Any) -> None:
        """See `Bus.publish`."""
        self._session.put(topic, bytes(self._store.serialize_cdr(message, OUTPUTS[topic])))

    def close(self) -> None:
        """See `Bus.close`."""
        self._session.close()


class PolicyNode:
    """Commands of a guarded policy for what the topics say."""

    def __init__(
        self, bus: Bus, guard: congrasp.Guard, hand: Hand, obj: GraspObject, heading: np.ndarray, approach_steps: int
    ):
        self._bus, self._guard, self._approach_steps = bus, guard, approach_steps
        self._names = [joint.name for joint in hand.joints]
        self._object, self._heading = obj, heading / np.linalg.norm(heading)
        self._base: tuple[np.ndarray, Rotation] | None = None
        self._followed = 0

    def step(self) -> congrasp.Command | None:
        """Reads the topics and commands; None until the episode has begun."""
        joints, palm, thing = self._read()
        if self._base is None and joints is not None and palm is not None and thing is not None:
            self._begin(joints, palm, thing)
        if self._base is None:
            return None
        command = self._guard.step(self._state(joints, palm, thing))
        self._followed += command.mode == "follow"
        self._publish(command)
        return command

    def _read(self) -> tuple[Any | None, Pose | None, Pose | None]:
        """Joints, palm and object as the topics say; None for one that is silent or says no pose."""
        now = time.monotonic()
        heard = {topic: message for topic, (message, came) in self._bus.latest().items() if now - came <= SILENT}
        palm, file = (pose_of(heard[topic]) if topic in heard else None for topic in ("wrist_pose", "object_pose"))
        thing = file and (file[0] - file[1].apply(self._object.origin), file[1])  # its frame is about its centre
        return heard.get("joint_states"), palm, thing

    def _begin(self, joints: Any, palm: Pose, thing: Pose) -> None:
        """Begins an episode where hand and object are, unless a joint is missing."""
        q = self._by_name(joints.name, joints.position)
        if not np.isfinite(q).all():
            return
        request = congrasp.GraspRequest(
            {"heading": {"position": np.zeros(3), "direction": self._heading}},
            surface=self._object.points,
            q=q,
            wrist=(palm[0], palm[1].as_quat(scalar_first=True)),
            object_pose=(thing[0], thing[1].as_quat(scalar_first=True)),
        )
        self._guard.reset(request)
        self._base = palm

    def _state(self, joints: Any | None, palm: Pose | None, thing: Pose | None) -> dict[str, np.ndarray]:
        """What `Policy.act` takes, as far as it is known."""
        assert self._base is not None
        state = {"table": np.asarray(self._followed < self._approach_steps)}
        if joints is not None:
            state["q"] = self._by_name(joints.name, joints.position)
            if len(joints.velocity) == len(joints.name):
                state["q_velocity"] = self._by_name(joints.name, joints.velocity)
        if palm is not None:
            back = self._base[1].inv()
            state["u"] = np.append(back.apply(palm[0] - self._base[0]), (back * palm[1]).as_euler("XYZ"))
        if thing is not None:
            state |= {"object_position": thing[0], "object_quaternion": thing[1].as_quat(scalar_first=True)}
        return state

    def _by_name(self, names: Any, values: Any) -> np.ndarray:
        """(F,) values in the hand's order; NaN for a joint that is not named."""
        given = dict(zip(names, values, strict=False))
        return np.array([given.get(name, np.nan) for name in self._names])

    def _publish(self, command: congrasp.Command) -> None:
        """Sends the targets."""
        assert self._base is not None
        make, (base, base_turn) = self._bus.make, self._base
        stamp = time.time_ns()
        now = make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        header = make("std_msgs/msg/Header", stamp=now, frame_id="world")
        position, effort = command.q_target.tolist(), command.q_torque.tolist()
        joints = make(JOINTS, header=header, name=self._names, position=position, velocity=[], effort=effort)
        place = base + base_turn.apply(command.u_target[:3])
        turn = (base_turn * Rotation.from_euler("XYZ", command.u_target[3:])).as_quat()
        pose = make(
            "geometry_msgs/msg/Pose",
            position=make("geometry_msgs/msg/Point", **dict(zip("xyz", place.tolist(), strict=True))),
            orientation=make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", turn.tolist(), strict=True))),
        )
        self._bus.publish("joint_command", joints)
        self._bus.publish("wrist_command", make(POSE, header=header, pose=pose))


def pose_of(message: Any) -> Pose | None:
    """Position and rotation of a PoseStamped; None if it is none."""
    place, turn = message.pose.position, message.pose.orientation
    position, quaternion = np.array([place.x, place.y, place.z]), np.array([turn.x, turn.y, turn.z, turn.w])
    if not (np.isfinite(position).all() and 0.5 < np.linalg.norm(quaternion) < 2.0):
        return None
    return position, Rotation.from_quat(quaternion)


def main() -> int:
    """Runs the node until it is interrupted."""
    arguments = tyro.cli(Arguments, description=__doc__)
    hand, ticker = get_hand(arguments.hand), congrasp.Ticker(arguments.rate)
    obj, heading, period = find_object(arguments.object), np.array(arguments.heading), 1.0 / arguments.rate
    if not np.linalg.norm(heading) > 0.0:
        raise congrasp.CongraspError("--heading is no direction.", "Give one, such as 0 0 -1.")
    limits, steps = congrasp.JointLimits.of_hand(hand), round(arguments.approach * arguments.rate)
    client = congrasp.PolicyClient(arguments.connect, hand=hand.name, timeout=0.2, certs=arguments.certs)
    with (
        congrasp.Guard(client, limits, hand.q_open, period=period, wait=0.6 * period, fallback="open") as guard,
        contextlib.closing(ZenohBus(arguments.zenoh) if arguments.zenoh else RosBus()) as bus,
    ):
        node, mode = PolicyNode(bus, guard, hand, obj, heading, steps), ""
        try:
            while True:
                ticker.wait()
                command = node.step()
                if command is not None and command.mode != mode:
                    mode = command.mode
                    print(f"{mode} {guard.trouble}".rstrip(), flush=True)
        except KeyboardInterrupt:
            print(f"{guard.counters}, {ticker.missed} deadlines missed")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except congrasp.CongraspError as error:
        sys.exit(str(error))
