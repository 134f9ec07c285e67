"""The example's node: its CDR over Zenoh is an independent implementation's, and with rclpy it is
the same node.
"""

import array
import contextlib
import functools
import re
import sys
import time
import types
from types import SimpleNamespace as Fields

import numpy as np
import pytest
import trimesh
import zenoh
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

import congrasp
from congrasp.common.hands import get_hand
from congrasp.common.hands.mjcf import mujoco_link_poses
from congrasp.common.objects import procedural
from congrasp.common.transport.ports import free_port
from congrasp.services.client.policy import Answer
from tests import examples
from tests.bare_zenoh import bare_session
from tests.waits import eventually

OUTPUTS = {
    "joint_command": "sensor_msgs/msg/JointState",
    "wrist_command": "geometry_msgs/msg/PoseStamped",
}
STORE = get_typestore(Stores.ROS2_HUMBLE)
HAND = get_hand("allegro")
NAMES = [joint.name for joint in HAND.joints]
BASE = np.array([0.1, -0.2, 0.3])
BASE_TURN = Rotation.from_euler("XYZ", [0.4, -0.3, 2.0])


@pytest.fixture(scope="module")
def example():
    return examples.example("ros2_node")


class SteadyPolicy:
    """Wants the same targets always, and keeps what it was told."""

    def __init__(self):
        self.request = None
        self.state = None
        self.now = 0.0
        self.wanted = HAND.q_open + 0.05, np.array([0.004, 0.0, -0.004, 0.02, 0.0, 0.01])

    def reset(self, request):
        self.request = request

    def act(self, state):
        self.state = state
        if not all(
            np.isfinite(state[name]).all()
            for name in ("q", "u", "object_position", "cloud")
            if name in state
        ):
            raise congrasp.RefusedError("not finite")
        return Answer(*self.wanted, np.zeros(22), 1, (), 0.0, 0.0)

    def close(self):
        pass


