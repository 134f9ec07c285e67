"""Shapes of a picture, in the world frame: objects, arms, the table, arrows, strings of beads."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.episode.arm import MovedArm
from congrasp.common.objects.spec import Colours
from congrasp.common.runtime.lazy_trimesh import trimesh
from congrasp.services.appearance.palette import OBJECT, TABLE, Colour

Kind = Literal["sphere", "capsule", "table", "mesh"]

_TABLE_RADIUS_M = 0.6
_SHORTEST_M = 1e-9
"""Distance below which two points coincide, m."""
_CONE_SIDES = 32
_CONE_LENGTH = 6.0
"""Length of an arrow's tip, in radii of its shaft."""
_CONE_RADIUS = 2.4
"""Radius of an arrow's tip at its base, in radii of its shaft."""
_STRING_RADIUS = 0.4
"""Radius of the string between beads, in radii of a bead."""


@dataclasses.dataclass(frozen=True)
class Shape:
    """A shape to draw.

    `size` is a radius and a half length along z, zeros for a mesh; `position` (3,) and `quaternion`
    (4,) are in the world frame. `colour` is sRGB in [0, 1]. With `alpha` below one the shape is
    transparent, and casts no `shadow`. `vertices` (V, 3) and `faces` (F, 3) belong to a mesh. With
    `paint`, in the shape's frame, each point of a mesh has the mean colour of the nearest paint
    points. With `normals` (V, 3) and `colours` (V, 3), the mesh is drawn unchanged: it must be
    closed, wound outwards, and fine enough.
    """

    kind: Kind
    size: tuple[float, float]
    colour: tuple[float, float, float]
    position: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    quaternion: np.ndarray = dataclasses.field(
        default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0])
    )
    alpha: float = 1.0
    shine: float = 0.25
    shadow: bool = True
    vertices: np.ndarray | None = None
    faces: np.ndarray | None = None
    paint: Colours | None = None
    normals: np.ndarray | None = None
    colours: np.ndarray | None = None


def between(
    start: np.ndarray,
    end: np.ndarray,
    radius: float,
    colour: tuple[float, float, float],
    *,
    shadow: bool = True,
) -> Shape:
    """A capsule from `start` to `end` (3,), or a ball if they coincide.

    The other arguments are those of `Shape`.
    """
    along = np.subtract(end, start)
    length = float(np.linalg.norm(along))
    middle = np.add(start, end) / 2
    if length < _SHORTEST_M:
        return Shape("sphere", (radius, 0.0), colour, middle, shadow=shadow)
    turn = Rotation.align_vectors([along / length], [[0.0, 0.0, 1.0]])[0].as_quat(scalar_first=True)
    return Shape("capsule", (radius, length / 2), colour, middle, turn, shadow=shadow)


def object_shape(
    mesh: tuple[np.ndarray, np.ndarray],
    position: np.ndarray,
    quaternion: np.ndarray,
    paint: Colours | None = None,
    colour: Colour = OBJECT,
) -> Shape:
    """An object.

    Args:
      mesh: (V, 3) and (F, 3) in its frame.
      position: (3,) m, world.
      quaternion: (4,) from its frame to the world.
      paint: colours of its surface, in its frame; optional.
      colour: colour without paint.
    """
    return Shape(
        "mesh",
        (0, 0),
        colour,
        np.asarray(position, float),
        np.asarray(quaternion, float),
        vertices=mesh[0],
        faces=mesh[1],
        paint=paint,
    )


def arm_shapes(arm: MovedArm, frame: int) -> list[Shape]:
    """Returns the links of an arm in a frame of its motion."""
    return [
        object_shape(
            (mesh.vertices, mesh.faces),
            arm.link_position[frame, mesh.link],
            arm.link_quaternion[frame, mesh.link],
            colour=mesh.colour,
        )
        for mesh in arm.meshes
    ]


def table_shape(below: np.ndarray, height: float = 0.0) -> Shape:
    """A table top at a height, m, under a point (3,), whose edge fades away."""
    return Shape(
        "table",
        (_TABLE_RADIUS_M, 0.0),
        TABLE,
        np.array([below[0], below[1], height]),
        shine=0.0,
        shadow=False,
    )


def arrow(start: np.ndarray, end: np.ndarray, radius: float, colour: Colour) -> list[Shape]:
    """A shaft with a cone whose tip is at `end` (3,), without a shadow."""
    along = np.subtract(end, start)
    direction = along / np.linalg.norm(along)
    neck = end - _CONE_LENGTH * radius * direction
    turn = Rotation.align_vectors([direction], [[0.0, 0.0, 1.0]])[0].as_quat(scalar_first=True)
    vertices, faces = _cone(_CONE_RADIUS * radius, _CONE_LENGTH * radius)
    cone = Shape("mesh", (0, 0), colour, neck, turn, shadow=False, vertices=vertices, faces=faces)
    return [between(start, neck, radius, colour, shadow=False), cone]


def _cone(radius: float, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3) of a closed cone along z, with its base at height zero."""
    angles = np.linspace(0, 2 * np.pi, _CONE_SIDES, endpoint=False)
    ring = np.stack(
        [radius * np.cos(angles), radius * np.sin(angles), np.zeros(_CONE_SIDES)], axis=-1
    )
    vertices = np.concatenate([ring, [[0.0, 0.0, length], [0.0, 0.0, 0.0]]])
    tip = np.full(_CONE_SIDES, _CONE_SIDES)
    middle = np.full(_CONE_SIDES, _CONE_SIDES + 1)
    here = np.arange(_CONE_SIDES)
    after = (here + 1) % _CONE_SIDES
    mantle = np.stack([here, after, tip], axis=-1)
    base = np.stack([after, here, middle], axis=-1)
    return vertices, np.concatenate([mantle, base])


def beads(points: np.ndarray, radius: float, colour: Colour) -> Shape:
    """Balls at points (N, 3) on a string, without a shadow."""
    parts: list[Any] = []
    for point in points:
        parts.append(trimesh.creation.icosphere(1, radius).apply_translation(point))
    for pair in itertools.pairwise(points):
        if np.linalg.norm(np.subtract(*pair)) > 1e-6:
            parts.append(
                trimesh.creation.cylinder(_STRING_RADIUS * radius, segment=pair, sections=8)
            )
    mesh: Any = trimesh.util.concatenate(parts)
    return Shape("mesh", (0, 0), colour, shadow=False, vertices=mesh.vertices, faces=mesh.faces)


def shape_points(shape: Shape) -> np.ndarray:
    """(n, 3) points, world frame, that a picture of a capsule or a mesh must contain."""
    turn = Rotation.from_quat(shape.quaternion, scalar_first=True)
    if shape.vertices is not None:
        return turn.apply(shape.vertices) + shape.position
    radius, half_length = shape.size
    ends = shape.position + turn.apply([[0, 0, half_length], [0, 0, -half_length]])
    sides = radius * np.concatenate([np.eye(3), -np.eye(3)])
    return (ends[:, None] + sides).reshape(-1, 3)


def points_of(shapes: Sequence[Shape]) -> np.ndarray:
    """(n, 3) points, world frame, that a picture of the shapes must contain."""
    return np.concatenate([shape_points(shape) for shape in shapes])
