"""Shapes as triangles with smooth normals, small enough for paint and light per vertex."""

import functools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from congrasp.common.objects.spec import Colours
from congrasp.services.record.palette import bisected, colours_at
from congrasp.services.viz.kernels import GAMMA
from congrasp.services.viz.shapes import Shape

CREASE = np.cos(np.radians(35.0))
"""Faces whose normals differ by more than this angle (given as its cosine) meet in a sharp edge."""
_Size = tuple[float, int]
# Longest side of a mesh's triangles, m, and their number, about
_PLAIN, _PAINTED = (
    (0.005, 12_000),
    (0.0025, 40_000),
)
_RINGS, _SECTIONS = 72, 160  # of a table top
_DENSER = 1.6  # exponent of the radii of its rings; above one they are denser around the middle
_SHORTEST = 1e-30  # a sum of normals that has a direction, m²
_FADES = 0.55  # share of its radius from which it fades into the background


class Triangles(NamedTuple):
    """F triangles between V points with one normal each; a sharp edge has a point for each of its
    surfaces.
    """

    points: np.ndarray
    """(V, 3) float32."""
    normals: np.ndarray
    """(V, 3) float32 unit."""
    colours: np.ndarray
    """(V, 3) float32 linear reflectance."""
    shine: np.ndarray
    """(V,) float32 strength of the highlight."""
    faces: np.ndarray
    """(F, 3) indices of their corners."""
    closed: np.ndarray
    """(F,) bool, True for a closed surface that winds outwards, of which only the outside is
    visible.
    """
    opacity: np.ndarray
    """(V,) float32 opacity."""

    @property
    def corners(self) -> np.ndarray:
        """(F, 3, 3)."""
        return self.points[self.faces]


class _Surface(NamedTuple):
    """A shape's triangles in its own frame."""

    points: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    closed: bool
    paint: np.ndarray | None = None
    """(V, 3) linear reflectance; None without paint."""
    opacity: np.ndarray | None = None
    """(V,) opacity; None if it is one everywhere."""


def triangles_of(shapes: Iterable[Shape], *, fine: bool = True) -> Triangles:
    """The triangles of shapes in the world frame, one shape after the other; small ones if
    `fine`.
    """
    none = np.zeros((0, 3), np.float32)
    found = [Triangles(none, none, none, none[:, 0], none.astype(int), none[:, 0] > 0, none[:, 0])]
    return joined([*found, *(_triangles(shape, fine) for shape in shapes)])


def joined(parts: Sequence[Triangles]) -> Triangles:
    """The triangles of all parts, one after the other."""
    firsts = np.cumsum([0, *(len(part.points) for part in parts)])
    parts = [
        part._replace(faces=part.faces + first) for part, first in zip(parts, firsts, strict=False)
    ]
    return Triangles(*(np.concatenate(fields) for fields in zip(*parts, strict=True)))


def _triangles(shape: Shape, fine: bool) -> Triangles:
    """The triangles of one shape in the world frame."""
    if shape.normals is not None and shape.colours is not None:
        points, normals = (np.asarray(part, np.float32) for part in (shape.vertices, shape.normals))
        surface = _Surface(
            points, normals, np.asarray(shape.faces), True, _linear(np.asarray(shape.colours))
        )
    elif shape.kind == "mesh":
        surface = _mesh(
            _content(shape.vertices, float),
            _content(shape.faces, int),
            _content(shape.paint and shape.paint.points, float),
            _content(shape.paint and shape.paint.values, np.uint8),
            fine,
        )
    else:
        surface = (_table_top if shape.kind == "table" else _capsule)(*shape.size, fine)
    turn = Rotation.from_quat(shape.quaternion, scalar_first=True).as_matrix().astype(np.float32)
    points = surface.points @ turn.T + np.asarray(shape.position, np.float32)
    even = np.broadcast_to(_linear(np.asarray(shape.colour)), points.shape)
    return Triangles(
        points,
        surface.normals @ turn.T,
        even if surface.paint is None else surface.paint,
        np.full(len(points), shape.shine, np.float32),
        surface.faces,
        np.full(len(surface.faces), surface.closed),
        np.ones(len(points), np.float32) if surface.opacity is None else surface.opacity,
    )


def _content(array: np.ndarray | None, kind: type) -> bytes:
    """The bytes of an array; empty without one."""
    return b"" if array is None else np.asarray(array, kind).tobytes()


@functools.lru_cache(maxsize=64)
def _mesh(
    vertices: bytes, faces: bytes, paint_points: bytes, paint_values: bytes, fine: bool
) -> _Surface:
    """A mesh; cached by the content of its arrays, so that a mesh that moves between pictures is
    refined once.
    """
    corners, triples = (
        np.frombuffer(vertices).reshape(-1, 3),
        np.frombuffer(faces, int).reshape(-1, 3),
    )
    closed = bool(trimesh.Trimesh(corners, triples).is_volume)
    size = (_PAINTED if paint_points else _PLAIN) if fine else None
    surface = _surface(*smooth_corners(corners, triples), closed, size)
    if not paint_points:
        return surface
    paint = Colours(
        np.frombuffer(paint_points).reshape(-1, 3),
        np.frombuffer(paint_values, np.uint8).reshape(-1, 3),
    )
    return surface._replace(paint=_linear(colours_at(surface.points, paint) / 255))


