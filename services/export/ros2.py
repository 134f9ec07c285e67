"""A ROS 2 bag (MCAP): written by rosbags, read back by mcap and mcap-ros2-support.

Topics: `/robot_description` (URDF), `/joint_trajectory` (all frames, joints of arm and fingers), `/wrist_trajectory`
(all frames, the palm in the world), `/joint_states`, `/tf` (frame by frame), `/object` (a marker with the mesh), `/arm`
(markers with the meshes of the arm's links, if there is one).
"""

import json
import pathlib
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.common.objects.painting import nearest
from congrasp.services.export.frames import COLOURS, OBJECT, Body, Track, arm_meshes, bodies, facts, pose_matrices
from congrasp.services.export.motion_file import TRAJECTORY_START, GraspMotion, joint_trajectory, robot_joints
from congrasp.services.export.urdf import forward_kinematics, robot_urdf

_WORLD = "world"


def write(path: pathlib.Path, motions: Sequence[GraspMotion]) -> None:
    """Writes one motion as a bag, which is a folder; it begins at one second, since in TF zero means any time."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    (motion,) = motions
    store = get_typestore(Stores.ROS2_HUMBLE)
    make = _Messages(store.types)
    position, velocity, stamps = joint_trajectory(motion, motion.joint_position.astype(float))
    found = bodies(motion)
    frames = [_transforms(make, found, t, stamp) for t, stamp in enumerate(stamps)]
    palm = next(i for i, body in enumerate(found) if body.parent < 0)
    wrist = [frame.transforms[palm].transform for frame in frames]
    trajectory, states = _joint_messages(make, robot_joints(motion), position, velocity, stamps, found[palm].name)
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        about = facts(motion, frame=f"{_WORLD}: z up; TF frames are the links", unit="m, rad, s", quaternion="by name")
        bag.set_custom_data("congrasp", json.dumps(about))

        def send(topic: str, kind: str, messages: Sequence[Any], *, once: bool = False) -> None:
            """Writes messages at the motion's times; with `once`, late subscribers receive the last one."""
            qos = [_latched()] if once else []
            channel = bag.add_connection(topic, kind, typestore=store, offered_qos_profiles=qos)
            for stamp, message in zip(stamps, messages, strict=False):
                bag.write(channel, stamp, store.serialize_cdr(message, kind))

        send("/robot_description", "std_msgs/msg/String", [make("std_msgs/String", data=robot_urdf(motion))], once=True)
        send("/joint_trajectory", "trajectory_msgs/msg/JointTrajectory", [trajectory], once=True)
        path_of_wrist = _wrist_trajectory(make, wrist, stamps, found[palm].name)
        send("/wrist_trajectory", "trajectory_msgs/msg/MultiDOFJointTrajectory", [path_of_wrist], once=True)
        corners = motion.object_vertices[motion.object_faces.ravel()]
        colours = (nearest(corners, motion.colours) / 255).tolist() if motion.colours else []
        thing = _marker(make, OBJECT, motion.object, 0, corners, COLOURS[OBJECT], colours)
        send("/object", "visualization_msgs/msg/Marker", [thing], once=True)
        if arm := motion.arm:
            parts = [
                _marker(make, name, arm.name, number, mesh.vertices[mesh.faces.ravel()], mesh.colour)
                for name, meshes in arm_meshes(motion).items()
                for number, mesh in enumerate(meshes)
            ]
            send(
                "/arm",
                "visualization_msgs/msg/MarkerArray",
                [make("visualization_msgs/MarkerArray", markers=parts)],
                once=True,
            )
        send("/joint_states", "sensor_msgs/msg/JointState", states)
        send("/tf", "tf2_msgs/msg/TFMessage", frames)


def _latched() -> Any:
    """Quality of service of a topic whose last message late subscribers receive."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    never = QosTime(0x7FFFFFFF, 0xFFFFFFFF)
    durable = (QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL)
    return Qos(*durable, never, never, QosLiveliness.AUTOMATIC, never, False)


class _Messages:
    """Makes messages by the names of their types and fields."""

    def __init__(self, types: Any):
        self._types = types

    def __call__(self, kind: str, **fields: Any) -> Any:
        package, name = kind.split("/")
        return self._types[f"{package}/msg/{name}"](**fields)

    def header(self, stamp: int, frame: str) -> Any:
        """A header with a time in ns."""
        time = self("builtin_interfaces/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        return self("std_msgs/Header", stamp=time, frame_id=frame)

    def duration(self, ns: int) -> Any:
        """A duration in ns."""
        return self("builtin_interfaces/Duration", sec=ns // 10**9, nanosec=ns % 10**9)

    def vector(self, values: np.ndarray, kind: str = "Vector3") -> Any:
        """A vector (3,)."""
        return self(f"geometry_msgs/{kind}", **dict(zip("xyz", map(float, values), strict=True)))

    def quaternion(self, values: Sequence[float]) -> Any:
        """A quaternion x, y, z, w."""
        return self("geometry_msgs/Quaternion", **dict(zip("xyzw", map(float, values), strict=True)))


def _joint_messages(
    make: _Messages, names: list[str], position: np.ndarray, velocity: np.ndarray, stamps: Sequence[int], root: str
) -> tuple[Any, list[Any]]:
    """The joints of arm and fingers (T, N) as one trajectory, and as a state for each frame; stamps in ns."""
    points = [
        make(
            "trajectory_msgs/JointTrajectoryPoint",
            positions=position[t],
            velocities=velocity[t],
            accelerations=np.zeros(0),
            effort=np.zeros(0),
            time_from_start=make.duration(ns),
        )
        for t, ns in enumerate(stamps)
    ]
    states = [
        make(
            "sensor_msgs/JointState",
            header=make.header(ns, root),
            name=names,
            position=position[t],
            velocity=velocity[t],
            effort=np.zeros(0),
        )
        for t, ns in enumerate(stamps)
    ]
    header = make.header(0, root)
    return make("trajectory_msgs/JointTrajectory", header=header, joint_names=names, points=points), states


def _wrist_trajectory(make: _Messages, wrist: Sequence[Any], stamps: Sequence[int], root: str) -> Any:
    """The palm's transforms in the world as one trajectory."""
    points = [
        make(
            "trajectory_msgs/MultiDOFJointTrajectoryPoint",
            transforms=[transform],
            velocities=[],
            accelerations=[],
            time_from_start=make.duration(ns),
        )
        for transform, ns in zip(wrist, stamps, strict=True)
    ]
    header = make.header(0, _WORLD)
    return make("trajectory_msgs/MultiDOFJointTrajectory", header=header, joint_names=[root], points=points)


