"""A ROS 2 bag (MCAP).

Topics: `/robot_description` (URDF), `/joint_trajectory` (all frames, joints of arm and fingers),
`/wrist_trajectory` (all frames, the palm in the world), `/joint_states`, `/tf` (frame by frame),
`/object` (a marker with the mesh), `/arm` (markers with the meshes of the arm's links, if there is
one).
"""

import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

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
from congrasp.services.export.facts import facts
from congrasp.services.export.frames import OBJECT, bodies
from congrasp.services.export.joint_trajectory import (
    JointTrajectory,
    joint_trajectory,
    robot_joints,
)
from congrasp.services.export.surfaces import COLOURS, arm_meshes
from congrasp.services.export.urdf import robot_urdf

_WORLD = "world"
_FRAME_TOPICS = ("/joint_states", "/tf")
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
_TRIANGLE_LIST = 11  # a type of visualization_msgs/Marker
_Content = Mapping[str, Any]
"""Fields of a message by name. A field that is itself a message is a mapping, too; an absent field
is zero, false or empty.
"""


class _Topic(NamedTuple):
    """A topic of the bag."""

    kind: str
    """Type of its messages."""
    messages: Sequence[_Content]


def write(path: pathlib.Path, motions: Sequence[Episode]) -> None:
    """Writes one motion as a bag, which is a folder.

    The bag begins at one second, because time zero means the newest transform in TF.
    """
    (motion,) = motions
    store = get_typestore(Stores.ROS2_HUMBLE)
    trajectory = joint_trajectory(motion, motion.joint_position.astype(float))
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        about = facts(
            motion,
            frame=f"{_WORLD}: z up; TF frames are the links",
            unit="m, rad, s",
            quaternion="by name",
        )
        bag.set_custom_data("congrasp", json.dumps(about))
        for name, topic in _topics(motion, trajectory).items():
            qos = [] if name in _FRAME_TOPICS else [_LATCHED]
            channel = bag.add_connection(
                name, topic.kind, typestore=store, offered_qos_profiles=qos
            )
            # A topic with a single message has it at the first time.
            for stamp, content in zip(trajectory.stamps, topic.messages, strict=False):
                message = _message(store, topic.kind, content)
                bag.write(channel, stamp, store.serialize_cdr(message, topic.kind))


def _topics(motion: Episode, trajectory: JointTrajectory) -> dict[str, _Topic]:
    """All topics by name, from the trajectory of arm and fingers."""
    transforms = _transforms(motion, trajectory.stamps)
    # The hand's links come first, so that the first body in the world frame is the palm.
    palm = next(i for i, body in enumerate(transforms[0]) if body["header"]["frame_id"] == _WORLD)
    wrist = transforms[0][palm]["child_frame_id"]
    joints = robot_joints(motion)
    points = []
    wrist_points = []
    states = []
    for t, stamp in enumerate(trajectory.stamps):
        time = _time(stamp)
        position = trajectory.positions[t]
        velocity = trajectory.velocities[t]
        pose = transforms[t][palm]["transform"]
        points.append({"positions": position, "velocities": velocity, "time_from_start": time})
        wrist_points.append({"transforms": [pose], "time_from_start": time})
        state = {
            "header": _header(stamp, wrist),
            "name": joints,
            "position": position,
            "velocity": velocity,
        }
        states.append(state)
    path = {"header": _header(0, wrist), "joint_names": joints, "points": points}
    wrist_path = {"header": _header(0, _WORLD), "joint_names": [wrist], "points": wrist_points}
    topics = {
        "/robot_description": _Topic("std_msgs/msg/String", [{"data": robot_urdf(motion)}]),
        "/joint_trajectory": _Topic("trajectory_msgs/msg/JointTrajectory", [path]),
        "/wrist_trajectory": _Topic("trajectory_msgs/msg/MultiDOFJointTrajectory", [wrist_path]),
        "/object": _Topic("visualization_msgs/msg/Marker", [_object_marker(motion)]),
    }
    if motion.arm:
        markers = _arm_markers(motion, motion.arm.name)
        topics["/arm"] = _Topic("visualization_msgs/msg/MarkerArray", [{"markers": markers}])
    topics["/joint_states"] = _Topic("sensor_msgs/msg/JointState", states)
    frames = [{"transforms": links} for links in transforms]
    topics["/tf"] = _Topic("tf2_msgs/msg/TFMessage", frames)
    return topics


