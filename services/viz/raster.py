"""Pictures of shapes without OpenGL, EGL or a display: triangles into a depth buffer, a soft key light and the sky."""

from collections.abc import Sequence

import numpy as np

from services.viz.light import FEW, MANY, light_on
from services.viz.scene import Camera, Shape
from services.viz.spans import Spans, spans
from services.viz.triangles import GAMMA, Triangles, joined, triangles_of

SAMPLES = 2
"""Samples along each side of a pixel."""
_KEY_STRENGTH, _SKY_STRENGTH, _BOUNCE = 0.70, 0.50, 0.05
_NEAR = 0.01  # m
_LARGE = 500_000  # pixels
_TOP, _BOTTOM = np.array([0.93, 0.945, 0.965]), np.array([0.80, 0.82, 0.85])  # background, sRGB


def render_scene(shapes: Sequence[Shape], camera: Camera, size: tuple[int, int] = (640, 480)) -> np.ndarray:
    """Draws the shapes.

    Args:
      shapes: what to draw; the world's z axis points up.
      camera: from where.
      size: width and height in pixels.

    Returns:
      (height, width, 3) uint8 sRGB.
    """
    solid = [shape for shape in shapes if shape.alpha >= 1]
    table = triangles_of(shape for shape in solid if shape.kind == "cylinder")
    bodies = _turned(triangles_of(shape for shape in solid if shape.kind != "cylinder"), camera)
    casting = triangles_of((shape for shape in solid if shape.shadow), fine=False)
    lit = joined([table, bodies])
    lamps = MANY if size[0] * size[1] > _LARGE else FEW
    light = light_on(lit.points, lit.normals, casting, camera.key_light(), lamps)
    coarse = _Picture(camera, *size)  # the table has hardly an edge: one sample a pixel is enough
    coarse.add(table, light[: len(table.points)])
    picture = coarse.finer()
    picture.add(bodies, light[len(table.points) :])
    for alpha in sorted({shape.alpha for shape in shapes if shape.alpha < 1}):
        glass = _turned(triangles_of(shape for shape in shapes if shape.alpha == alpha), camera)
        picture.add(glass, np.ones((len(glass.points), 2), np.float32), alpha)
    samples = picture.image.reshape(size[1], SAMPLES, size[0], SAMPLES, 3)
    image = sum(samples[:, i, :, j] for i, j in np.ndindex(SAMPLES, SAMPLES)) / SAMPLES**2
    return (255 * np.clip(image, 0, 1) + 0.5).astype(np.uint8)


def visible(shapes: Sequence[Shape], camera: Camera, size: tuple[int, int]) -> np.ndarray:
    """(height, width) index of the solid shape that each pixel shows, -1 for the background."""
    solid = [i for i, shape in enumerate(shapes) if shape.alpha >= 1]
    parts = [triangles_of([shapes[i]], fine=False) for i in solid]
    owner = np.repeat(solid, [len(part.faces) for part in parts])
    cover, seen = _Picture(camera, *size).nearest(joined(parts))
    shown = np.full(size[0] * size[1], -1)
    shown[cover.sample[seen]] = owner[cover.face[cover.span[seen]]]
    return shown.reshape(size[::-1])


def _turned(triangles: Triangles, camera: Camera) -> Triangles:
    """With normals that point to the camera where a surface is open, and may wind either way."""
    first, second, third = np.moveaxis(triangles.corners, 1, 0)
    away = _dot(np.cross(second - first, third - first), first - camera.position) > 0
    normals = triangles.normals.copy()
    turned = triangles.faces[away & ~triangles.closed]
    normals[turned] = -triangles.normals[turned]
    return triangles._replace(normals=normals)


class _Picture:
    """A picture that is being drawn."""

    def __init__(self, camera: Camera, width: int, height: int):
        self._camera, self._width, self._height = camera, width, height
        self._axes = camera.axes()
        self._focus = height / 2 / np.tan(np.radians(camera.field_of_view) / 2)
        self._key = camera.key_light().astype(np.float32)
        self._nearness = np.zeros(width * height, np.float32)
        """One over the depth of what each sample shows."""
        share = np.linspace(1, 0, height, dtype=np.float32)[:, None, None]
        self.image = np.broadcast_to(share * _TOP + (1 - share) * _BOTTOM, (height, width, 3)).reshape(-1, 3)

    def finer(self) -> "_Picture":
        """The same picture with more samples."""
        fine = _Picture(self._camera, SAMPLES * self._width, SAMPLES * self._height)
        grid = self.image.astype(np.float32).reshape(self._height, self._width, 3)
        fine.image = grid.repeat(SAMPLES, 0).repeat(SAMPLES, 1).reshape(-1, 3)
        nearness = self._nearness.reshape(self._height, self._width)
        fine._nearness = nearness.repeat(SAMPLES, 0).repeat(SAMPLES, 1).ravel()
        return fine

    def add(self, triangles: Triangles, light: np.ndarray, alpha: float = 1.0) -> None:
        """Draws triangles where they are nearest, with the light (V, 2) at their points."""
        cover, seen = self.nearest(triangles)
        sample, face = cover.sample[seen], cover.face[cover.span[seen]]
        values = np.concatenate([*triangles[:3], light, triangles.shine[:, None]], -1)
        weights = cover.weights(seen)
        nearness = weights.sum(0)
        here = np.einsum("cn,ncv->nv", weights / nearness, values[triangles.faces[face]])
        colour = self._lit(*np.split(here, [3, 6, 9, 11], -1))
        self.image[sample] = alpha * colour + (1 - alpha) * self.image[sample]
        if alpha >= 1:
            self._nearness[sample] = nearness

    def nearest(self, triangles: Triangles) -> tuple[Spans, np.ndarray]:
        """Samples that triangles cover, with weights over their depths, and which (k,) of them nothing is before."""
        local = ((triangles.points - self._camera.position) @ self._axes.T)[triangles.faces.T]
        depth = np.where(
            local[..., 2] > _NEAR, local[..., 2], np.nan
        )  # what is not wholly before the camera is left out
        x = self._width / 2 + self._focus * local[..., 0] / depth - 0.5
        y = self._height / 2 - self._focus * local[..., 1] / depth - 0.5
        cover = spans(x, y, triangles.closed, self._width, self._height).scaled(1 / depth)
        nearness = cover.total()
        nearest = self._nearness * np.float32(1 + 1e-6)
        np.maximum.at(nearest, cover.sample, nearness)
        return cover, np.flatnonzero(nearness == nearest[cover.sample])

    def _lit(
        self, place: np.ndarray, normal: np.ndarray, colour: np.ndarray, light: np.ndarray, shine: np.ndarray
    ) -> np.ndarray:
        """(n, 3) sRGB of points (n, 3) with normals and colours (n, 3), shares of both lights (n, 2), shine (n, 1)."""
        rays, normal = _unit(place - self._camera.position.astype(np.float32)), _unit(normal)
        total = _KEY_STRENGTH * light[:, 0] * np.clip(normal @ self._key, 0, None)
        total += _SKY_STRENGTH * light[:, 1] * (0.6 + 0.4 * normal[:, 2]) + _BOUNCE
        gloss = shine[:, 0] * light[:, 0] * np.clip(_dot(normal, _unit(self._key - rays)), 0, None) ** 60
        return np.clip(colour * total[:, None] + gloss[:, None], 0, 1) ** (1 / GAMMA)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n,) dot products of rows."""
    return np.einsum("ij,ij->i", a, b)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Rows of length one."""
    return vectors / (np.sqrt(_dot(vectors, vectors)) + 1e-12)[:, None]
