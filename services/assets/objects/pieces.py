"""Fewer and simpler convex pieces: joined where that preserves the shape, as thin as their walls, with few vertices.

The hull of a bent wall fills the inner side of the bend: at a bowl of 2 mm, half of the wall's volume. Such a piece is
thinned about its middle to the volume of the mesh in it, which leaves half of the bend on either side.
"""

import heapq
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from congrasp.common.objects import shapes
from congrasp.common.objects.spec import MAX_MESH_VERTICES
from congrasp.services.assets.objects.fidelity import MOST_SURFACE, MOST_VOLUME, interior

DEPTH = 1.5e-3
"""Largest depth of the surface in a hull, or distance of the hull from it, for joins below the limit of pieces, m."""
GROWTH = 0.02
"""Share of the volume that joins may add below the limit of pieces."""
_SAMPLES, _PROBES = 6000, 100  # points on the whole surface, and on the hull of two pieces
_NEAR = 5e-4  # m; pieces whose boxes are nearer than this are neighbours
_ON = 1e-4  # m; points of a hull that are nearer to a piece than this belong to it
_INNER = 30_000  # points inside of the mesh
_FULL, _MOST = 0.03, 0.9  # hollow shares of its hull from which on a piece is thinned, and by which it is at most
_LEAST = 1e-11  # m^3; smaller pieces are dropped


class _Part(NamedTuple):
    """A piece."""

    vertices: np.ndarray
    """(V, 3) before it was thinned, m."""
    hull: ConvexHull
    shift: float
    """Largest displacement of a vertex by thinning, m."""


class _Join(NamedTuple):
    """Cost of joining two pieces."""

    cost: float
    checked: bool
    """True if `depth` includes parts that stand out from the surface; this is slow, and done for the cheapest joins."""
    first: int
    second: int
    depth: float
    growth: float
    part: _Part


class _Merger:
    """Pieces by number, the neighbours of each, and the possible joins."""

    def __init__(self, pieces: list[np.ndarray], triangles: np.ndarray, volume: float | None):
        """Takes the arguments of `merge`."""
        random = np.random.default_rng(0)
        self._surface = _sorted(shapes.on_triangles(triangles, random.random((_SAMPLES, 3)))[0])
        self._tree = cKDTree(self._surface)
        self._probes = random.random((_PROBES, 3))
        hulls = [hull for hull in map(solid_hull, pieces) if hull is not None]
        self._volume = sum(hull.volume for hull in hulls) if volume is None else volume
        self._inner = None if volume is None else _sorted(interior(triangles, _INNER))
        self.parts = {i: self._part(hull) for i, hull in enumerate(hulls)}
        self._count = len(self.parts)
        self._neighbors: dict[int, set[int]] = {i: set() for i in self.parts}
        self._joins: list[_Join] = []
        for i in self.parts:
            for j in range(i):
                if _touch(self.parts[i].hull, self.parts[j].hull):
                    self._neighbors[i].add(j)
                    self._neighbors[j].add(i)
                    self._consider(i, j)

    def _part(self, hull: ConvexHull) -> _Part:
        """A piece of this hull, thinner along its shortest axis where the mesh does not fill it."""
        vertices = hull.points[hull.vertices]
        if self._inner is None:
            return _Part(vertices, hull, 0.0)
        inside = (_beyond(hull, _near(hull, self._inner)) < 0).sum()
        hollow = 1 - inside * self._volume / len(self._inner) / hull.volume
        if hollow < _FULL:
            return _Part(vertices, hull, 0.0)
        axis = np.linalg.svd(vertices - vertices.mean(0), full_matrices=False)[2][-1]
        along = vertices @ axis
        inwards = min(hollow, _MOST) * ((along.max() + along.min()) / 2 - along)
        shift = np.abs(inwards).max()
        inwards *= min(1.0, MOST_SURFACE / shift)
        return _Part(vertices, shapes.hull_of(vertices + np.outer(inwards, axis)), min(shift, MOST_SURFACE))

    def reduce(self, max_pieces: int) -> None:
        """Makes joins, cheapest first, until none is left; below the limit of pieces only those within tolerances."""
        grown = 0.0
        while self._joins:
            join = heapq.heappop(self._joins)
            if join.first not in self.parts or join.second not in self.parts:
                continue
            enough = len(self.parts) <= max_pieces
            if enough and (join.depth > DEPTH or grown + join.growth > GROWTH * self._volume):
                continue
            if not join.checked:
                self._check(join)
                continue
            grown += join.growth
            self._make(join)

    def _consider(self, i: int, j: int) -> None:
        """Enters the join of two pieces, by the depth of the surface points in it, or of its sides in a bent wall."""
        a, b = self.parts[i], self.parts[j]
        part = self._part(shapes.hull_of(np.concatenate([a.vertices, b.vertices])))
        depth = max(part.shift, -_beyond(part.hull, _near(part.hull, self._surface)).min(initial=0.0))
        self._push(False, i, j, depth, max(0.0, part.hull.volume - a.hull.volume - b.hull.volume), part)

    def _check(self, join: _Join) -> None:
        """Enters a join again, with the distance of its hull from the surface outside of the neighbouring pieces."""
        points, _, _ = shapes.on_triangles(join.part.hull.points[join.part.hull.simplices], self._probes)
        i, j = join.first, join.second
        for k in {i, j} | self._neighbors[i] | self._neighbors[j]:
            points = points[_beyond(self.parts[k].hull, points) > _ON]
        stands_out = self._tree.query(points)[0].max(initial=0.0)
        self._push(True, i, j, max(join.depth, stands_out), join.growth, join.part)

    def _push(self, checked: bool, i: int, j: int, depth: float, growth: float, part: _Part) -> None:
        """Enters a join under its cost."""
        cost = depth / MOST_SURFACE + growth / (MOST_VOLUME * self._volume)
        heapq.heappush(self._joins, _Join(cost, checked, i, j, depth, growth, part))

    def _make(self, join: _Join) -> None:
        """Replaces two pieces by their join."""
        i, j, new = join.first, join.second, self._count
        self._count += 1
        del self.parts[i], self.parts[j]
        self.parts[new] = join.part
        self._neighbors[new] = (self._neighbors.pop(i) | self._neighbors.pop(j)) - {i, j}
        for k in self._neighbors[new]:
            self._neighbors[k] = self._neighbors[k] - {i, j} | {new}
            self._consider(new, k)


