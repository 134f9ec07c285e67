"""Shapes as triangles with smooth normals, small enough for light per vertex."""

import functools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.objects.spec import Colours
from congrasp.common.runtime.lazy_trimesh import trimesh
from congrasp.services.appearance.subdivision import bisect_longest
from congrasp.services.viz.kernels import NOTHING, linear
from congrasp.services.viz.shapes import Shape
from congrasp.services.viz.texture import NO_TEXTURE, Texture, joined_textures, texture_of

CREASE = np.cos(np.radians(35.0))
"""Faces whose normals differ by more than this angle (given as its cosine) meet in a sharp edge."""
_LONGEST_SIDE_M = 0.005
_MOST_TRIANGLES = 12_000
"""Longest side of a mesh's triangles, and approximate limit of their number."""
_TABLE_RINGS = 72
_TABLE_SECTIONS = 160
_COARSE_TABLE_SECTIONS = 96
_RING_EXPONENT = 1.6
"""Exponent of the radii of a table's rings; above one they are denser around the middle."""
_FADES_FROM = 0.55
"""Share of a table's radius from which it fades into the background."""
_SMALLEST_AREA = 1e-14
"""Twice the area of a degenerate face, m²."""
_SMALLEST_SUM = 1e-30
"""Smallest sum of normals that has a direction, m²."""


class Triangles(NamedTuple):
    """F triangles between V points with one normal each.

    A sharp edge has a point for each of its surfaces.
    """

    points: np.ndarray
    """(V, 3) float32."""
    normals: np.ndarray
    """(V, 3) float32 unit."""
    colours: np.ndarray
    """(V, 3) float32 linear reflectance."""
    shine: np.ndarray
    """(V,) float32 strength of the highlight."""
    opacity: np.ndarray
    """(V,) float32 opacity."""
    faces: np.ndarray
    """(F, 3) indices of their corners."""
    closed: np.ndarray
    """(F,) bool, True for a closed surface that winds outwards, of which only the outside is
    visible.
    """
    chart: np.ndarray
    """(F,) int32 chart of the texture that replaces the colours; `NOTHING` without."""
    texture: Texture

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
    colours: np.ndarray | None = None
    """(V, 3) linear reflectance; None without colours of its own."""
    opacity: np.ndarray | None = None
    """(V,) opacity; None if it is one everywhere."""
    chart: np.ndarray | None = None
    """(F,) chart of each triangle; None without a texture."""
    texture: Texture = NO_TEXTURE


def triangles_of(shapes: Iterable[Shape], *, fine: bool = True) -> Triangles:
    """The triangles of shapes in the world frame, one shape after the other; small ones if
    `fine`.
    """
    return joined([_EMPTY, *(_triangles(shape, fine) for shape in shapes)])


def _empty() -> Triangles:
    """No triangles."""
    none = np.zeros((0, 3), np.float32)
    return Triangles(
        points=none,
        normals=none,
        colours=none,
        shine=none[:, 0],
        opacity=none[:, 0],
        faces=none.astype(int),
        closed=none[:, 0] > 0,
        chart=np.zeros(0, np.int32),
        texture=NO_TEXTURE,
    )


_EMPTY = _empty()


def joined(parts: Sequence[Triangles]) -> Triangles:
    """The triangles of all parts, one after the other."""
    faces = []
    charts = []
    points_before = 0
    charts_before = 0
    for part in parts:
        faces.append(part.faces + points_before)
        charts.append(np.where(part.chart == NOTHING, NOTHING, part.chart + charts_before))
        points_before += len(part.points)
        charts_before += len(part.texture.rows)
    return Triangles(
        points=np.concatenate([part.points for part in parts]),
        normals=np.concatenate([part.normals for part in parts]),
        colours=np.concatenate([part.colours for part in parts]),
        shine=np.concatenate([part.shine for part in parts]),
        opacity=np.concatenate([part.opacity for part in parts]),
        faces=np.concatenate(faces),
        closed=np.concatenate([part.closed for part in parts]),
        chart=np.concatenate(charts).astype(np.int32),
        texture=joined_textures([part.texture for part in parts]),
    )