def header(frame="world", age=0.0):
    stamp = time.time_ns() - round(1e9 * age)
    return Fields(stamp=Fields(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id=frame)


def fields_of(position, rotation):
    x, y, z, w = map(float, rotation.as_quat())
    return Fields(**dict(zip("xyz", map(float, position), strict=True))), Fields(x=x, y=y, z=z, w=w)


def posed(position, rotation, **stamp):
    position, orientation = fields_of(position, rotation)
    return Fields(header=header(**stamp), pose=Fields(position=position, orientation=orientation))


def frame(child, parent, position, rotation, **stamp):
    translation, turn = fields_of(position, rotation)
    transform = Fields(translation=translation, rotation=turn)
    return Fields(header=header(parent, **stamp), child_frame_id=child, transform=transform)


def robot_says(obj):
    """Messages of a robot whose joints come in another order and with a stranger among them."""
    order = [*reversed(range(16))]
    names = [*(NAMES[i] for i in order), "elbow"]
    angles = [*HAND.q_open[order].tolist(), 0.7]
    joints = Fields(header=header(""), name=names, position=angles, velocity=[], effort=[])
    rotation = Rotation.from_euler("z", 0.5)
    elsewhere = Fields(header=header(""), name=["wheel"], position=[3.0], velocity=[], effort=[])
    return [
        ("joint_states", joints),
        ("joint_states", elsewhere),
        ("wrist_pose", posed(BASE, BASE_TURN)),
        ("object_pose", posed(np.array([0.0, 0.1, 0.05]) + rotation.apply(obj.origin), rotation)),
    ]


def check(policy, obj, commanded):
    """What the policy was told, and the commands (joints, wrist), against numbers worked out
    here.
    """
    np.testing.assert_allclose(policy.request.q, HAND.q_open, atol=1e-6)
    np.testing.assert_allclose(policy.request.object_pose[0], [0.0, 0.1, 0.05], atol=1e-6)
    np.testing.assert_allclose(
        policy.request.object_pose[1], [np.cos(0.25), 0, 0, np.sin(0.25)], atol=1e-6
    )
    np.testing.assert_allclose(policy.state["q"], HAND.q_open, atol=1e-6)
    np.testing.assert_allclose(policy.state["u"], np.zeros(6), atol=1e-6)
    joints, wrist = commanded
    q_wanted, u_wanted = policy.wanted
    assert list(joints.name) == NAMES
    assert len(joints.velocity) == 0
    np.testing.assert_allclose(joints.position, q_wanted, atol=1e-6)
    # Kp of Allegro, 0.05 rad ahead
    np.testing.assert_allclose(joints.effort, 3.0 * 0.05 * np.ones(16), atol=1e-5)
    place = wrist.pose.position
    turn = wrist.pose.orientation
    np.testing.assert_allclose(
        [place.x, place.y, place.z], BASE + BASE_TURN.as_matrix() @ u_wanted[:3], atol=1e-6
    )
    cos = np.cos([0.02, 0.01])
    sin = np.sin([0.02, 0.01])
    about_x = np.array([[1, 0, 0], [0, cos[0], -sin[0]], [0, sin[0], cos[0]]])
    about_z = np.array([[cos[1], -sin[1], 0], [sin[1], cos[1], 0], [0, 0, 1]])
    rotation = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    np.testing.assert_allclose(rotation, BASE_TURN.as_matrix() @ about_x @ about_z, atol=1e-6)
    assert wrist.header.frame_id == "world"
    assert abs(wrist.header.stamp.sec - time.time()) < 60


HOLD = 60.0
"""Seconds on the guard's clock until the fallback: a busy machine does not get there."""


@contextlib.contextmanager
def running(example, bus, arguments, age, lift, target):
    """A node with a steady policy, whose `now` is the guard's clock: 0.05 s pass whenever the node
    looks at its topics.

    `target` makes what the node grasps of its sensors.
    """
    policy = SteadyPolicy()
    limits = congrasp.JointLimits.of_hand(HAND)
    plan = example.Plan("world", 3, 3, lift, 0.02, arguments.dry_run)
    times = {"period": 0.05, "wait": 0.04, "stale": 0.2, "hold": HOLD, "clock": lambda: policy.now}
    receive = bus.receive

    def received():
        policy.now += 0.05
        return receive()

    bus.receive = received
    with congrasp.Guard(policy, limits, HAND.q_open, **times) as guard, contextlib.closing(bus):
        sensors = example.Sensors(arguments, NAMES, age)
        yield example.PolicyNode(bus, guard, sensors, target(sensors), plan), policy


@contextlib.contextmanager
def node_of(example, bus, lift=0.0, age=5.0, **options):
    """A node with a tracker, and the object that it grasps."""
    obj = procedural.generate(7)
    # On a machine with other work
    arguments = example.Arguments("capsule:7", robot_age=5.0, **options)
    request = congrasp.GraspRequest(surface=obj.points)
    make = lambda sensors: example.Tracked(sensors, request, obj.origin)  # noqa: E731
    with running(example, bus, arguments, age, lift, make) as (node, policy):
        yield node, policy, obj


class Wire:
    """A bus in this process: messages that are there at every step, and the last ones that were
    sent.
    """

    def __init__(self):
        self.said = []
        self.sent = {}

    def make(self, kind, **fields):
        return Fields(**fields)

    def receive(self):
        return self.said

    def publish(self, topic, message):
        self.sent[topic] = message

    def close(self):
        pass


def arrived(commands, policy):
    """True if the targets, which the limits slow down, rest where the policy wants them."""
    target = np.concatenate(policy.wanted)
    newest = [np.append(command.q_target, command.u_target) for command in commands[-2:]]
    return len(newest) == 2 and np.allclose(newest, target)


def schema(kind):
    return kind.replace("/msg", ""), STORE.generate_msgdef(kind, ros_version=2)[0]


def test_over_zenoh_robot_and_node_understand_each_other_s_cdr(example, capsys):
    """The robot's messages are written and read by mcap-ros2-support, the node's by rosbags; long
    ones share memory.
    """
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    write = {k: serialize_dynamic(*schema(k))[schema(k)[0]] for k in set(example.INPUTS.values())}
    read = {k: generate_dynamic(*schema(k))[schema(k)[0]] for k in set(OUTPUTS.values())}
    with (
        bare_session("peer", shared_memory=True, listen=endpoint) as robot,
        node_of(example, example.ZenohBus(endpoint), age=0.4) as (node, policy, obj),
    ):
        heard = {t: robot.declare_subscriber(t, zenoh.handlers.RingChannel(1)) for t in OUTPUTS}
        silent = []
        commands = []

        def turn():
            """The robot sends and the node acts; returns True if it follows its policy."""
            for topic, message in robot_says(obj):
                if topic not in silent:
                    robot.put(topic, write[example.INPUTS[topic]](message))
            command = node.step()
            if command is None:
                return False
            commands.append(command)
            return command.mode == "follow"

        def refused():
            robot.put("joint_states", b"\x00\x01\x00\x00nonsense" * 1000)
            assert node.step() is None
            return "joint_states: not a sensor_msgs/msg/JointState" in capsys.readouterr().err

        eventually(refused)
        eventually(lambda: turn() and arrived(commands, policy))
        turn()
        newest = {
            t: eventually(lambda s=s: s.try_recv()).payload.to_bytes() for t, s in heard.items()
        }
        check(policy, obj, [read[OUTPUTS[t]](payload) for t, payload in newest.items()])
        silent.append("object_pose")

        def is_refused():
            turn()
            return node.guard.trouble

        eventually(is_refused)  # a measurement of this age
        policy.now += HOLD
        assert not turn()
        assert commands[-1].mode == "freeze"  # the tracker is lost


def test_with_rclpy_it_is_the_same_node(example, monkeypatch):
    """Against a stand-in for rclpy that takes what rclpy takes: messages by class, arrays as
    lists.
    """
    messages = []
    sent = {}
    callbacks = {}

    class Node:
        def create_subscription(self, kind, topic, callback, qos):
            callbacks[topic] = callback

        def create_publisher(self, kind, topic, qos):
            def publish(message):
                assert isinstance(message, kind)
                sent[topic] = message

            return Fields(publish=publish)

        def destroy_node(self):
            callbacks.clear()

    def message(kind):
        names = [
            field for field in STORE.types[kind].__dataclass_fields__ if field != "__msgtype__"
        ]

        def make(self, **fields):
            assert set(fields) <= set(names)
            assert not any(isinstance(x, np.ndarray) for x in fields.values())
            self.__dict__.update(fields)

        return type(kind.rpartition("/")[2], (), {"__init__": make})

    def spin_once(node, timeout_sec):
        if messages:
            topic, message = messages.pop(0)
            callbacks[topic](message)

    policies = {
        "ReliabilityPolicy": Fields(BEST_EFFORT=1),
        "DurabilityPolicy": Fields(TRANSIENT_LOCAL=1),
    }
    qos = Fields(QoSProfile=Fields, **policies)
    rclpy = Fields(
        init=lambda: None,
        create_node=lambda name: Node(),
        spin_once=spin_once,
        try_shutdown=lambda: None,
    )
    monkeypatch.setitem(sys.modules, "rclpy", rclpy)
    monkeypatch.setitem(sys.modules, "rclpy.qos", qos)
    for package in (
        "sensor_msgs",
        "geometry_msgs",
        "std_msgs",
        "builtin_interfaces",
        "tf2_msgs",
        "rosgraph_msgs",
    ):
        kinds = [kind for kind in STORE.types if kind.startswith(f"{package}/msg/")]
        monkeypatch.setitem(sys.modules, package, types.ModuleType(package))
        module = Fields(**{kind.rpartition("/")[2]: message(kind) for kind in kinds})
        monkeypatch.setitem(sys.modules, f"{package}.msg", module)
    commands = []
    with node_of(example, example.RosBus()) as (node, policy, obj):

        def turn():
            messages.extend(robot_says(obj))
            commands.append(node.step())
            return commands[-1].mode == "follow" and arrived(commands, policy)

        eventually(turn)
        turn()
        check(policy, obj, [sent["joint_command"], sent["wrist_command"]])


def test_stamps_are_of_a_simulator_s_clock_where_one_is_published(example, capsys):
    def stamp(seconds):
        return Fields(sec=int(seconds), nanosec=300_000_000)

    def joints(seconds):
        header = Fields(stamp=stamp(seconds), frame_id="")
        return "joint_states", Fields(
            header=header, name=NAMES, position=HAND.q_open.tolist(), velocity=[]
        )

    def clock(seconds):
        return "clock", Fields(clock=stamp(seconds))

    def measured(*received):
        sensors.take(list(received))
        return np.isfinite(sensors.joints()[0]).all()

    bus = Wire()
    with node_of(example, bus) as (node, _, obj):
        sensors = node.sensors
        assert not measured(joints(time.time() - 100))
        assert measured(joints(12))
        assert measured(joints(13))
        assert capsys.readouterr().err.count("joint_states: its stamps are a simulator's") == 1
        assert measured(joints(14), clock(15))
        assert not measured(joints(14), clock(50))
        assert measured(joints(49))
        bus.said = robot_says(obj)
        node.step()
        assert bus.sent["joint_command"].header.stamp.sec == 50


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], r"ROS 2's rclpy cannot be imported here\. Source"),
        (["--zenoh", "tcp/127.0.0.1:1"], "--zenoh: nothing answers at tcp/127.0.0.1:1 .*bridge"),
    ],
)
def test_a_bus_that_is_absent_is_one_line(example, monkeypatch, options, words):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    monkeypatch.setattr(sys, "argv", ["ros2_node.py", "mug:7", *options])
    with pytest.raises(congrasp.CongraspError, match=words) as caught:
        example.main()
    assert "\n" not in str(caught.value)
    assert "cargo" not in str(caught.value)