@functools.lru_cache(maxsize=256)
def _capsule(radius: float, half_length: float, fine: bool) -> _Surface:
    """A capsule along z, or a ball."""
    ball = trimesh.creation.icosphere(2 if fine else 1, 1.0)
    normals, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    # Scaled to the area of the round one, and split at its equator: triangles across the equator
    # become the shaft.
    lift = np.where(
        normals[:, 2] > 1e-6, half_length, np.where(normals[:, 2] < -1e-6, -half_length, 0.0)
    )
    points = radius * np.sqrt(4 * np.pi / ball.area) * normals + lift[:, None] * np.array(
        [0.0, 0.0, 1.0]
    )
    return _surface(points[faces], normals[faces], True, _PLAIN if fine else None)


@functools.lru_cache(maxsize=8)
def _table_top(radius: float, half_length: float, fine: bool) -> _Surface:
    """A disc at the upper end, finest in the middle, with a fading edge; opaque and of few
    triangles if not `fine`.
    """
    rings, sections = (_RINGS, _SECTIONS) if fine else (1, 96)
    angle = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    share = (np.arange(1, rings + 1) / rings) ** _DENSER
    flat = share[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    flat = np.concatenate([np.zeros((1, 2)), flat.reshape(-1, 2)])
    points = np.column_stack([radius * flat, np.full(len(flat), half_length)]).astype(np.float32)
    here = np.arange(sections)
    after = (here + 1) % sections
    faces = [np.stack([np.zeros_like(here), 1 + here, 1 + after], -1)]
    for first in 1 + sections * np.arange(rings - 1):
        a, b, c, d = first + here, first + after, first + sections + here, first + sections + after
        faces += [np.stack([a, c, d], -1), np.stack([a, d, b], -1)]
    fading = np.clip((1 - np.linalg.norm(flat, axis=-1)) / (1 - _FADES), 0, 1)
    opacity = (fading**2 * (3 - 2 * fading)).astype(np.float32) if fine else None
    up = np.broadcast_to(np.array([0, 0, 1], np.float32), points.shape)
    return _Surface(points, up, np.concatenate(faces), True, opacity=opacity)


def _surface(
    corners: np.ndarray, normals: np.ndarray, closed: bool, size: _Size | None
) -> _Surface:
    """Triangles (F, 3, 3) with normals (F, 3, 3), refined if a size is given; equal corners become
    one point.
    """
    if size:
        corners, normals = cut(corners, normals, *size)
    rows = np.concatenate([corners, normals], -1).reshape(-1, 6)
    found, faces = np.unique(np.round(rows, 5), axis=0, return_inverse=True)
    points, directions = np.split(found.astype(np.float32), 2, -1)
    return _Surface(points, directions, faces.reshape(-1, 3), closed)


def smooth_corners(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners and normals (F, 3, 3) of a mesh (V, 3), (F, 3), without its degenerate faces.

    A corner's normal is the mean, weighted by area, of the faces around it that are within the
    crease angle.
    """
    vertices, faces = np.asarray(vertices, float), np.asarray(faces)
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    good = area > 1e-14
    faces, corners, cross = faces[good], corners[good], cross[good]
    flat = cross / area[good, None]
    # Vertices at one position count as one vertex, even if the file has several.
    places = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)[1].ravel()[faces].ravel()
    order = np.argsort(places, kind="stable")
    owner = order // 3
    starts = np.flatnonzero(np.r_[True, np.diff(places[order]) > 0])
    sizes = np.diff(np.r_[starts, len(order)])
    normals = np.zeros((len(order), 3))
    for size in np.unique(sizes):
        groups = starts[sizes == size][:, None] + np.arange(size)
        around = owner[groups]  # (groups, size) faces that share a vertex
        near = np.einsum("gik,gjk->gij", flat[around], flat[around]) > CREASE
        normals[order[groups]] = np.einsum("gij,gjk->gik", near, cross[around])
    lengths = np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), _SHORTEST)
    return corners, (normals / lengths).reshape(-1, 3, 3)


def cut(
    corners: np.ndarray, normals: np.ndarray, side: float, most: int
) -> tuple[np.ndarray, np.ndarray]:
    """The same surface (F, 3, 3) in smaller triangles: those with a long side are bisected
    repeatedly.

    Args:
      corners: (F, 3, 3).
      normals: (F, 3, 3) at the corners.
      side: longest side, m.
      most: approximate limit of the number of triangles; sides stay longer on a surface that needs
        more.
    """
    area = (
        np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1
        ).sum()
        / 2
    )
    longest = max(side, 3 * float(np.sqrt(area / most)))
    corners, normals = np.split(bisected(np.concatenate([corners, normals], -1), longest), 2, -1)
    return corners, normals


def _linear(colour: np.ndarray) -> np.ndarray:
    """Converts sRGB to linear light."""
    return (colour**GAMMA).astype(np.float32)