def _triangles(shape: Shape, fine: bool) -> Triangles:
    """The triangles of one shape in the world frame."""
    surface = _surface_of(shape, fine)
    turn = Rotation.from_quat(shape.quaternion, scalar_first=True).as_matrix().astype(np.float32)
    position = np.asarray(shape.position, np.float32)
    points = surface.points @ turn.T + position
    colours = surface.colours
    if colours is None:
        colours = np.broadcast_to(linear(np.asarray(shape.colour)), points.shape)
    opacity = surface.opacity
    if opacity is None:
        opacity = np.ones(len(points), np.float32)
    chart = surface.chart
    if chart is None:
        chart = np.full(len(surface.faces), NOTHING, np.int32)
    return Triangles(
        points=points,
        normals=surface.normals @ turn.T,
        colours=colours,
        shine=np.full(len(points), shape.shine, np.float32),
        opacity=opacity,
        faces=surface.faces,
        closed=np.full(len(surface.faces), surface.closed),
        chart=chart,
        texture=surface.texture.moved(turn, position),
    )


def _surface_of(shape: Shape, fine: bool) -> _Surface:
    """The triangles of a shape in its own frame."""
    if shape.normals is not None and shape.colours is not None:
        return _Surface(
            np.asarray(shape.vertices, np.float32),
            np.asarray(shape.normals, np.float32),
            np.asarray(shape.faces),
            closed=True,
            colours=linear(np.asarray(shape.colours)),
        )
    if shape.kind == "table":
        return _table_top(*shape.size, fine)
    if shape.kind != "mesh":
        return _capsule(*shape.size, fine)
    vertices = _content(shape.vertices, float)
    faces = _content(shape.faces, int)
    # Coarse triangles only cast shadows
    if shape.paint is None or not fine:
        return _mesh(vertices, faces, b"", b"", fine)
    paint_points = _content(shape.paint.points, float)
    return _mesh(vertices, faces, paint_points, _content(shape.paint.values, np.uint8), fine)


def _content(array: np.ndarray | None, kind: type) -> bytes:
    """The bytes of an array; empty without one."""
    return b"" if array is None else np.asarray(array, kind).tobytes()


@functools.lru_cache(maxsize=64)
def _mesh(
    vertices: bytes, faces: bytes, paint_points: bytes, paint_values: bytes, fine: bool
) -> _Surface:
    """A mesh, painted if there are paint points.

    It is cached by the content of its arrays, so that a mesh that moves between pictures is refined
    once.
    """
    positions = np.frombuffer(vertices).reshape(-1, 3)
    triples = np.frombuffer(faces, int).reshape(-1, 3)
    closed = bool(trimesh.Trimesh(positions, triples).is_volume)
    corners, normals = smooth_corners(positions, triples)
    if not fine:
        return _surface(corners, normals, closed)
    numbers = np.broadcast_to(np.arange(len(corners))[:, None, None], (len(corners), 3, 1))
    values = np.concatenate([corners, normals, numbers], axis=-1)
    cut_corners, cut_normals, source = np.split(_cut_values(values), [3, 6], axis=-1)
    surface = _surface(cut_corners, cut_normals, closed)
    if not paint_points:
        return surface
    paint = Colours(
        np.frombuffer(paint_points).reshape(-1, 3),
        np.frombuffer(paint_values, np.uint8).reshape(-1, 3),
    )
    chart = np.round(source[:, 0, 0]).astype(np.int32)
    return surface._replace(chart=chart, texture=texture_of(corners, paint))


@functools.lru_cache(maxsize=256)
def _capsule(radius: float, half_length: float, fine: bool) -> _Surface:
    """A capsule along z, or a ball."""
    ball = trimesh.creation.icosphere(2 if fine else 1, 1.0)
    normals = np.asarray(ball.vertices)
    faces = np.asarray(ball.faces)
    # Split at the equator: triangles across it become the shaft
    is_upper = normals[:, 2] > 1e-6
    is_lower = normals[:, 2] < -1e-6
    lift = half_length * (is_upper.astype(float) - is_lower)
    # As large as the round one
    enlarged = radius * np.sqrt(4 * np.pi / ball.area) * normals
    points = enlarged + lift[:, None] * np.array([0.0, 0.0, 1.0])
    corners = points[faces]
    corner_normals = normals[faces]
    if fine:
        corners, corner_normals = cut(corners, corner_normals)
    return _surface(corners, corner_normals, closed=True)