def merge(pieces: list[np.ndarray], max_pieces: int, triangles: np.ndarray, volume: float | None) -> list[np.ndarray]:
    """Joins neighbouring convex pieces until `max_pieces` are left, and then while the shape is preserved.

    The cost of a join is the volume that it adds and its deviation from the surface, each as a share of the tolerance
    (`fidelity.MOST_VOLUME`, `MOST_SURFACE`). The deviation is the depth of the deepest surface point in the piece, the
    way that thinning moves its sides, or the distance of its farthest point from the surface, by samples. Pieces that
    do not touch are never joined, so that more than `max_pieces` remain if there are more separate bodies.

    Args:
      pieces: vertices (V, 3) of each, m.
      max_pieces: largest number of pieces.
      triangles: (F, 3, 3) corners of the surface that they approximate, m.
      volume: volume of the object, m^3; None for an open surface, whose pieces stay as thick as they are.
    """
    merger = _Merger(pieces, triangles, volume)
    merger.reduce(max_pieces)
    return [part.hull.points[part.hull.vertices] for part in merger.parts.values()]


def deepest(hull: ConvexHull, triangles: np.ndarray) -> float:
    """Depth in a hull of the deepest of some points on triangles (F, 3, 3), m."""
    points = shapes.on_triangles(triangles, np.random.default_rng(0).random((_SAMPLES, 3)))[0]
    return float(-_beyond(hull, points).min())


def solid_hull(vertices: np.ndarray) -> ConvexHull | None:
    """The convex hull of a piece (V, 3); None if its volume is negligible."""
    try:
        hull = shapes.hull_of(vertices)
    except QhullError:
        return None
    return hull if hull.volume > _LEAST else None


def simplify(vertices: np.ndarray, max_vertices: int = MAX_MESH_VERTICES) -> np.ndarray:
    """A convex piece of at most `max_vertices` vertices (V, 3), with the same volume.

    Starting from the extreme points along the axes, the point that sticks out furthest is added again and again; the
    result is then scaled about its centroid to the volume of the original.

    Raises:
      scipy.spatial.QhullError: the points lie in a plane.
    """
    hull = shapes.hull_of(vertices)
    points = hull.points[hull.vertices]
    if len(points) <= max_vertices:
        return points
    axes = np.linalg.svd(points - points.mean(0), full_matrices=False)[2]
    along = points @ axes.T
    chosen = list(dict.fromkeys([*along.argmax(0).tolist(), *along.argmin(0).tolist()]))
    while len(chosen) < max_vertices:
        equations = shapes.hull_of(points[chosen]).equations if len(chosen) > 3 else np.zeros((1, 4))
        outside = (points @ equations[:, :3].T + equations[:, 3]).max(-1)
        outside[chosen] = -np.inf
        chosen.append(int(outside.argmax()))
    kept = points[chosen]
    share = shapes.hull_of(kept).volume / hull.volume
    center = kept.mean(0)
    return center + (kept - center) * share ** (-1 / 3)


def _touch(a: ConvexHull, b: ConvexHull) -> bool:
    """True if the boxes around two hulls touch."""
    return bool((a.min_bound < b.max_bound + _NEAR).all() and (b.min_bound < a.max_bound + _NEAR).all())


def _sorted(points: np.ndarray) -> np.ndarray:
    """Points (N, 3) in the order of their first coordinate."""
    return points[np.argsort(points[:, 0])]


def _near(hull: ConvexHull, points: np.ndarray) -> np.ndarray:
    """Those of sorted points (N, 3) that are in the box around a hull."""
    start, end = np.searchsorted(points[:, 0], [hull.min_bound[0], hull.max_bound[0]])
    some = points[start:end]
    return some[((some > hull.min_bound) & (some < hull.max_bound)).all(-1)]


def _beyond(hull: ConvexHull, points: np.ndarray) -> np.ndarray:
    """(N,) how far points (N, 3) are beyond the facet that they are farthest beyond, m; negative inside."""
    return (points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(-1)