def _transforms(make: _Messages, found: Sequence[Body], t: int, stamp: int) -> Any:
    """TF of all bodies at frame t."""
    transforms = []
    for body in found:
        turn = body.rotation[t].as_quat()
        place = body.translation[min(t, len(body.translation) - 1)]
        parent = found[body.parent].name if body.parent >= 0 else _WORLD
        transforms.append(
            make(
                "geometry_msgs/TransformStamped",
                header=make.header(stamp, parent),
                child_frame_id=body.name,
                transform=make(
                    "geometry_msgs/Transform", translation=make.vector(place), rotation=make.quaternion(turn)
                ),
            )
        )
    return make("tf2_msgs/TFMessage", transforms=transforms)


def _marker(
    make: _Messages,
    frame: str,
    namespace: str,
    number: int,
    corners: np.ndarray,
    colour: tuple[float, float, float],
    colours: Sequence[Sequence[float]] = (),
) -> Any:
    """Triangles with corners (3 E, 3) in a frame as a marker, in one colour or those of the corners."""
    upright = make.quaternion((0, 0, 0, 1))
    image = make("sensor_msgs/CompressedImage", header=make.header(0, ""), format="", data=np.zeros(0, np.uint8))
    return make(
        "visualization_msgs/Marker",
        header=make.header(0, frame),
        ns=namespace,
        id=number,
        type=11,  # a list of triangles
        action=0,
        pose=make("geometry_msgs/Pose", position=make.vector(np.zeros(3), "Point"), orientation=upright),
        scale=make.vector(np.ones(3)),
        color=make("std_msgs/ColorRGBA", **dict(zip("rgba", (*colour, 1.0), strict=True))),
        lifetime=make.duration(0),
        frame_locked=True,
        points=[make.vector(corner, "Point") for corner in corners],
        colors=[make("std_msgs/ColorRGBA", **dict(zip("rgba", (*each, 1.0), strict=True))) for each in colours],
        texture_resource="",
        texture=image,
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=make("visualization_msgs/MeshFile", filename="", data=np.zeros(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )


def read(path: pathlib.Path) -> list[Track]:
    """Reads a file with mcap-ros2-support: poses by joint trajectory and URDF, after a check that TF agrees."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    (file,) = path.glob("*.mcap")
    messages: dict[str, list[Any]] = {}
    with file.open("rb") as stream:
        for _, channel, _, message in make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            messages.setdefault(channel.topic, []).append(message)
    trees = [{t.child_frame_id: t for t in message.transforms} for message in messages["/tf"]]
    first = trees[0]
    local = {name: _poses([tree[name].transform for tree in trees]) for name in first}
    tf: dict[str, np.ndarray] = {}

    def visit(name: str) -> np.ndarray:
        """World poses (T, 4, 4) of a frame by TF."""
        if name not in tf:
            parent = first[name].header.frame_id
            tf[name] = local[name] if parent == _WORLD else visit(parent) @ local[name]
        return tf[name]

    for name in first:
        visit(name)
    (trajectory,) = messages["/joint_trajectory"]
    (wrist,) = messages["/wrist_trajectory"]
    positions = np.array([list(point.positions) for point in trajectory.points])
    angles = dict(zip(trajectory.joint_names, positions.T, strict=True))
    palm = _poses([point.transforms[0] for point in wrist.points])
    urdf = messages["/robot_description"][0].data
    root = ET.fromstring(urdf)[0].attrib["name"]
    described = forward_kinematics(urdf, angles, palm, wrist.joint_names[0], tf[root])
    poses = {name: described.get(name, tf[name]) for name in tf}
    apart = max(float(np.abs(poses[name] - tf[name]).max()) for name in tf)
    if apart > 1e-4:
        raise CongraspError(f"The joint trajectory and TF contradict each other by {apart:.2g}.")
    since = [10**9 * p.time_from_start.sec + p.time_from_start.nanosec for p in trajectory.points]
    time = 1e-9 * (np.array(since) - TRAJECTORY_START)
    triangles: dict[str, list[np.ndarray]] = {}
    for marker in [*messages["/object"], *(m for array in messages.get("/arm", ()) for m in array.markers)]:
        corners = np.array([[p.x, p.y, p.z] for p in marker.points]).reshape(-1, 3, 3)
        triangles.setdefault(marker.header.frame_id, []).append(corners)
    return [Track(time, poses, {name: np.concatenate(parts) for name, parts in triangles.items()})]


def _poses(transforms: Sequence[Any]) -> np.ndarray:
    """(T, 4, 4) matrices of T transforms."""
    position = np.array([[t.translation.x, t.translation.y, t.translation.z] for t in transforms])
    turns = Rotation.from_quat([[t.rotation.x, t.rotation.y, t.rotation.z, t.rotation.w] for t in transforms])
    return pose_matrices(position, turns)
