"""Quick pictures of shapes, for videos and sheets: triangles into a depth buffer, one lamp, its shadow on the table.

A fraction of a second a picture, where `services.viz.shade`, whose light is better, takes seconds.
"""

import functools
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from services.viz.raycast import GAMMA, Camera, Shape, background, painted
from services.viz.smooth import SmoothNormals

SAMPLES = 2
"""Samples along each side of a pixel."""
_KEY_STRENGTH, _SKY_STRENGTH, _BOUNCE, _SHINE = 0.70, 0.42, 0.06, 0.25
_SHADOW, _SOFT = 0.55, 0.006  # how dark a shadow is, and how wide its border, as a share of the picture's height
_NEAR = 0.01  # m


class Patch(NamedTuple):
    """Triangles in the world."""

    corners: np.ndarray
    """(F, 3, 3)."""
    normals: np.ndarray
    """(F, 3, 3) at the corners."""
    colours: np.ndarray
    """(F, 3, 3) linear light that the surface gives back, at the corners."""
    closed: bool
    """Whether only the outside can be seen: a closed surface whose triangles wind outwards."""


class Raster:
    """Draws one picture after another; what it knows of a mesh serves all of them."""

    def __init__(self) -> None:
        """Knows no mesh yet."""
        self._meshes: dict[tuple[int, int], tuple[Patch, Shape]] = {}

    def draw(self, shapes: list[Shape], camera: Camera, size: tuple[int, int] = (640, 480)) -> np.ndarray:
        """(height, width, 3) uint8 sRGB; of cylinders, which must stand upright, only the upper face is drawn.

        Args:
          shapes: what to draw; the world's z axis points up.
          camera: from where.
          size: width and height in pixels.
        """
        bodies = [shape for shape in shapes if shape.kind != "cylinder"]
        solid = [self._patch(shape) for shape in bodies if shape.alpha >= 1]
        coarse = _Frame(camera, *size)  # the table has hardly an edge: one sample a pixel is enough
        for shape in shapes:
            if shape.kind == "cylinder":
                coarse.add_disc(shape, solid)
        frame = coarse.finer()
        frame.add(solid)
        for alpha in sorted({shape.alpha for shape in bodies if shape.alpha < 1}):
            frame.add([self._patch(shape) for shape in bodies if shape.alpha == alpha], alpha)
        samples = frame.image.reshape(size[1], SAMPLES, size[0], SAMPLES, 3)
        image = sum(samples[:, i, :, j] for i, j in np.ndindex(SAMPLES, SAMPLES)) / SAMPLES**2
        return (255 * np.clip(image, 0, 1) + 0.5).astype(np.uint8)

    def _patch(self, shape: Shape) -> Patch:
        """A shape's triangles in the world."""
        local = self._local(shape)
        turn = Rotation.from_quat(shape.quaternion, scalar_first=True).as_matrix().astype(np.float32)
        place = np.asarray(shape.position, np.float32)
        return local._replace(corners=local.corners @ turn.T + place, normals=local.normals @ turn.T)

    def _local(self, shape: Shape) -> Patch:
        """A shape's triangles in its own frame; those of meshes are remembered."""
        if shape.kind != "mesh":
            corners, normals = _round(shape.size[0], shape.size[1] if shape.kind == "capsule" else 0.0)
            return Patch(corners, normals, _even(shape.colour, corners), True)
        key = (id(shape.vertices), id(shape.paint_colours))
        if key not in self._meshes:
            vertices, faces = np.asarray(shape.vertices, float), np.asarray(shape.faces)
            smooth = SmoothNormals(vertices, faces)
            corners = smooth.corners.astype(np.float32)
            colours = _even(shape.colour, corners)
            if shape.paint_points is not None:
                tree, of_points = cKDTree(shape.paint_points), np.asarray(shape.paint_colours)
                colours = _linear(painted(tree, of_points, corners.reshape(-1, 3)).reshape(corners.shape))
            closed = trimesh.Trimesh(vertices, faces).is_volume
            # The shape is kept, so that nothing else can get its arrays' identities.
            self._meshes[key] = Patch(corners, smooth.corner_normals.astype(np.float32), colours, closed), shape
        return self._meshes[key][0]


def _even(colour: tuple[float, float, float], corners: np.ndarray) -> np.ndarray:
    """One colour for every corner."""
    return np.broadcast_to(_linear(np.asarray(colour)), corners.shape)


def _linear(colour: np.ndarray) -> np.ndarray:
    """sRGB as linear light."""
    return (colour**GAMMA).astype(np.float32)


