"""Joins of neighbouring convex pieces, as long as they preserve the shape.

The hull of a bent wall fills the inner side of the bend: at a bowl of 2 mm, half of the wall's
volume. Such a piece is thinned about its middle to the volume of the mesh in it, which leaves half
of the bend on either side.
"""

import heapq
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import ConvexHull

from congrasp.common.objects import shapes
from congrasp.services.assets.objects.fidelity import MAX_SURFACE_ERROR_M, MAX_VOLUME_ERROR
from congrasp.services.assets.objects.hulls import (
    SURFACE_SAMPLES,
    corners_of,
    signed_distances,
    solid_hull,
)
from congrasp.services.assets.objects.interior import interior
from congrasp.services.assets.objects.voxels import voxels

MAX_JOIN_DEPTH_M = 1.5e-3
"""Largest depth of the surface in a hull, or distance of the hull from it, for joins below the
limit of pieces.
"""
MAX_JOIN_GROWTH = 0.02
"""Share of the volume that joins may add below the limit of pieces."""
_PROBES_PER_HULL = 200
"""Points on the hull of two pieces, whose distances from the mesh are computed."""
_DIRECTIONS = 300
"""Directions whose extreme vertices larger hulls are reduced to."""
_MAX_NEIGHBOUR_GAP_M = 5e-4
"""Largest gap between neighbouring pieces, m."""
_INNER_POINTS = 60_000
"""Points inside of the mesh."""
_MAX_INNER_TESTED = 500
"""Inner points that are tested for one piece."""
_MIN_INNER_EXPECTED = 30
"""Expected inner points of a full piece, below which its hollow share is not measured."""
_MIN_HOLLOW_SHARE = 0.03
"""Hollow share of its hull from which a piece is thinned."""
_MAX_THINNING = 0.9
"""Largest share by which a piece is thinned."""
_MAX_WALL_M = 0.02
"""Thickness of a wall, m; thicker pieces are not thinned."""


class _Part(NamedTuple):
    """A piece."""

    vertices: np.ndarray
    """(V, 3) before it was thinned, m."""
    hull: ConvexHull
    hollow: float
    """Volume of its hull before it was thinned, without that of the mesh in it, m^3."""
    error: float
    """Largest of three lengths, m: the shift of a side by thinning, the depth of the surface in the
    piece, and the piece's distance from the surface.
    """


class _Join(NamedTuple):
    """A possible join of two pieces."""

    cost: float
    """Measured, or an expected lower bound (`_Merger._apply`)."""
    first: int
    second: int
    error: float
    """Of the joined piece (`_Part.error`), or an expected lower bound, m."""
    measured: "_Joined | None" = None
    """None before the join is measured."""


class _Joined(NamedTuple):
    """Result of a join."""

    part: _Part
    growth: float
    """Volume that the join adds, m^3."""