def test_it_names_what_it_waits_for_and_the_map_renames_joints(example):
    """A robot that calls the first joint `motor_1`, says nothing of its wrist, and sees the object
    in a lost frame.
    """
    bus = Wire()
    with node_of(example, bus) as (node, _, obj):
        (_, joints), _, _, (_, thing) = robot_says(obj)
        joints.name[joints.name.index(NAMES[0])] = "motor_1"
        thing.header.frame_id = "camera"
        bus.said = [("joint_states", joints), ("object_pose", thing)]
        assert node.step() is None
        line = example.report(None, node.guard, node.sensors)
        assert ", motor_1, " in line
        assert line.startswith(f"Waiting for the joints {NAMES[0]} in joint_states (there: ")
        assert (
            "; see --joint-map); wrist_pose; object_pose: a pose, and tf from its frame 'camera'"
            in line
        )
    with node_of(example, bus, joint_map=(f"{NAMES[0]}=motor_1",)) as (node, _, obj):
        node.step()
        assert node.sensors.missing().startswith("wrist_pose; ")
        assert node.sensors.names[0] == "motor_1"
        old = dict(robot_says(obj))["wrist_pose"]
        old.header = header(age=9.0)
        bus.said = [("wrist_pose", old)]
        assert node.step() is None
        assert "wrist_pose (the last one is 9." in node.sensors.missing()
    with pytest.raises(congrasp.CongraspError, match="--joint-map has 'elbow=motor_1'"):
        sys.modules["ros2_sensors"].joints_of(("elbow=motor_1",), NAMES)


