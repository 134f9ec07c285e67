"""The example's node: its CDR over Zenoh is an independent implementation's, and with rclpy it is
the same node.
"""

import sys
import time
import types
from types import SimpleNamespace as Fields

import numpy as np
import pytest
import zenoh
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic
from scipy.spatial.transform import Rotation

import congrasp
from congrasp.common.transport.ports import free_port
from tests import examples
from tests.bare_zenoh import bare_session
from tests.services.serve.ros2 import (
    HAND,
    HOLD,
    NAMES,
    OUTPUTS,
    STORE,
    Wire,
    arrived,
    check,
    frame,
    header,
    node_of,
    posed,
    robot_says,
    schema,
)
from tests.waits import eventually


@pytest.fixture(scope="module")
def example():
    return examples.example("congrasp_ros2.node")


def test_node_over_zenoh_exchanges_cdr_with_other_libraries(example, capsys):
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
        subscribers = {
            t: robot.declare_subscriber(t, zenoh.handlers.RingChannel(1)) for t in OUTPUTS
        }
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
            t: eventually(lambda s=s: s.try_recv()).payload.to_bytes()
            for t, s in subscribers.items()
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


def test_stamps_refer_to_a_published_clock(example, capsys):
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
    monkeypatch.setattr(sys, "argv", ["grasp_node", "mug:7", *options, "--ros-args", "-r", "a:=b"])
    with pytest.raises(SystemExit, match=words) as caught:
        example.main()
    assert "\n" not in caught.value.code
    assert "cargo" not in caught.value.code


def test_missing_inputs_are_named_and_joints_are_mapped(example):
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
        sys.modules["congrasp_ros2.sensors"].joints_of(("elbow=motor_1",), NAMES)


def test_poses_are_converted_through_frames_and_offsets(example):
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


def test_hand_rises_after_the_approach_and_dry_run_is_silent(example):
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
def test_hand_centre_stops_below_the_surface_or_at_the_middle(example, radius, height):
    """Of a ball, from above: 6 cm - 2 cm over the middle; the middle of a ball of 1.5 cm is nearer
    to its surface.
    """
    middle = np.array([0.1, 0.0, 0.5])
    points = np.random.default_rng(0).normal(size=(4000, 3))
    points = middle + radius * points / np.linalg.norm(points, axis=1, keepdims=True)
    stop = example.below_surface(points, middle, np.array([0.0, 0.0, -1.0]))
    np.testing.assert_allclose(stop - middle, [0.0, 0.0, height], atol=1e-3)


def test_policy_clock_reaches_the_removal_after_the_approach(example):
    plan = example.Plan(
        "world", approach_steps=200, trained_steps=100, lift=0.1, step=0.001, dry_run=False
    )
    assert [plan.time(followed) for followed in (0, 100, 200, 230)] == [0.0, 50.0, 100.0, 130.0]


def test_a_step_waits_for_the_measurement_of_its_time(example, monkeypatch):
    """Not for one that came more than half a period early, and for none more than half a period
    late.
    """
    bus = Wire()
    now = 0.0

    def sleep(seconds):
        nonlocal now
        now += seconds

    monkeypatch.setattr(example, "time", Fields(monotonic=lambda: now, sleep=sleep))
    with node_of(example, bus) as (node, _, obj):
        bus.receive = lambda: robot_says(obj) if now > 0.07 else []
        in_time = node.wait(0.1)
        assert in_time == pytest.approx(0.07, abs=0.002)
        bus.receive = lambda: robot_says(obj)
        early = node.wait(0.1)
        assert early - in_time == pytest.approx(0.05, abs=0.002)
        bus.receive = lambda: []
        assert node.wait(0.1) - early == pytest.approx(0.15, abs=0.002)


def test_a_slow_hand_has_a_share_of_the_speed(example):
    limits = congrasp.JointLimits.of_hand(HAND)
    slow = example.slowed(limits, 0.25)
    np.testing.assert_allclose(slow.speed, limits.speed / 4)
    np.testing.assert_allclose(slow.acceleration, limits.acceleration / 16)
