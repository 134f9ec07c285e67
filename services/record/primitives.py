"""Primitives of Foxglove's scenes: meshes, capsules, balls, arrows, and clouds of points."""

from typing import Any

import numpy as np
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TriangleListPrimitive_pb2 import TriangleListPrimitive
from scipy.spatial.transform import Rotation

from congrasp.common.hands.spec import Link, capsule_ends

Rgba = tuple[float, float, float, float]
_SHAFT = 0.7
"""Share of an arrow's shaft in its length."""
_HEAD = 0.3
"""Share of an arrow's head in its length."""
_CLOUD_FIELDS = (
    ("x", 0, PackedElementField.FLOAT32),
    ("y", 4, PackedElementField.FLOAT32),
    ("z", 8, PackedElementField.FLOAT32),
    ("red", 12, PackedElementField.UINT8),
    ("green", 13, PackedElementField.UINT8),
    ("blue", 14, PackedElementField.UINT8),
    ("alpha", 15, PackedElementField.UINT8),
)
"""Name, offset in bytes and type of each field of a cloud's point."""


def new_entity(
    update: SceneUpdate, name: str, frame: str, now: int, *, lifetime: int = 0
) -> SceneEntity:
    """Adds an entity that moves with its frame.

    Args:
      update: the message that gets the entity.
      name: identifies the entity; one of the same name is replaced.
      frame: name of the frame.
      now: time of the message, ns.
      lifetime: time after which it is removed, ns; 0 keeps it until it is replaced or removed.
    """
    entity = update.entities.add(id=name, frame_id=frame, frame_locked=True)
    entity.timestamp.FromNanoseconds(now)
    entity.lifetime.FromNanoseconds(lifetime)
    return entity


def add_triangles(
    entity: SceneEntity, points: np.ndarray, faces: np.ndarray, colour: Rgba
) -> TriangleListPrimitive:
    """Adds a mesh (V, 3), (E, 3) in the entity's frame."""
    mesh = entity.triangles.add()
    mesh.pose.orientation.w = 1.0
    for point in points:
        set_vector(mesh.points.add(), point)
    mesh.indices.extend(faces.ravel().tolist())
    set_colour(mesh.color, colour)
    return mesh


def add_capsules(entity: SceneEntity, link: Link, colour: Rgba) -> None:
    """Adds a link's capsules, which fill gaps in its skin at bent joints."""
    for capsule, (start, end) in zip(link.capsules, capsule_ends(link), strict=True):
        length = float(np.linalg.norm(end - start))
        if length > 0:  # otherwise one ball is the capsule
            cylinder = entity.cylinders.add(bottom_scale=1.0, top_scale=1.0)
            set_vector(cylinder.pose.position, (start + end) / 2)
            turn = _turn_onto([0.0, 0.0, 1.0], (end - start) / length)
            set_quaternion(cylinder.pose.orientation, turn)
            set_vector(cylinder.size, [2 * capsule.radius, 2 * capsule.radius, length])
            set_colour(cylinder.color, colour)
            add_ball(entity, end, capsule.radius, colour)
        add_ball(entity, start, capsule.radius, colour)


def add_ball(entity: SceneEntity, centre: np.ndarray, radius: float, colour: Rgba) -> None:
    """Adds a ball at a centre (3,), m."""
    ball = entity.spheres.add()
    set_vector(ball.pose.position, centre)
    ball.pose.orientation.w = 1.0
    set_vector(ball.size, [2 * radius] * 3)
    set_colour(ball.color, colour)


def add_arrow(
    entity: SceneEntity,
    start: np.ndarray,
    direction: np.ndarray,
    length: float,
    width: float,
    colour: Rgba,
) -> None:
    """Adds an arrow from `start` (3,) along a unit direction (3,); lengths are in m."""
    arrow = entity.arrows.add(
        shaft_length=_SHAFT * length,
        shaft_diameter=width,
        head_length=_HEAD * length,
        head_diameter=2 * width,
    )
    set_vector(arrow.pose.position, start)
    set_quaternion(arrow.pose.orientation, _turn_onto([1.0, 0.0, 0.0], direction))
    set_colour(arrow.color, colour)


def point_cloud(frame: str, points: np.ndarray, colours: np.ndarray, now: int) -> PointCloud:
    """Returns points (N, 3), m, in the frame of a name, with colours (N, 3) from 0 to 1, at the
    time `now` (ns).
    """
    packed = np.zeros(len(points), [("position", "<f4", 3), ("colour", "u1", 4)])
    packed["position"] = points
    # Foxglove's packed colours are red, green, blue, alpha in memory, one byte field each.
    packed["colour"][:, :3] = np.multiply(colours, 255)
    packed["colour"][:, 3] = 255
    cloud = PointCloud(frame_id=frame, point_stride=packed.dtype.itemsize, data=packed.tobytes())
    cloud.timestamp.FromNanoseconds(now)
    cloud.pose.position.SetInParent()  # readers may miss an absent position
    cloud.pose.orientation.w = 1.0
    for name, offset, kind in _CLOUD_FIELDS:
        cloud.fields.add(name=name, offset=offset, type=kind)
    return cloud


def _turn_onto(axis: list[float], direction: np.ndarray) -> np.ndarray:
    """Quaternion (w, x, y, z) that rotates a unit axis to a unit direction (3,)."""
    return Rotation.align_vectors([direction], [axis])[0].as_quat(scalar_first=True)


def set_vector(target: Any, value: Any) -> None:
    """Sets x, y and z."""
    target.x, target.y, target.z = map(float, value)


def set_quaternion(target: Any, value: Any) -> None:
    """Sets w, x, y and z."""
    target.w, target.x, target.y, target.z = map(float, value)


def set_colour(target: Any, value: Rgba) -> None:
    """Sets red, green, blue and alpha."""
    target.r, target.g, target.b, target.a = value