def test_poses_come_through_frames_and_offsets_and_go_back_the_same_way(example):
    """The base stands at (1, 0, 0), turned by 90 degrees about z; the camera hangs 2 m above it and
    looks along its z; it is really 1 cm farther along its own x axis. The palm is 10 cm along the
    flange's z axis.

    An object at (0.3, 0.2, 0) of the camera is at (0.31, 0.2, 2) of the base, so at (1 - 0.2, 0.31,
    2) of the world.
    """
    bus = Wire()
    level = Rotation.identity()
    quarter = Rotation.from_euler("z", 90, degrees=True)
    with node_of(example, bus, mount="0 0 0.1 0 0 0", hand_eye="0.01 0 0 0 0 0") as (
        node,
        policy,
        obj,
    ):
        fixed = Fields(transforms=[frame("base", "world", [1.0, 0.0, 0.0], quarter, age=99.0)])
        moving = Fields(transforms=[frame("camera", "base", [0.0, 0.0, 2.0], level)])
        thing = posed(np.array([0.3, 0.2, 0.0]) + obj.origin, level, frame="camera")
        flange = posed([0.5, 0.0, 0.3], level, frame="base")
        joints = robot_says(obj)[0]
        bus.said = [
            ("tf_static", fixed),
            ("tf", moving),
            joints,
            ("object_pose", thing),
            ("wrist_pose", flange),
        ]
        command = node.step()
        assert command.mode == "follow"
        np.testing.assert_allclose(policy.request.object_pose[0], [0.8, 0.31, 2.0], atol=1e-9)
        np.testing.assert_allclose(policy.request.wrist[0], [1.0, 0.5, 0.4], atol=1e-9)
        np.testing.assert_allclose(
            policy.request.wrist[1], quarter.as_quat(scalar_first=True), atol=1e-9
        )
        u = command.u_target
        turned = quarter * Rotation.from_euler("XYZ", u[3:])
        place = bus.sent["wrist_command"].pose.position
        expected = np.array([1.0, 0.5, 0.4]) + quarter.apply(u[:3]) - turned.apply([0.0, 0.0, 0.1])
        np.testing.assert_allclose([place.x, place.y, place.z], expected, atol=1e-9)
        moving.transforms[0].header = header("base", age=9.0)
        node.step()
        assert "tf from its frame 'camera'" in node.sensors.missing()


