"""Pictures of shapes without OpenGL, EGL or a display: triangles into a depth buffer, a soft key
light and the sky.

Both lights are sets of distant lamps with shadow maps.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from congrasp.services.viz.kernels import NOTHING, add_light, averaged, cover, shade
from congrasp.services.viz.shapes import Camera, Shape, fit, shape_points
from congrasp.services.viz.triangles import Triangles, joined, triangles_of


class Lamps(NamedTuple):
    """Resolution of a soft light."""

    key: int
    """Number of lamps of the key light."""
    sky: int
    """Number of lamps of the sky."""
    grid: int
    """Samples along each side of a shadow map."""


MANY, FEW = Lamps(24, 48, 160), Lamps(12, 24, 160)
"""For bodies in large pictures, and in small ones."""
ON_TABLE = Lamps(48, 160, 64)
"""For a table top: the shadow of a high body is so wide that few lamps would show as bands."""
_KEY_SIZE = 0.12  # radius of the key light at a distance of one
_SKIN = 1.5  # height above the surface at which its light is looked up, in samples


def light_on(
    points: np.ndarray, normals: np.ndarray, bodies: Triangles, key: np.ndarray, lamps: Lamps
) -> np.ndarray:
    """(n, 2) shares of the key light and of the sky that bodies let through to points of surfaces.

    Args:
      points: (n, 3).
      normals: (n, 3) of the surfaces there.
      bodies: bodies that cast shadows.
      key: (3,) unit direction towards the key light.
      lamps: numbers of lamps, and their resolution.
    """
    light, whole = np.zeros((2, len(points))), np.full(len(points), 1e-6)
    for lamp in _disc(key, lamps.key, _KEY_SIZE):
        _add(
            lamp, lamps.grid, np.full(len(points), 1 / lamps.key), points, normals, bodies, light[0]
        )
    for lamp in _dome(lamps.sky):
        # A lamp represents a patch of the sky
        facing = np.clip(0.75 * (normals @ lamp) + 0.25, 0, None)
        _add(lamp, lamps.grid, facing, points, normals, bodies, light[1])
        whole += facing
    light[1] /= whole
    return light.T


def _add(
    lamp: np.ndarray,
    grid: int,
    strength: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    bodies: Triangles,
    total: np.ndarray,
) -> None:
    """Adds the visible share of a distant lamp in direction (3,), times a strength (n,), to the
    points' light (n,).
    """
    if not len(bodies.faces):
        total += strength
        return
    side = np.cross(lamp, [1.0, 0.0, 0.0])
    side = side / np.linalg.norm(side)
    axes = np.stack([side, np.cross(lamp, side), lamp])  # right, up, towards the lamp
    x, y, height = axes @ bodies.points.T
    sample = max(np.ptp(x), np.ptp(y)) / (grid - 3)
    # One empty sample on each side, so that points beyond the map are lit.
    left, upper = x.min() - sample, y.max() + sample
    top, owner = np.full((grid, grid), -np.inf, np.float32), np.empty((grid, grid), np.int32)
    corners = np.stack([x - left, upper - y], -1) / sample
    cover(corners, height, bodies.faces, bodies.closed, top, owner)
    lifted = points + np.float32(_SKIN * sample) * normals
    add_light(lifted, strength, axes, np.array([left, upper, sample]), sample, top, total)


def _disc(direction: np.ndarray, count: int, radius: float) -> np.ndarray:
    """(count, 3) directions around a unit direction, spread over a disc by the golden angle."""
    side = np.cross(direction, [0.0, 0.0, 1.0])
    side = side / np.linalg.norm(side)
    other = np.cross(direction, side)
    step = np.arange(count) + 0.5
    r, angle = radius * np.sqrt(step / count), step * np.pi * (3 - np.sqrt(5))
    spread = direction + (r * np.cos(angle))[:, None] * side + (r * np.sin(angle))[:, None] * other
    return spread / np.linalg.norm(spread, axis=1, keepdims=True)


def _dome(count: int) -> np.ndarray:
    """(count, 3) directions spread evenly over the upper half of the sphere."""
    step = np.arange(count) + 0.5
    z, angle = 0.08 + 0.92 * step / count, step * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], -1)


SAMPLES = 2
"""Samples along each side of a pixel."""
_NEAR = 0.01  # m
_LARGE = 500_000  # pixels
# Background, sRGB
_TOP, _BOTTOM = (
    np.array([0.93, 0.945, 0.965], np.float32),
    np.array([0.80, 0.82, 0.85], np.float32),
)


def render_scene(
    shapes: Sequence[Shape], camera: Camera, size: tuple[int, int] = (640, 480)
) -> np.ndarray:
    """Draws the shapes.

    Args:
      shapes: shapes to draw, in a world frame with the z axis up.
      camera: the camera.
      size: width and height in pixels.

    Returns:
      (height, width, 3) uint8 sRGB.
    """
    solid = [shape for shape in shapes if shape.alpha >= 1]
    table = triangles_of(shape for shape in solid if shape.kind == "table")
    bodies = _turned(triangles_of(shape for shape in solid if shape.kind != "table"), camera)
    casting = triangles_of((shape for shape in solid if shape.shadow), fine=False)
    key, lamps = camera.key_light(), MANY if size[0] * size[1] > _LARGE else FEW
    coarse = _Picture.empty(camera, *size)  # the table has no edge: one sample a pixel is enough
    coarse.add(table, light_on(table.points, table.normals, casting, key, ON_TABLE))
    picture = coarse.finer()
    picture.add(bodies, light_on(bodies.points, bodies.normals, casting, key, lamps))
    for alpha in sorted({shape.alpha for shape in shapes if shape.alpha < 1}):
        glass = _turned(triangles_of(shape for shape in shapes if shape.alpha == alpha), camera)
        picture.add(glass, np.ones((len(glass.points), 2), np.float32), alpha)
    return averaged(picture.image, SAMPLES)


def render_fitted(
    shapes: Sequence[Shape],
    view: Sequence[float] | np.ndarray,
    size: tuple[int, int],
    around: Sequence[Shape] = (),
) -> np.ndarray:
    """Renders shapes and others around them by the nearest camera in direction `view` (3,) that
    sees `shapes`.
    """
    points = np.concatenate([shape_points(shape) for shape in shapes])
    return render_scene([*shapes, *around], fit(points, np.array(view), size[0] / size[1]), size)


def visible(shapes: Sequence[Shape], camera: Camera, size: tuple[int, int]) -> np.ndarray:
    """(height, width) index of the solid shape that each pixel shows, -1 for the background."""
    solid = [i for i, shape in enumerate(shapes) if shape.alpha >= 1]
    parts = [triangles_of([shapes[i]], fine=False) for i in solid]
    shape_of = np.array([*np.repeat(solid, [len(part.faces) for part in parts]), NOTHING])
    return shape_of[_Picture.empty(camera, *size).owners(joined(parts))]


def _turned(triangles: Triangles, camera: Camera) -> Triangles:
    """Triangles with the normals of open surfaces, which may wind either way, towards the
    camera.
    """
    first, second, third = np.moveaxis(triangles.corners, 1, 0)
    away = _dot(np.cross(second - first, third - first), first - camera.position) > 0
    normals = triangles.normals.copy()
    turned = triangles.faces[away & ~triangles.closed]
    normals[turned] = -triangles.normals[turned]
    return triangles._replace(normals=normals)


class _Picture:
    """A picture in progress: (height, width, 3) sRGB, and the inverse depth of each sample."""

    def __init__(self, camera: Camera, image: np.ndarray, nearness: np.ndarray):
        self._camera, self.image, self._nearness = camera, image, nearness

    @classmethod
    def empty(cls, camera: Camera, width: int, height: int) -> "_Picture":
        """Returns a picture of the background."""
        share = np.linspace(1, 0, height, dtype=np.float32)[:, None, None]
        image = np.broadcast_to(share * _TOP + (1 - share) * _BOTTOM, (height, width, 3)).copy()
        return cls(camera, image, np.zeros((height, width), np.float32))

    def finer(self) -> "_Picture":
        """Returns the same picture with more samples."""
        image, nearness = (
            each.repeat(SAMPLES, 0).repeat(SAMPLES, 1) for each in (self.image, self._nearness)
        )
        return _Picture(self._camera, image, nearness)

    def add(self, triangles: Triangles, light: np.ndarray, alpha: float = 1.0) -> None:
        """Draws triangles where they are nearest, with the shares of light (V, 2) at their
        points.
        """
        corners, nearness = self._projected(triangles.points)
        top, owner = self._covered(corners, nearness, triangles)
        more = triangles.shine[:, None], triangles.opacity[:, None]
        values = np.concatenate([*triangles[:3], light, *more], -1, dtype=np.float32)
        key = self._camera.key_light()
        shade(
            corners,
            nearness,
            triangles.faces,
            values,
            owner,
            self._camera.position,
            key,
            alpha,
            self.image,
        )
        if alpha >= 1:
            self._nearness = top

    def owners(self, triangles: Triangles) -> np.ndarray:
        """(height, width) index of the triangle that each sample shows, or `NOTHING`."""
        return self._covered(*self._projected(triangles.points), triangles)[1]

    def _projected(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(V, 2) columns and rows of points (V, 3), and (V,) one over their depths."""
        x, y, depth = self._camera.axes() @ (points - self._camera.position).T
        # Omits triangles that are not entirely before the camera
        depth = np.where(depth > _NEAR, depth, np.nan)
        height, width = self._nearness.shape
        focus = height / 2 / np.tan(np.radians(self._camera.field_of_view) / 2)
        return np.stack(
            [width / 2 + focus * x / depth, height / 2 - focus * y / depth], -1
        ) - 0.5, 1 / depth

    def _covered(
        self, corners: np.ndarray, nearness: np.ndarray, triangles: Triangles
    ) -> tuple[np.ndarray, np.ndarray]:
        """Inverse depth of each sample with the triangles in the picture, and the index of the one
        that it shows.
        """
        top, owner = self._nearness.copy(), np.full(self._nearness.shape, NOTHING, np.int32)
        cover(corners, nearness, triangles.faces, triangles.closed, top, owner)
        return top, owner


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n,) dot products of rows."""
    return np.einsum("ij,ij->i", a, b)
