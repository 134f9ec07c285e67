"""Scene of a picture: shapes in the world frame, and a camera."""

import dataclasses
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

Kind = Literal["sphere", "capsule", "table", "mesh"]

_KEY = np.array([-0.45, -0.55, 1.0])  # towards the key light: right, away from the camera, up


@dataclasses.dataclass(frozen=True)
class Shape:
    """A shape to draw.

    `size` is a radius and a half length along z, zeros for a mesh; `position` (3,) and `quaternion` (4,) are in the
    world frame. `colour` is sRGB in [0, 1]. With `alpha` below one the shape is transparent, and casts no `shadow`.
    `vertices` (V, 3) and `faces` (F, 3) belong to a mesh. With `paint_points` (N, 3), in the shape's frame, and
    `paint_colours` (N, 3), each point of a mesh takes the colours of the nearest paint points. With `normals` (V, 3)
    and `colours` (V, 3), the mesh is drawn unchanged: it must be closed, wound outwards, and fine enough.
    """

    kind: Kind
    size: tuple[float, float]
    colour: tuple[float, float, float]
    position: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    quaternion: np.ndarray = dataclasses.field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    alpha: float = 1.0
    shine: float = 0.25
    shadow: bool = True
    vertices: np.ndarray | None = None
    faces: np.ndarray | None = None
    paint_points: np.ndarray | None = None
    paint_colours: np.ndarray | None = None
    normals: np.ndarray | None = None
    colours: np.ndarray | None = None


@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole camera at `position` that looks at `target`, both (3,) in the world frame; z is up."""

    position: np.ndarray
    target: np.ndarray
    field_of_view: float = 30.0
    """Degrees from the lower to the upper edge of the picture."""

    def axes(self) -> np.ndarray:
        """(3, 3) rows: right, up and forward."""
        forward = np.subtract(self.target, self.position)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(right, forward), forward])

    def key_light(self) -> np.ndarray:
        """(3,) unit direction towards the key light, which stays at the camera's left."""
        right = self.axes()[0]
        key = _KEY @ np.stack([right, np.cross([0.0, 0.0, 1.0], right), [0.0, 0.0, 1.0]])
        return key / np.linalg.norm(key)


def between(
    start: np.ndarray,
    end: np.ndarray,
    radius: float,
    colour: tuple[float, float, float],
    *,
    shadow: bool = True,
) -> Shape:
    """A capsule from `start` to `end` (3,), or a ball if they coincide; for the other arguments see `Shape`."""
    along = np.subtract(end, start)
    length = float(np.linalg.norm(along))
    middle = np.add(start, end) / 2
    if length < 1e-9:
        return Shape("sphere", (radius, 0.0), colour, middle, shadow=shadow)
    turn = Rotation.align_vectors([along / length], [[0.0, 0.0, 1.0]])[0].as_quat(scalar_first=True)
    return Shape("capsule", (radius, length / 2), colour, middle, turn, shadow=shadow)
