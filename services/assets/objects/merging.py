"""Joins of neighbouring convex pieces, as long as they preserve the shape.

The hull of a bent wall fills the inner side of the bend: at a bowl of 2 mm, half of the wall's
volume. Such a piece is thinned about its middle to the volume of the mesh in it, which leaves half
of the bend on either side.
"""

import heapq
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
    """Cost of joining two pieces."""

    cost: float
    first: int
    second: int
    growth: float
    part: _Part


class _Merger:
    """Pieces by number, the neighbours of each, and the possible joins."""

    def __init__(self, pieces: list[np.ndarray], triangles: np.ndarray, volume: float | None):
        """Takes the arguments of `merge`."""
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
        self._neighbors: dict[int, set[int]] = {i: set() for i in self.parts}
        self._joins: list[_Join] = []
        for i in self.parts:
            for j in range(i):
                if _are_neighbours(self.parts[i].hull, self.parts[j].hull):
                    self._neighbors[i].add(j)
                    self._neighbors[j].add(i)
                    self._add_join(i, j)

    def _part(self, hull: ConvexHull) -> _Part:
        """A piece of this hull, thinner along its shortest axis where the mesh does not fill it."""
        hollow_share = 1.0
        thinned = hull
        shift = 0.0
        if self._inner is not None:
            hollow_share = self._hollow_share(hull, self._inner)
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

    def reduce(self, max_pieces: int) -> None:
        """Joins pieces, cheapest first, until no join is left.

        Below the limit of pieces only joins within tolerances are made.
        """
        grown = 0.0
        while self._joins:
            join = heapq.heappop(self._joins)
            if join.first not in self.parts or join.second not in self.parts:
                continue
            is_optional = len(self.parts) <= max_pieces
            too_coarse = join.part.error > MAX_JOIN_DEPTH_M
            too_large = grown + join.growth > MAX_JOIN_GROWTH * self._volume
            if is_optional and (too_coarse or too_large):
                continue
            grown += join.growth
            self._apply(join)

    def _add_join(self, i: int, j: int) -> None:
        """Adds the join of two pieces."""
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
        join = _Join(cost=cost, first=i, second=j, growth=growth, part=part)
        heapq.heappush(self._joins, join)

    def _apply(self, join: _Join) -> None:
        """Replaces two pieces by their join."""
        new = self._count
        joined = {join.first, join.second}
        self._count += 1
        for i in joined:
            del self.parts[i]
        self.parts[new] = join.part
        neighbors = self._neighbors.pop(join.first) | self._neighbors.pop(join.second)
        self._neighbors[new] = neighbors - joined
        for k in self._neighbors[new]:
            self._neighbors[k] = self._neighbors[k] - joined | {new}
            self._add_join(new, k)


def merge(
    pieces: list[np.ndarray], max_pieces: int, triangles: np.ndarray, volume: float | None
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
    """
    merger = _Merger(pieces, triangles, volume)
    merger.reduce(max_pieces)
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


def _are_neighbours(first: ConvexHull, second: ConvexHull) -> bool:
    """True if the boxes around two hulls touch, and no side of one separates it from the other."""
    before = (first.min_bound < second.max_bound + _MAX_NEIGHBOUR_GAP_M).all()
    after = (second.min_bound < first.max_bound + _MAX_NEIGHBOUR_GAP_M).all()
    if not (before and after):
        return False
    return not (_separates(first, second) or _separates(second, first))


def _separates(hull: ConvexHull, other: ConvexHull) -> bool:
    """True if all of another hull is in front of one side of a hull."""
    distances = corners_of(other) @ hull.equations[:, :3].T + hull.equations[:, 3]
    return bool((distances.min(0) > _MAX_NEIGHBOUR_GAP_M).any())


def _sort_by_x(points: np.ndarray) -> np.ndarray:
    """Points (N, 3) in the order of their first coordinate."""
    return points[np.argsort(points[:, 0])]


def _in_box(hull: ConvexHull, points: np.ndarray) -> np.ndarray:
    """Points inside the hull's bounding box, of sorted points (N, 3)."""
    start, end = np.searchsorted(points[:, 0], [hull.min_bound[0], hull.max_bound[0]])
    candidates = points[start:end]
    inside = (candidates > hull.min_bound) & (candidates < hull.max_bound)
    return candidates[inside.all(-1)]
