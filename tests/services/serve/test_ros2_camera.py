"""The example's ROS 2 node for a policy with a camera: the object's points in clouds."""

import array
import functools
import re
import sys
from types import SimpleNamespace as Fields

import numpy as np
import pytest
import trimesh
from mcap_ros2._dynamic import serialize_dynamic
from scipy.spatial.transform import Rotation

import congrasp
from congrasp.common.hands.mjcf import mujoco_link_poses
from tests import examples
from tests.services.serve.ros2 import (
    HAND,
    HOLD,
    NAMES,
    STORE,
    Wire,
    frame,
    header,
    posed,
    running,
    schema,
)
from tests.waits import eventually

TOPIC = "/camera/points"
DESCRIBED = {"observation": "camera", "surface_points": 64, "trajectory_points": 5}
CAMERA = np.array([1.0, 0.5, 0.6])
CAMERA_TURN = Rotation.from_euler("xyz", [-2.0, 0.3, 1.1])
PALM = np.array([0.5, 0.1, 0.32])
PALM_TURN = Rotation.from_euler("x", 180, degrees=True)


@pytest.fixture(scope="module")
def example():
    return examples.example("congrasp_ros2.node")


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
    read = sys.modules["congrasp_ros2.cloud"].read_points
    seen = CAMERA_TURN.apply(read(message)) + CAMERA
    np.testing.assert_allclose(seen, block(), atol=1e-6)
    kind = example.CLOUD
    plain = Fields(**{**vars(message), "data": message.data.tobytes()})
    payload = serialize_dynamic(*schema(kind))[schema(kind)[0]](plain)
    np.testing.assert_array_equal(read(STORE.deserialize_cdr(payload, kind)), read(message))
    for wrong in ({"fields": message.fields[:2]}, {"width": 5000}, {"point_step": 2}):
        assert read(Fields(**{**vars(message), **wrong})).shape == (0, 3)


def test_a_hidden_object_keeps_its_place_until_the_camera_is_silent(example):
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