@functools.lru_cache(maxsize=8)
def _table_top(radius: float, half_length: float, fine: bool) -> _Surface:
    """A disc at the upper end, finest in the middle, with a fading edge; opaque and of few
    triangles if not `fine`.
    """
    rings = _TABLE_RINGS if fine else 1
    sections = _TABLE_SECTIONS if fine else _COARSE_TABLE_SECTIONS
    angle = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    share = (np.arange(1, rings + 1) / rings) ** _RING_EXPONENT
    circles = share[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    flat = np.concatenate([np.zeros((1, 2)), circles.reshape(-1, 2)])
    points = np.column_stack([radius * flat, np.full(len(flat), half_length)]).astype(np.float32)
    up = np.broadcast_to(np.array([0, 0, 1], np.float32), points.shape)
    opacity = None
    if fine:
        fading = np.clip((1 - np.linalg.norm(flat, axis=-1)) / (1 - _FADES_FROM), 0, 1)
        opacity = (fading**2 * (3 - 2 * fading)).astype(np.float32)
    return _Surface(points, up, _disc_faces(rings, sections), closed=True, opacity=opacity)


def _disc_faces(rings: int, sections: int) -> np.ndarray:
    """(F, 3) triangles of a disc: point 0 in the middle, then the points of each ring."""
    here = np.arange(sections)
    after = (here + 1) % sections
    faces = [np.stack([np.zeros_like(here), 1 + here, 1 + after], -1)]
    for ring in range(rings - 1):
        inner = 1 + ring * sections
        outer = inner + sections
        faces.append(np.stack([inner + here, outer + here, outer + after], -1))
        faces.append(np.stack([inner + here, outer + after, inner + after], -1))
    return np.concatenate(faces)


def _surface(corners: np.ndarray, normals: np.ndarray, closed: bool) -> _Surface:
    """Triangles (F, 3, 3) with normals (F, 3, 3); equal corners become one point."""
    rows = np.concatenate([corners, normals], -1).reshape(-1, 6)
    distinct, faces = np.unique(np.round(rows, 5), axis=0, return_inverse=True)
    points, directions = np.split(distinct.astype(np.float32), 2, -1)
    return _Surface(points, directions, faces.reshape(-1, 3), closed)


def smooth_corners(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners and normals (F, 3, 3) of a mesh (V, 3), (F, 3), without its degenerate faces.

    A corner's normal is the mean, weighted by area, of the faces around it that are within the
    crease angle.
    """
    vertices = np.asarray(vertices, float)
    faces = np.asarray(faces)
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    has_area = area > _SMALLEST_AREA
    faces = faces[has_area]
    corners = corners[has_area]
    cross = cross[has_area]
    flat = cross / area[has_area, None]
    # Vertices at one position count as one vertex, even if the file has several.
    place_of_vertex = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)[1].ravel()
    places = place_of_vertex[faces].ravel()
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
    lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
    unit = normals / np.maximum(lengths, _SMALLEST_SUM)
    return corners, unit.reshape(-1, 3, 3)


def cut(corners: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same surface in smaller triangles: those with a long side are bisected repeatedly.

    Sides stay longer on a surface that would need too many triangles.

    Args:
      corners: (F, 3, 3) m.
      normals: (F, 3, 3) at the corners.
    """
    values = _cut_values(np.concatenate([corners, normals], axis=-1))
    corners, normals = np.split(values, 2, axis=-1)
    return corners, normals


def _cut_values(values: np.ndarray) -> np.ndarray:
    """Cuts triangles as `cut` does; values (F, 3, C) of corners begin with their position."""
    first = values[:, 1, :3] - values[:, 0, :3]
    second = values[:, 2, :3] - values[:, 0, :3]
    area = np.linalg.norm(np.cross(first, second), axis=-1).sum() / 2
    longest = max(_LONGEST_SIDE_M, 3 * float(np.sqrt(area / _MOST_TRIANGLES)))
    return bisect_longest(values, longest)