@functools.lru_cache(maxsize=128)
def _round(radius: float, half_length: float) -> tuple[np.ndarray, np.ndarray]:
    """Corners and normals (F, 3, 3) of a capsule along z, or of a ball."""
    ball = trimesh.creation.icosphere(2, 1.0)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    # A ball that is pulled apart at its equator; the triangles that cross it become the shaft.
    lift = np.where(vertices[:, 2] > 1e-6, half_length, np.where(vertices[:, 2] < -1e-6, -half_length, 0.0))
    places = radius * vertices + lift[:, None] * np.array([0.0, 0.0, 1.0])
    return places[faces].astype(np.float32), vertices[faces].astype(np.float32)


class _Frame:
    """A picture that is being drawn."""

    def __init__(self, camera: Camera, width: int, height: int):
        self._camera, self._width, self._height = camera, width, height
        self._axes = camera.axes()
        self._focus = height / 2 / np.tan(np.radians(camera.field_of_view) / 2)
        self._key = camera.key_light().astype(np.float32)
        self._nearness = np.zeros(width * height, np.float32)
        """One over the depth of what each sample shows."""
        share = np.linspace(1, 0, height, dtype=np.float32)[:, None, None]
        self.image = np.broadcast_to(background(share), (height, width, 3)).reshape(-1, 3)

    def finer(self) -> "_Frame":
        """The same picture with more samples."""
        fine = _Frame(self._camera, SAMPLES * self._width, SAMPLES * self._height)
        grid = self.image.astype(np.float32).reshape(self._height, self._width, 3)
        fine.image = grid.repeat(SAMPLES, 0).repeat(SAMPLES, 1).reshape(-1, 3)
        nearness = self._nearness.reshape(self._height, self._width)
        fine._nearness = nearness.repeat(SAMPLES, 0).repeat(SAMPLES, 1).ravel()
        return fine

    def add(self, patches: list[Patch], alpha: float = 1.0) -> None:
        """Draws triangles where they are nearest."""
        if not patches:
            return
        corners, normals, colours = (np.concatenate(parts) for parts in list(zip(*patches, strict=True))[:3])
        closed = np.concatenate([np.full(len(patch.corners), patch.closed) for patch in patches])
        cover = self._cover(corners, closed)
        nearness = cover.nearness()
        nearest = self._nearness * np.float32(1 + 1e-6)
        np.maximum.at(nearest, cover.sample, nearness)
        seen = np.flatnonzero(nearness == nearest[cover.sample])
        sample = cover.sample[seen]
        values = np.concatenate([colours, normals, corners], -1, dtype=np.float32)[cover.face[cover.span[seen]]]
        here = np.einsum("cn,ncv->nv", cover.weights(seen) / nearness[seen], values)
        colour = self._lit(here[:, :3], here[:, 3:6], here[:, 6:])
        self.image[sample] = alpha * colour + (1 - alpha) * self.image[sample]
        if alpha >= 1:
            self._nearness[sample] = nearness[seen]

    def add_disc(self, shape: Shape, above: list[Patch]) -> None:
        """Draws the upper face of an upright cylinder, and the shadow that triangles above cast on it."""
        top = shape.position[2] + shape.size[1]
        y, x = np.divmod(np.arange(self._width * self._height), self._width)
        rays = self._camera.rays(x + 0.5, y + 0.5, self._width, self._height)
        with np.errstate(divide="ignore", invalid="ignore"):
            way = (top - self._camera.position[2]) / rays[:, 2]
        way = np.where(rays[:, 2] < 0, way, np.inf)
        sample = np.flatnonzero(np.isfinite(way))
        places = self._camera.position + way[sample, None] * rays[sample]
        inside = np.linalg.norm(places[:, :2] - shape.position[:2], axis=-1) < shape.size[0]
        sample, places = sample[inside], places[inside]
        light = np.ones(self._width * self._height, np.float32)
        if above:
            corners = np.concatenate([patch.corners for patch in above])
            closed = np.concatenate([np.full(len(patch.corners), patch.closed) for patch in above])
            height = np.maximum(corners[..., 2] - top, 0.0)
            # Of a closed surface either half casts the whole shadow.
            light[self._cover(corners - height[..., None] / self._key[2] * self._key, closed).sample] = 1 - _SHADOW
        soft = gaussian_filter(light.reshape(self._height, self._width), _SOFT * self._height).ravel()
        normal = np.broadcast_to([0.0, 0.0, 1.0], places.shape)
        colour = self._lit(_even(shape.colour, places), normal, places, soft[sample], shine=0.0)
        self.image[sample] = colour
        self._nearness[sample] = 1 / ((places - self._camera.position) @ self._axes[2])

    def _cover(self, corners: np.ndarray, closed: np.ndarray) -> "_Cover":
        """Samples that triangles (F, 3, 3) cover; of those that are `closed` (F,) only what faces the camera."""
        local = np.moveaxis(corners - self._camera.position, 0, 1) @ self._axes.T
        depth = local[..., 2]  # (3, F), as all that follows
        near = np.where(depth > _NEAR, depth, np.nan)
        x = self._width / 2 + self._focus * local[..., 0] / near - 0.5
        y = self._height / 2 - self._focus * local[..., 1] / near - 0.5
        area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
        shown = np.abs(area) > 1e-6  # false for what is not wholly before the camera
        # The picture's y points down: what winds outwards and faces the camera has a negative area.
        face = np.flatnonzero(shown & ~(closed & (area > 0)))
        x, y, area, depth = x[:, face], y[:, face], area[face], depth[:, face]
        # Weights are linear over the picture: a x + b y + c, each zero on the side across from its corner.
        one, other = [1, 2, 0], [2, 0, 1]
        a, b = (y[one] - y[other]) / area, (x[other] - x[one]) / area
        c = (x[one] * y[other] - x[other] * y[one]) / area
        upper, lower = np.ceil(y.min(0)).clip(0), np.floor(y.max(0)).clip(max=self._height - 1)
        which, number = _expand(lower - upper + 1)
        row = upper[which] + number
        # In each of its rows a triangle covers one span.
        slope, offset = a[:, which], b[:, which] * row + c[:, which]
        with np.errstate(divide="ignore", invalid="ignore"):
            bound = -offset / slope
        level = np.where(offset < 0, np.inf, -np.inf)
        low = np.where(slope > 0, bound, np.where(slope < 0, -np.inf, level)).max(0)
        left = np.ceil(low.clip(0, self._width))
        right = np.floor(np.where(slope < 0, bound, np.inf).min(0).clip(-1, self._width - 1))
        span, step = _expand(right - left + 1)
        start = (row * self._width + left).astype(np.int64)
        base, slope = (offset + slope * left) / depth[:, which], slope / depth[:, which]
        return _Cover(
            face[which], base.astype(np.float32), slope.astype(np.float32), span, step.astype(np.float32),
            start[span] + step,
        )  # fmt: skip

    def _lit(
        self,
        albedo: np.ndarray,
        normal: np.ndarray,
        place: np.ndarray,
        light: np.ndarray | float = 1.0,
        shine: float = 1.0,
    ) -> np.ndarray:
        """(n, 3) sRGB of points (n, 3) of linear albedo (n, 3).

        Normals are turned to the camera, so that a mesh may wind either way.
        """
        rays = place - self._camera.position.astype(np.float32)
        rays, normal = _unit(rays), _unit(normal)
        normal = np.where(_dot(normal, rays)[:, None] > 0, -normal, normal)
        half = _unit(self._key - rays)
        total = _KEY_STRENGTH * light * np.clip(normal @ self._key, 0, None)
        total += _SKY_STRENGTH * (0.6 + 0.4 * normal[:, 2]) * (0.5 + 0.5 * np.asarray(light)) + _BOUNCE
        gloss = shine * _SHINE * np.clip(_dot(normal, half), 0, None) ** 60
        return np.clip(albedo * total[:, None] + gloss[:, None], 0, 1) ** (1 / GAMMA)


