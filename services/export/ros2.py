"""A ROS 2 bag (MCAP).

Topics: `/robot_description` (URDF), `/joint_trajectory` (all frames, joints of arm and fingers),
`/wrist_trajectory` (all frames, the palm in the world), `/joint_states`, `/tf` (frame by frame),
`/object` (a marker with the mesh), `/arm` (markers with the meshes of the arm's links, if there is
one).
"""

import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rosbags.interfaces import (
    Nodetype,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from congrasp.common.episode.episode import Episode
from congrasp.services.appearance.surface_colours import colours_at
from congrasp.services.export.frames import COLOURS, OBJECT, arm_meshes, bodies, facts
from congrasp.services.export.joint_trajectory import joint_trajectory, robot_joints
from congrasp.services.export.urdf import robot_urdf

_WORLD = "world"
_OFTEN = ("/joint_states", "/tf")
"""Topics with a message for each frame; the others have one, which late subscribers receive."""
_NEVER = QosTime(0x7FFFFFFF, 0xFFFFFFFF)
_LATCHED = Qos(
    history=QosHistory.KEEP_LAST,
    depth=1,
    reliability=QosReliability.RELIABLE,
    durability=QosDurability.TRANSIENT_LOCAL,
    deadline=_NEVER,
    lifespan=_NEVER,
    liveliness=QosLiveliness.AUTOMATIC,
    liveliness_lease_duration=_NEVER,
    avoid_ros_namespace_conventions=False,
)
_TRIANGLES = 11  # a marker's type
_Content = Mapping[str, Any]
"""Fields of a message; fields of messages in it are mappings, too, and absent ones are zero, false
or empty.
"""


def write(path: pathlib.Path, motions: Sequence[Episode]) -> None:
    """Writes one motion as a bag, which is a folder; it begins at one second, since in TF zero
    means any time.
    """
    (motion,) = motions
    store = get_typestore(Stores.ROS2_HUMBLE)
    position, velocity, stamps = joint_trajectory(motion, motion.joint_position.astype(float))
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        about = facts(
            motion,
            frame=f"{_WORLD}: z up; TF frames are the links",
            unit="m, rad, s",
            quaternion="by name",
        )
        bag.set_custom_data("congrasp", json.dumps(about))
        for topic, (kind, messages) in _topics(motion, position, velocity, stamps).items():
            qos = [] if topic in _OFTEN else [_LATCHED]
            channel = bag.add_connection(topic, kind, typestore=store, offered_qos_profiles=qos)
            for stamp, content in zip(stamps, messages, strict=False):
                bag.write(channel, stamp, store.serialize_cdr(_message(store, kind, content), kind))


def _topics(
    motion: Episode, position: np.ndarray, velocity: np.ndarray, stamps: Sequence[int]
) -> dict[str, tuple[str, Sequence[_Content]]]:
    """Types and messages of all topics, from the joints' positions and velocities (T, N) at T times
    in ns.
    """
    frames = _transforms(motion, stamps)
    palm = next(
        i for i, transform in enumerate(frames[0]) if transform["header"]["frame_id"] == _WORLD
    )
    wrist, joints = frames[0][palm]["child_frame_id"], robot_joints(motion)
    rows = list(zip(position, velocity, stamps, strict=True))
    points = [
        {"positions": q, "velocities": v, "time_from_start": _time(stamp)} for q, v, stamp in rows
    ]
    poses = [
        {"transforms": [frame[palm]["transform"]], "time_from_start": _time(stamp)}
        for frame, stamp in zip(frames, stamps, strict=True)
    ]
    trajectory = {"header": _header(0, wrist), "joint_names": joints, "points": points}
    path = {"header": _header(0, _WORLD), "joint_names": [wrist], "points": poses}
    states = [
        {"header": _header(stamp, wrist), "name": joints, "position": q, "velocity": v}
        for q, v, stamp in rows
    ]
    corners = motion.object_vertices[motion.object_faces.ravel()]
    thing = _marker(OBJECT, motion.object, 0, corners, COLOURS[OBJECT])
    if motion.colours:
        thing["colors"] = [
            _colour(each) for each in (colours_at(corners, motion.colours) / 255).tolist()
        ]
    topics: dict[str, tuple[str, Sequence[_Content]]] = {
        "/robot_description": ("std_msgs/msg/String", [{"data": robot_urdf(motion)}]),
        "/joint_trajectory": ("trajectory_msgs/msg/JointTrajectory", [trajectory]),
        "/wrist_trajectory": ("trajectory_msgs/msg/MultiDOFJointTrajectory", [path]),
        "/object": ("visualization_msgs/msg/Marker", [thing]),
    }
    if arm := motion.arm:
        parts = [
            _marker(name, arm.name, number, mesh.vertices[mesh.faces.ravel()], mesh.colour)
            for name, meshes in arm_meshes(motion).items()
            for number, mesh in enumerate(meshes)
        ]
        topics["/arm"] = ("visualization_msgs/msg/MarkerArray", [{"markers": parts}])
    topics["/joint_states"] = ("sensor_msgs/msg/JointState", states)
    topics["/tf"] = ("tf2_msgs/msg/TFMessage", [{"transforms": frame} for frame in frames])
    return topics


def _message(store: Typestore, kind: str, content: _Content) -> Any:
    """A message of a type."""

    def value(node: Nodetype, of: Any, given: Any) -> Any:
        """A field's value; `of` is the type of a field or, in a sequence, of its items."""
        if node == Nodetype.NAME:
            return _message(store, of, given or {})
        if node == Nodetype.BASE:
            return given if given is not None else "" if of[0] == "string" else 0
        (item, type_of_item), _ = of
        if item == Nodetype.BASE and type_of_item[0] != "string":
            return np.array([] if given is None else given, type_of_item[0])
        return [value(item, type_of_item, each) for each in given or ()]

    fields = store.fielddefs[kind][1]
    return store.types[kind](
        **{name: value(node, of, content.get(name)) for name, (node, of) in fields}
    )


def _transforms(motion: Episode, stamps: Sequence[int]) -> list[list[dict[str, Any]]]:
    """TF of all bodies at each of T times in ns."""
    found = bodies(motion)
    parents = [found[body.parent].name if body.parent >= 0 else _WORLD for body in found]
    turns = [body.rotation.as_quat() for body in found]
    places = [np.broadcast_to(body.translation, (len(stamps), 3)) for body in found]
    return [
        [
            {
                "header": _header(stamp, parents[i]),
                "child_frame_id": body.name,
                "transform": {
                    "translation": _named("xyz", places[i][t]),
                    "rotation": _named("xyzw", turns[i][t]),
                },
            }
            for i, body in enumerate(found)
        ]
        for t, stamp in enumerate(stamps)
    ]


def _marker(
    frame: str, namespace: str, number: int, corners: np.ndarray, colour: Sequence[float]
) -> dict[str, Any]:
    """Triangles of one colour, with corners (3 E, 3) in a frame, as a marker."""
    return {
        "header": _header(0, frame),
        "ns": namespace,
        "id": number,
        "type": _TRIANGLES,
        "pose": {"orientation": {"w": 1.0}},
        "scale": _named("xyz", np.ones(3)),
        "color": _colour(colour),
        "frame_locked": True,
        "points": [_named("xyz", corner) for corner in corners],
    }


def _colour(colour: Sequence[float]) -> _Content:
    """An opaque colour, red, green, blue from 0 to 1."""
    return _named("rgba", [*colour, 1.0])


def _header(stamp: int, frame: str) -> _Content:
    """A header with a time in ns."""
    return {"stamp": _time(stamp), "frame_id": frame}


def _time(ns: int) -> _Content:
    """A time or duration in ns."""
    return {"sec": ns // 10**9, "nanosec": ns % 10**9}


def _named(names: str, values: Sequence[float] | np.ndarray) -> _Content:
    """Numbers by one-letter names."""
    return dict(zip(names, map(float, values), strict=True))