def _message(store: Typestore, kind: str, content: _Content) -> Any:
    """Returns the message of a type, with defaults for absent fields."""
    fields = {}
    for name, (node, field_type) in store.fielddefs[kind][1]:
        fields[name] = _field(store, node, field_type, content.get(name))
    return store.types[kind](**fields)


def _field(store: Typestore, node: Nodetype, field_type: Any, content: Any) -> Any:
    """Returns the value of a field, or of an item of a sequence.

    Args:
      store: types of messages.
      node: kind of field: a message, a basic type, or a sequence.
      field_type: name of the message; name and maximum length of the basic type; or kind and type
        of the sequence's items, and its maximum length.
      content: content of the field; None for zero, false or empty.
    """
    if node == Nodetype.NAME:
        return _message(store, field_type, content or {})
    if node == Nodetype.BASE:
        if content is not None:
            return content
        return "" if field_type[0] == "string" else 0
    (item_node, item_type), _ = field_type
    items = () if content is None else content
    if item_node == Nodetype.BASE and item_type[0] != "string":
        return np.array(items, item_type[0])
    return [_field(store, item_node, item_type, item) for item in items]


def _transforms(motion: Episode, stamps: Sequence[int]) -> list[list[dict[str, Any]]]:
    """Returns the transforms of all bodies at each of T times in ns."""
    motion_bodies = bodies(motion)
    names = [body.name for body in motion_bodies]
    parents = [names[body.parent] if body.parent >= 0 else _WORLD for body in motion_bodies]
    turns = [body.rotation.as_quat() for body in motion_bodies]
    places = [np.broadcast_to(body.translation, (len(stamps), 3)) for body in motion_bodies]
    frames = []
    for t, stamp in enumerate(stamps):
        transforms = []
        for i, name in enumerate(names):
            pose = {
                "translation": _named("xyz", places[i][t]),
                "rotation": _named("xyzw", turns[i][t]),
            }
            header = _header(stamp, parents[i])
            transforms.append({"header": header, "child_frame_id": name, "transform": pose})
        frames.append(transforms)
    return frames


def _object_marker(motion: Episode) -> dict[str, Any]:
    """Returns the object as a marker, with the colours of its corners if they are known."""
    corners = motion.object_vertices[motion.object_faces.ravel()]
    marker = _marker(OBJECT, motion.object, 0, corners, COLOURS[OBJECT])
    if motion.colours:
        colours = colours_at(corners, motion.colours) / 255
        marker["colors"] = [_colour(colour) for colour in colours.tolist()]
    return marker


def _arm_markers(motion: Episode, arm: str) -> list[dict[str, Any]]:
    """Returns the meshes of an arm's links as markers; `arm` is its name."""
    markers = []
    for link, meshes in arm_meshes(motion).items():
        for number, mesh in enumerate(meshes):
            corners = mesh.vertices[mesh.faces.ravel()]
            markers.append(_marker(link, arm, number, corners, mesh.colour))
    return markers


def _marker(
    frame: str, namespace: str, number: int, corners: np.ndarray, colour: Sequence[float]
) -> dict[str, Any]:
    """Returns a marker of triangles.

    Args:
      frame: name of its frame.
      namespace: with `number`, its id.
      number: see `namespace`.
      corners: (3 E, 3) m, three for each triangle.
      colour: red, green and blue, from 0 to 1.
    """
    return {
        "header": _header(0, frame),
        "ns": namespace,
        "id": number,
        "type": _TRIANGLE_LIST,
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