def test_after_the_approach_the_hand_rises_and_a_dry_run_sends_nothing(example):
    """3 steps of approach; then 10 cm at 2 cm a step, with a smooth beginning and end: 3 s^2 - 2
    s^3.
    """
    bus = Wire()
    with node_of(example, bus, lift=0.1) as (node, policy, obj):
        heights = []
        tables = []

        def risen():
            bus.said = robot_says(obj)
            if bus.sent:
                bus.said[2] = (
                    "wrist_pose",
                    Fields(header=header(), pose=bus.sent["wrist_command"].pose),
                )
            node.step()
            heights.append(bus.sent["wrist_command"].pose.position.z)
            tables.append(policy.state is None or bool(policy.state["table"]))
            seen = 0.0 if policy.state is None else policy.state["object_position"][2]
            return seen == pytest.approx(-0.05) and heights[-1] - heights[0] == pytest.approx(
                0.1, abs=0.005
            )

        eventually(risen)
        rise = [0.1 * s**2 * (3 - 2 * s) for s in (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)]
        assert tables[0]
        assert not tables[-1]
        assert [float(node.plan.rise(3 + n)[2]) for n in range(6)] == pytest.approx(rise)
        # 3 steps of approach, 5 of the rise, a second: from then on the targets are kept.
        assert [node.plan.lifted(n) for n in (8, 107, 108)] == [False, False, True]
        node.followed = 108
        bus.said = robot_says(obj)
        assert [node.step().mode for _ in range(2)] == ["freeze", "freeze"]
    bus.sent = {}
    with node_of(example, bus, dry_run=True) as (node, _, obj):
        bus.said = robot_says(obj)
        command = node.step()
        line = example.report(command, node.guard, node.sensors)
        assert command is not None
        assert bus.sent == {}
        assert line.startswith(command.mode)


@pytest.mark.parametrize(("radius", "height"), [(0.06, 0.04), (0.015, 0.0)])
def test_the_hand_s_centre_stops_two_centimetres_below_the_surface_or_at_the_middle(
    example, radius, height
):
    """Of a ball, from above: 6 cm - 2 cm over the middle; the middle of a ball of 1.5 cm is nearer
    to its surface.
    """
    middle = np.array([0.1, 0.0, 0.5])
    points = np.random.default_rng(0).normal(size=(4000, 3))
    points = middle + radius * points / np.linalg.norm(points, axis=1, keepdims=True)
    stop = example.below_surface(points, middle, np.array([0.0, 0.0, -1.0]))
    np.testing.assert_allclose(stop - middle, [0.0, 0.0, height], atol=1e-3)


