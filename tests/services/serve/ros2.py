"""A robot's messages, and the example's ROS 2 node with a policy that always wants the same."""

import contextlib
import time
from types import SimpleNamespace as Fields

import numpy as np
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

import congrasp
from congrasp.common.hands import get_hand
from congrasp.common.objects import procedural
from congrasp.services.client.policy import Answer

OUTPUTS = {
    "joint_command": "sensor_msgs/msg/JointState",
    "wrist_command": "geometry_msgs/msg/PoseStamped",
}
STORE = get_typestore(Stores.ROS2_HUMBLE)
HAND = get_hand("allegro")
NAMES = [joint.name for joint in HAND.joints]
BASE = np.array([0.1, -0.2, 0.3])
BASE_TURN = Rotation.from_euler("XYZ", [0.4, -0.3, 2.0])
HOLD = 60.0
"""Seconds on the guard's clock until the fallback: a busy machine does not get there."""


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
