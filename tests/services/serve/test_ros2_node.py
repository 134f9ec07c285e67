"""The example's node: its CDR over Zenoh is an independent implementation's, and with rclpy it is the same node."""

import contextlib
import importlib.util
import json
import pathlib
import sys
import time
import types
from types import SimpleNamespace as Fields

import numpy as np
import pytest
import zenoh
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

import congrasp
from congrasp.common.hands import get_hand
from congrasp.common.objects import procedural
from congrasp.common.transport.ports import free_port
from congrasp.services.client.policy import Answer

EXAMPLE = pathlib.Path(__file__).resolve().parents[3] / "examples" / "ros2_node.py"
STORE = get_typestore(Stores.ROS2_HUMBLE)
HAND = get_hand("allegro")
NAMES = [joint.name for joint in HAND.joints]
BASE, BASE_TURN = np.array([0.1, -0.2, 0.3]), Rotation.from_euler("XYZ", [0.4, -0.3, 2.0])


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("ros2_node", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


class SteadyPolicy:
    """Wants the same targets always, and keeps what it was told."""

    def __init__(self):
        self.request, self.state = None, None
        self.wanted = HAND.q_open + 0.05, np.array([0.01, 0.0, -0.01, 0.02, 0.0, 0.03])

    def reset(self, request):
        self.request = request

    def act(self, state):
        self.state = state
        if not all(np.isfinite(state[name]).all() for name in ("q", "u", "object_position")):
            raise congrasp.RefusedError("not finite")
        return Answer(*self.wanted, np.zeros(22), 1, (), 0.0, 0.0)

    def close(self):
        pass


def stamped(position, rotation):
    x, y, z, w = map(float, rotation.as_quat())
    place = dict(zip("xyz", map(float, position), strict=True))
    header = Fields(stamp=Fields(sec=1, nanosec=2), frame_id="world")
    return Fields(header=header, pose=Fields(position=Fields(**place), orientation=Fields(x=x, y=y, z=z, w=w)))


def robot_says(obj):
    """Messages of a robot whose joints come in another order and with a stranger among them."""
    order = [*reversed(range(16))]
    header = Fields(stamp=Fields(sec=1, nanosec=2), frame_id="")
    names = [*(NAMES[i] for i in order), "elbow"]
    angles = [*HAND.q_open[order].tolist(), 0.7]
    joints = Fields(header=header, name=names, position=angles, velocity=[], effort=[])
    lying = Rotation.from_euler("z", 0.5)
    return {
        "joint_states": joints,
        "wrist_pose": stamped(BASE, BASE_TURN),
        "object_pose": stamped(np.array([0.0, 0.1, 0.05]) + lying.apply(obj.origin), lying),
    }


def check(policy, obj, commanded):
    """What the policy was told, and the commands (joints, wrist), against numbers worked out here."""
    np.testing.assert_allclose(policy.request.q, HAND.q_open, atol=1e-6)
    np.testing.assert_allclose(policy.request.object_pose[0], [0.0, 0.1, 0.05], atol=1e-6)
    np.testing.assert_allclose(policy.request.object_pose[1], [np.cos(0.25), 0, 0, np.sin(0.25)], atol=1e-6)
    np.testing.assert_allclose(policy.state["q"], HAND.q_open, atol=1e-6)
    np.testing.assert_allclose(policy.state["u"], np.zeros(6), atol=1e-6)
    joints, wrist = commanded
    q_wanted, u_wanted = policy.wanted
    assert list(joints.name) == NAMES and len(joints.velocity) == 0
    np.testing.assert_allclose(joints.position, q_wanted, atol=1e-6)
    np.testing.assert_allclose(joints.effort, 3.0 * 0.05 * np.ones(16), atol=1e-5)  # kp of Allegro, 0.05 rad ahead
    place, turn = wrist.pose.position, wrist.pose.orientation
    np.testing.assert_allclose([place.x, place.y, place.z], BASE + BASE_TURN.as_matrix() @ u_wanted[:3], atol=1e-6)
    cos, sin = np.cos([0.02, 0.03]), np.sin([0.02, 0.03])
    about_x = np.array([[1, 0, 0], [0, cos[0], -sin[0]], [0, sin[0], cos[0]]])
    about_z = np.array([[cos[1], -sin[1], 0], [sin[1], cos[1], 0], [0, 0, 1]])
    found = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    np.testing.assert_allclose(found, BASE_TURN.as_matrix() @ about_x @ about_z, atol=1e-6)
    assert wrist.header.frame_id == "world" and abs(wrist.header.stamp.sec - time.time()) < 60


@contextlib.contextmanager
def node_of(example, bus):
    """A node with a steady policy, and the object that it grasps."""
    policy, obj = SteadyPolicy(), procedural.generate(7)
    limits = congrasp.JointLimits.of_hand(HAND)
    with congrasp.Guard(policy, limits, HAND.q_open, period=0.05, wait=0.04, stale=0.2, hold=0.6) as guard:
        try:
            yield example.PolicyNode(bus, guard, HAND, obj, np.array([0.0, 0.0, -2.0]), 50), policy, obj
        finally:
            bus.close()


def until(look, seconds=20.0):
    deadline = time.monotonic() + seconds
    while not (found := look()):
        assert time.monotonic() < deadline
        time.sleep(0.005)
    return found


def arrived(node, policy):
    """Whether the targets, which the limits slow down, are where the policy wants them."""
    return np.allclose(node._guard._limiter.target, np.concatenate(policy.wanted))


def schema(kind):
    return kind.replace("/msg", ""), STORE.generate_msgdef(kind, ros_version=2)[0]


def test_over_zenoh_robot_and_node_understand_each_other_s_cdr(example, capsys):
    """The robot's messages are written and read by mcap-ros2-support, the node's by rosbags."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = zenoh.Config()
    settings = {"mode": "peer", "listen/endpoints": [endpoint], "scouting/multicast/enabled": False}
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    write = {k: serialize_dynamic(*schema(k))[schema(k)[0]] for k in set(example.INPUTS.values())}
    read = {k: generate_dynamic(*schema(k))[schema(k)[0]] for k in set(example.OUTPUTS.values())}
    with zenoh.open(config) as robot, node_of(example, example.ZenohBus(endpoint)) as (node, policy, obj):
        heard = {t: robot.declare_subscriber(t, zenoh.handlers.RingChannel(1)) for t in example.OUTPUTS}
        said = robot_says(obj)

        def turn():
            """The robot speaks and the node acts; whether it follows its policy."""
            for topic, message in said.items():
                robot.put(topic, write[example.INPUTS[topic]](message))
            command = node.step()
            return command is not None and command.mode == "follow"

        def refused():
            robot.put("joint_states", b"\x00\x01\x00\x00nonsense")
            assert node.step() is None
            return "joint_states: not a sensor_msgs/msg/JointState" in capsys.readouterr().err

        until(refused)
        until(lambda: turn() and arrived(node, policy))
        turn()
        newest = {t: until(lambda s=s: s.try_recv()).payload.to_bytes() for t, s in heard.items()}
        check(policy, obj, [read[example.OUTPUTS[t]](payload) for t, payload in newest.items()])
        said["object_pose"].pose.orientation = Fields(x=0.0, y=0.0, z=0.0, w=0.0)
        until(lambda: not turn())
        assert until(lambda: (turn(), node._guard._latched)[1])  # a tracker without a pose: held, then the fallback


def test_with_rclpy_it_is_the_same_node(example, monkeypatch):
    """Against a stand-in for rclpy that takes what rclpy takes: messages by class, arrays as lists."""
    said, sent, callbacks = {}, {}, {}

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
        names = [field for field in STORE.types[kind].__dataclass_fields__ if field != "__msgtype__"]

        def make(self, **fields):
            assert set(fields) <= set(names) and not any(isinstance(x, np.ndarray) for x in fields.values())
            self.__dict__.update(fields)

        return type(kind.rpartition("/")[2], (), {"__init__": make})

    def spin_once(node, timeout_sec):
        for topic, callback in callbacks.items():
            callback(said[topic])

    qos = Fields(QoSProfile=Fields, ReliabilityPolicy=Fields(BEST_EFFORT=1))
    rclpy = Fields(init=lambda: None, create_node=lambda name: Node(), spin_once=spin_once, try_shutdown=lambda: None)
    monkeypatch.setitem(sys.modules, "rclpy", rclpy)
    monkeypatch.setitem(sys.modules, "rclpy.qos", qos)
    for package in ("sensor_msgs", "geometry_msgs", "std_msgs", "builtin_interfaces"):
        kinds = [kind for kind in STORE.types if kind.startswith(f"{package}/msg/")]
        monkeypatch.setitem(sys.modules, package, types.ModuleType(package))
        module = Fields(**{kind.rpartition("/")[2]: message(kind) for kind in kinds})
        monkeypatch.setitem(sys.modules, f"{package}.msg", module)
    with node_of(example, example.RosBus()) as (node, policy, obj):
        said.update(robot_says(obj))
        until(lambda: node.step().mode == "follow" and arrived(node, policy))
        node.step()
        check(policy, obj, [sent["joint_command"], sent["wrist_command"]])