class _Merger:
    """Pieces by number, the neighbours of each, and the possible joins."""

    def __init__(
        self,
        pieces: list[np.ndarray],
        triangles: np.ndarray,
        volume: float | None,
        *,
        has_walls: bool,
    ):
        """Takes the arguments of `merge`."""
        self._has_walls = has_walls
        random = np.random.default_rng(0)
        surface = shapes.on_triangles(triangles, random.random((SURFACE_SAMPLES, 3)))[0]
        self._surface = _sort_by_x(surface)
        self._probes = random.random((_PROBES_PER_HULL, 3))
        self._directions = random.normal(size=(3, _DIRECTIONS))
        hulls = [hull for hull in map(solid_hull, pieces) if hull is not None]
        if volume is None:
            self._volume = sum(hull.volume for hull in hulls)
            self._inner = None
            hull_meshes = [shapes.triangulate(hull.points) for hull in hulls]
            triangles = np.concatenate([mesh.triangles for mesh in hull_meshes])
        else:
            self._volume = volume
            self._inner = _sort_by_x(interior(triangles, _INNER_POINTS))
        self._voxels = voxels(triangles, MAX_SURFACE_ERROR_M)
        self._distance = distance_transform_edt(~self._voxels.inside, self._voxels.spacing)
        self.parts = {i: self._part(hull) for i, hull in enumerate(hulls)}
        self._count = len(self.parts)
        self._neighbors: dict[int, dict[int, float]] = {i: {} for i in self.parts}
        """Neighbours of each piece, and the error of their join or an expected lower bound, m."""
        self._joins: list[_Join] = []
        for i, j in _neighbours([part.hull for part in self.parts.values()]):
            self._add_join(i, j, 0.0)

    def _part(self, hull: ConvexHull) -> _Part:
        """A piece of this hull, thinner along its shortest axis where the mesh does not fill it."""
        hollow_share = 1.0
        thinned = hull
        shift = 0.0
        if self._inner is not None:
            hollow_share = self._hollow_share(hull, self._inner)
            if self._has_walls:
                thinned, shift = _thin(hull, hollow_share)
        near_surface = _in_box(thinned, self._surface)
        depth = -signed_distances(thinned, near_surface).min(initial=0.0)
        probes, _, _ = shapes.on_triangles(thinned.points[thinned.simplices], self._probes)
        distance = self._distance[self._voxels.at(probes)].max()
        error = max(shift, depth, distance)
        return _Part(corners_of(hull), thinned, hollow_share * hull.volume, float(error))

    def _hollow_share(self, hull: ConvexHull, inner: np.ndarray) -> float:
        """Share of a hull that the mesh does not fill, by sorted points (N, 3) inside of it."""
        near = _in_box(hull, inner)
        if hull.volume * len(inner) < _MIN_INNER_EXPECTED * self._volume or not len(near):
            return 0.0
        tested = near[:: 1 + len(near) // _MAX_INNER_TESTED]
        share = (signed_distances(hull, tested) < 0).mean()
        return float(1 - share * len(near) / len(inner) * self._volume / hull.volume)

    def reduce(self, max_pieces: int, on_join: Callable[[int, int], None]) -> None:
        """Joins pieces, cheapest first, until no join is left.

        Below the limit of pieces only joins within tolerances are made.

        Args:
          max_pieces: largest number of pieces.
          on_join: see `merge`.
        """
        grown = 0.0
        first_count = self._count
        required = max(0, first_count - max_pieces)
        while self._joins:
            join = heapq.heappop(self._joins)
            if join.first not in self.parts or join.second not in self.parts:
                continue
            is_optional = len(self.parts) <= max_pieces
            if is_optional and join.error > MAX_JOIN_DEPTH_M:
                continue
            if join.measured is None:
                self._measure(join.first, join.second)
                continue
            growth = join.measured.growth
            if is_optional and grown + growth > MAX_JOIN_GROWTH * self._volume:
                continue
            grown += growth
            self._apply(join.first, join.second, join.measured.part)
            done = self._count - first_count
            on_join(done, max(done, required))

    def _add_join(self, i: int, j: int, error: float) -> None:
        """Adds the join of two pieces, to be measured when no other one can be cheaper.

        Args:
          i: number of the first piece.
          j: number of the second piece.
          error: expected lower bound of the error of the joined piece, m.
        """
        self._neighbors[i][j] = error
        self._neighbors[j][i] = error
        cost = error / MAX_SURFACE_ERROR_M
        heapq.heappush(self._joins, _Join(cost, i, j, error))

    def _measure(self, i: int, j: int) -> None:
        """Adds the join of two pieces with its cost."""
        first = self.parts[i]
        second = self.parts[j]
        vertices = np.concatenate([first.vertices, second.vertices])
        if len(vertices) > _DIRECTIONS:
            extremes = (vertices @ self._directions).argmax(0)
            vertices = vertices[np.unique(extremes)]
        part = self._part(shapes.hull_of(vertices))
        growth = max(0.0, part.hull.volume - first.hull.volume - second.hull.volume)
        filled = max(0.0, part.hollow - first.hollow - second.hollow)
        cost = part.error / MAX_SURFACE_ERROR_M + filled / (MAX_VOLUME_ERROR * self._volume)
        self._neighbors[i][j] = part.error
        self._neighbors[j][i] = part.error
        joined = _Joined(part, growth)
        heapq.heappush(self._joins, _Join(cost, i, j, part.error, joined))

    def _apply(self, first: int, second: int, part: _Part) -> None:
        """Replaces two pieces by their join.

        A larger hull has more of the surface in it. Its join with a neighbour is therefore expected
        to deviate at least as far as the worse of the two pieces' joins with that neighbour, though
        the samples and the thinning of pieces allow exceptions.
        """
        new = self._count
        self._count += 1
        errors = self._neighbors.pop(first)
        for k, error in self._neighbors.pop(second).items():
            errors[k] = max(error, errors.get(k, 0.0))
        for i in (first, second):
            del self.parts[i]
            del errors[i]
        self.parts[new] = part
        self._neighbors[new] = {}
        for k, error in errors.items():
            self._neighbors[k].pop(first, None)
            self._neighbors[k].pop(second, None)
            self._add_join(new, k, error)


def merge(
    pieces: list[np.ndarray],
    max_pieces: int,
    triangles: np.ndarray,
    volume: float | None,
    *,
    has_walls: bool = True,
    on_join: Callable[[int, int], None] = lambda done, total: None,
) -> list[np.ndarray]:
    """Joins neighbouring pieces until `max_pieces` are left, then while the shape is preserved.

    The cost of a join is the volume that it adds and its deviation from the surface, each as a
    share of the tolerance (`fidelity.MAX_VOLUME_ERROR`, `MAX_SURFACE_ERROR_M`). The deviation is
    the depth of the deepest surface point in the piece, the way that thinning moves its sides, or
    the distance of its farthest point from the mesh, by samples. Pieces that do not touch are never
    joined, so that more than `max_pieces` remain if there are more separate bodies.

    Args:
      pieces: vertices (V, 3) of each, m.
      max_pieces: largest number of pieces.
      triangles: (F, 3, 3) corners of the surface that they approximate, m.
      volume: volume of the object, m^3; None for an open surface, whose pieces are not thinned.
      has_walls: False if the object is solid, so that no piece is thinned.
      on_join: called after each join with the number of joins, and that of all required ones.
    """
    merger = _Merger(pieces, triangles, volume, has_walls=has_walls)
    merger.reduce(max_pieces, on_join)
    return [corners_of(part.hull) for part in merger.parts.values()]


def _thin(hull: ConvexHull, hollow_share: float) -> tuple[ConvexHull, float]:
    """Returns the hull made thinner along its shortest axis by its hollow share, and the shift of
    its sides, m.

    The hull is unchanged if it is full, or too thick for a wall.
    """
    vertices = corners_of(hull)
    axis = np.linalg.svd(vertices - vertices.mean(0), full_matrices=False)[2][-1]
    along = vertices @ axis
    if hollow_share <= _MIN_HOLLOW_SHARE or np.ptp(along) >= _MAX_WALL_M:
        return hull, 0.0
    middle = (along.max() + along.min()) / 2
    inwards = min(hollow_share, _MAX_THINNING) * (middle - along)
    largest = np.abs(inwards).max()
    shift = min(MAX_SURFACE_ERROR_M, largest)
    return shapes.hull_of(vertices + np.outer(inwards * shift / largest, axis)), shift


def _neighbours(hulls: list[ConvexHull]) -> Iterator[tuple[int, int]]:
    """Yields pairs of hulls whose boxes touch, and of which no side of one separates it from the
    other.
    """
    low = np.array([hull.min_bound for hull in hulls])
    high = np.array([hull.max_bound for hull in hulls]) + _MAX_NEIGHBOUR_GAP_M
    for i, hull in enumerate(hulls):
        touches = ((low[i] < high[:i]) & (low[:i] < high[i])).all(-1)
        for j in np.flatnonzero(touches).tolist():
            if not (_separates(hull, hulls[j]) or _separates(hulls[j], hull)):
                yield i, j


def _separates(hull: ConvexHull, other: ConvexHull) -> bool:
    """True if all of another hull is in front of one side of a hull."""
    distances = corners_of(other) @ hull.equations[:, :3].T + hull.equations[:, 3]
    return bool((distances.min(0) > _MAX_NEIGHBOUR_GAP_M).any())


def _sort_by_x(points: np.ndarray) -> np.ndarray:
    """Points (N, 3) in the order of their first coordinate; each coordinate is contiguous."""
    return np.asfortranarray(points[np.argsort(points[:, 0])])


def _in_box(hull: ConvexHull, points: np.ndarray) -> np.ndarray:
    """Points inside the hull's bounding box, of sorted points (N, 3)."""
    low = hull.min_bound
    high = hull.max_bound
    start = np.searchsorted(points[:, 0], low[0], side="right")
    end = np.searchsorted(points[:, 0], high[0], side="left")
    candidates = points[start:end]
    _, y, z = candidates.T
    inside = (y > low[1]) & (y < high[1]) & (z > low[2]) & (z < high[2])
    return np.ascontiguousarray(candidates[inside])