class _Cover(NamedTuple):
    """Samples that triangles cover, in spans of S rows of them, along which weights are linear."""

    face: np.ndarray
    """(S,) triangle of each span."""
    base: np.ndarray
    """(3, S) weights of the corners at its first sample, over their depths."""
    slope: np.ndarray
    """(3, S) by how much they grow from sample to sample."""
    span: np.ndarray
    """(n,) of each sample."""
    step: np.ndarray
    """(n,) how many samples of the span are before it."""
    sample: np.ndarray
    """(n,) its number in the picture."""

    def nearness(self) -> np.ndarray:
        """(n,) one over the depth."""
        return self.base.sum(0)[self.span] + self.slope.sum(0)[self.span] * self.step

    def weights(self, which: np.ndarray) -> np.ndarray:
        """(3, k) of some of the samples, over the depths."""
        span = self.span[which]
        return self.base[:, span] + self.slope[:, span] * self.step[which]


def _expand(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For numbers (m,) of things that each row has: the row of each thing, and its number in the row."""
    counts = counts.clip(0).astype(np.int64)
    which = np.repeat(np.arange(len(counts)), counts)
    return which, np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n,) dot products of rows."""
    return np.einsum("ij,ij->i", a, b)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Rows of length one."""
    return vectors / (np.sqrt(_dot(vectors, vectors)) + 1e-12)[:, None]