def test_the_policy_s_clock_reaches_the_removal_when_the_object_may_leave_the_table(example):
    plan = example.Plan(
        "world", approach_steps=200, trained_steps=100, lift=0.1, step=0.001, dry_run=False
    )
    assert [plan.time(followed) for followed in (0, 100, 200, 230)] == [0.0, 50.0, 100.0, 130.0]


def test_a_step_waits_for_the_measurement_of_its_time(example):
    """Not for one that came more than half a period early, and for none more than half a period
    late.
    """
    bus = Wire()
    with node_of(example, bus) as (node, _, obj):
        bus.receive = lambda: robot_says(obj)
        began = node.wait(0.1)
        bus.receive = lambda: robot_says(obj) if time.monotonic() > began + 0.07 else []
        in_time = node.wait(0.1)
        assert 0.07 <= in_time - began < 0.1
        bus.receive = lambda: robot_says(obj)
        early = node.wait(0.1)
        assert 0.05 <= early - in_time < 0.1
        bus.receive = lambda: []
        assert node.wait(0.1) - early >= 0.15


def test_a_slow_hand_has_a_share_of_the_speed(example):
    limits = congrasp.JointLimits.of_hand(HAND)
    slow = example.slowed(limits, 0.25)
    np.testing.assert_allclose(slow.speed, limits.speed / 4)
    np.testing.assert_allclose(slow.acceleration, limits.acceleration / 16)


TOPIC = "/camera/points"
DESCRIBED = {"observation": "camera", "surface_points": 64, "trajectory_points": 5}
CAMERA = np.array([1.0, 0.5, 0.6])
CAMERA_TURN = Rotation.from_euler("xyz", [-2.0, 0.3, 1.1])
PALM = np.array([0.5, 0.1, 0.32])
PALM_TURN = Rotation.from_euler("x", 180, degrees=True)


def camera_node(example, bus, lift=0.0, age=5.0, **options):
    """A node of a policy with a camera, in a box around (0.5, 0.1)."""
    arguments = example.Arguments(
        cloud_topic=TOPIC, robot_age=5.0, box="0.5 0.1 0.2 0.3 0.3 0.4", **options
    )
    make = functools.partial(example.target_of, arguments, hand=HAND, described=DESCRIBED)
    return running(example, bus, arguments, age, lift, make)


def cloud_of(points, rows=1, **stamp):
    """A PointCloud2 of points (N, 3) in the world, as a camera has it: rows with gaps, of points
    with other fields.
    """
    kind = np.dtype(
        {
            "names": ["rgb", "x", "y", "z"],
            "formats": ["<u4", "<f4", "<f4", "<f4"],
            "offsets": [0, 4, 8, 16],
            "itemsize": 24,
        }
    )
    local = CAMERA_TURN.inv().apply(points - CAMERA)
    packed = np.zeros(len(points), kind)
    packed["x"], packed["y"], packed["z"] = local.T
    lines = [row.tobytes() + b"\xff" * 5 for row in packed.reshape(rows, -1)]
    fields = [
        Fields(name=name, offset=at, datatype=7, count=1)
        for name, at in (("x", 4), ("y", 8), ("z", 16))
    ]
    return Fields(
        header=header("camera", **stamp),
        height=rows,
        width=len(points) // rows,
        fields=fields,
        is_bigendian=False,
        point_step=24,
        row_step=24 * (len(points) // rows) + 5,
        data=array.array("B", b"".join(lines)),
        is_dense=False,
    )


def block(shift=(0.0, 0.0, 0.0)):
    """(300, 3) points of an object on the table."""
    return (
        np.random.default_rng(1).uniform([0.47, 0.07, 0.006], [0.53, 0.13, 0.1], (300, 3)) + shift
    )


def surroundings():
    """(100, 3) points that are none of the object: table, wall, no measurement, and the hand
    itself.
    """
    rng = np.random.default_rng(2)
    table = np.concatenate(
        [rng.uniform(0.4, 0.6, (30, 2)) - [0, 0.4], rng.normal(0, 0.001, (30, 1))], 1
    )
    wall = rng.uniform([0.7, -1, 0], [0.9, 1, 1], (30, 3))
    hand = PALM + PALM_TURN.apply(mujoco_link_poses(HAND, HAND.q_open)[0])
    return np.concatenate([table, wall, np.full((24, 3), np.nan), hand[:16]])


def camera_says(cloud, wrist=(PALM, PALM_TURN)):
    """Messages of a robot whose camera stands still."""
    fixed = Fields(transforms=[frame("camera", "world", CAMERA, CAMERA_TURN)])
    joints = Fields(
        header=header(""), name=NAMES, position=HAND.q_open.tolist(), velocity=[], effort=[]
    )
    return [
        ("tf_static", fixed),
        ("joint_states", joints),
        ("wrist_pose", posed(*wrist)),
        (TOPIC, cloud),
    ]


def test_a_policy_with_a_camera_gets_the_object_s_points_alone(example):
    """In the order of the cloud, 64 of 300; the same from a cloud in rows, and where the camera is
    off as stated.
    """
    bus = Wire()
    points = block()
    expected = points[np.arange(64) * 300 // 64]
    around = surroundings()
    mixed = np.concatenate([around[:50], points, around[50:]])
    with camera_node(example, bus) as (node, policy):
        bus.said = camera_says(cloud_of(mixed, rows=4))
        eventually(lambda: (node.step() or Fields(mode="")).mode == "follow")
        np.testing.assert_allclose(policy.request.cloud, expected, atol=1e-6)
        np.testing.assert_allclose(policy.state["cloud"], expected, atol=1e-6)
        assert policy.request.surface is None
        assert policy.request.object_pose is None
        np.testing.assert_allclose(
            [policy.request.camera, policy.state["camera_position"]], [CAMERA] * 2
        )
        heading = policy.request.constraints["heading"]
        middle = expected.mean(0)
        top = expected[np.linalg.norm((expected - middle)[:, :2], axis=1) < 0.01, 2].max()
        np.testing.assert_allclose(heading["position"], [*middle[:2], top - 0.02], atol=1e-6)
        np.testing.assert_allclose(heading["direction"], [0, 0, -1])
    off = CAMERA_TURN.apply([0.01, 0.0, 0.0])
    with camera_node(example, bus, hand_eye="0.01 0 0 0 0 0") as (node, policy):
        bus.said = camera_says(cloud_of(points - off))
        eventually(lambda: (node.step() or Fields(mode="")).mode == "follow")
        np.testing.assert_allclose(policy.request.cloud, expected, atol=1e-6)
        np.testing.assert_allclose(policy.request.camera, CAMERA + off)
    with camera_node(example, bus) as (
        node,
        policy,
    ):  # a cloud in the world's frame does not say where the camera is
        bus.said = camera_says(cloud_of(CAMERA + CAMERA_TURN.apply(points)))
        bus.said[-1][1].header.frame_id = "world"
        eventually(lambda: (node.step() or Fields(mode="")).mode == "follow")
        np.testing.assert_allclose(policy.request.cloud, expected, atol=1e-6)
        assert policy.request.camera is None
        assert "camera_position" not in policy.state


def test_a_cloud_is_read_as_it_comes_over_either_bus(example):
    """rosbags decodes what mcap-ros2-support encodes; rclpy has an array of bytes."""
    message = cloud_of(block(), rows=3)
    read = sys.modules["ros2_cloud"].read_points
    seen = CAMERA_TURN.apply(read(message)) + CAMERA
    np.testing.assert_allclose(seen, block(), atol=1e-6)
    kind = example.CLOUD
    plain = Fields(**{**vars(message), "data": message.data.tobytes()})
    payload = serialize_dynamic(*schema(kind))[schema(kind)[0]](plain)
    np.testing.assert_array_equal(read(STORE.deserialize_cdr(payload, kind)), read(message))
    for wrong in ({"fields": message.fields[:2]}, {"width": 5000}, {"point_step": 2}):
        assert read(Fields(**{**vars(message), **wrong})).shape == (0, 3)


def test_a_hidden_object_stays_where_it_was_and_a_silent_camera_stops_the_hand(example):
    bus = Wire()
    with camera_node(example, bus, age=0.5) as (node, policy):
        bus.said = camera_says(cloud_of(surroundings()))
        assert node.step() is None
        assert f"{TOPIC}: 0 of 76 points in --box" in example.report(None, node.guard, node.sensors)
        bus.said = camera_says(cloud_of(block(), age=9.0))
        assert node.step() is None
        assert f"{TOPIC} (the last one is 9." in node.sensors.missing()

        def seen(points, beyond):
            bus.said = camera_says(cloud_of(points))
            command = node.step()
            at = policy.state and policy.state["cloud"][:, 0].mean()
            return command is not None and command.mode == "follow" and abs(at - beyond) < 0.005

        eventually(lambda: seen(block(), 0.5))
        eventually(lambda: seen(block((0.04, 0.0, 0.0)), 0.54))
        eventually(lambda: seen(surroundings(), 0.54))  # the hand is before it
        bus.said = camera_says(cloud_of(block()))[:-1]

        def is_refused():
            node.step()
            return node.guard.trouble

        eventually(is_refused)
        policy.now += HOLD
        assert node.step().mode == "freeze"


def test_the_cloud_rises_with_the_hand(example):
    """The policy sees the lifted object where it was, and no table below it."""
    bus = Wire()
    with camera_node(example, bus, lift=0.1) as (node, policy):
        wrist = PALM, PALM_TURN

        def risen():
            nonlocal wrist
            height = -float(node.plan.rise(node.followed)[2])
            bus.said = camera_says(
                cloud_of(np.concatenate([block((0, 0, -height)), surroundings()[:30]])), wrist
            )
            command = node.step()
            if bus.sent:
                place = bus.sent["wrist_command"].pose.position
                wrist = np.array([place.x, place.y, place.z]), PALM_TURN
            return command is not None and wrist[0][2] - PALM[2] == pytest.approx(0.1, abs=0.01)

        bus.said = camera_says(cloud_of(block()))
        eventually(risen)
        assert policy.state["cloud"][:, 2].mean() == pytest.approx(block()[:, 2].mean(), abs=0.01)
        assert not policy.state["table"]


def test_a_camera_needs_a_topic_and_a_tracker_an_object(example):
    for arguments, observation, words in (
        (example.Arguments(), "camera", "a point cloud. Set --cloud-topic and name no object"),
        (example.Arguments("mug:7", cloud_topic=TOPIC), "camera", "name no object"),
        (
            example.Arguments("mug:7", cloud_topic=TOPIC),
            "full",
            "Name an object and leave out --cloud-topic",
        ),
        (example.Arguments(), "tracked", "Name an object"),
        (example.Arguments(cloud_topic=TOPIC, box="1 2 3"), "camera", "--box is '1 2 3'"),
    ):
        with pytest.raises(congrasp.CongraspError, match=re.escape(words)) as caught:
            example.target_of(arguments, None, HAND, {**DESCRIBED, "observation": observation})
        assert "\n" not in str(caught.value)


def test_constraints_of_a_cloud_are_in_the_world_frame(example, tmp_path):
    """An affordance painted on its upper half stays there in newer clouds."""
    trimesh.PointCloud(block()[block()[:, 2] > 0.05]).export(tmp_path / "upper.ply")
    constraint = example.Constraints(
        heading="0 1 -1", at="0.5 0.1 0.08", affordance=str(tmp_path / "upper.ply")
    )
    bus = Wire()
    with camera_node(example, bus, constraint=constraint) as (node, policy):

        def seen():
            bus.said = camera_says(cloud_of(block((0.002, 0.0, 0.0))[::-1]))
            command = node.step()
            return command is not None and "surface_avoid" in (policy.state or ())

        bus.said = camera_says(cloud_of(block()))
        node.step()
        eventually(seen)
        np.testing.assert_allclose(
            policy.request.constraints["heading"]["position"], [0.5, 0.1, 0.08]
        )
        for points, avoid in (
            (policy.request.cloud, policy.request.avoid),
            (policy.state["cloud"], policy.state["surface_avoid"]),
        ):
            assert avoid[points[:, 2] < 0.03].all()
            assert not avoid[points[:, 2] > 0.07].any()
            assert len(avoid) == 64
