"""Fewer and simpler convex pieces: joined where their hull stays close to the surface, thinned, with few vertices."""

import heapq
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from congrasp.common.objects import shapes
from congrasp.common.objects.spec import MAX_MESH_VERTICES
from congrasp.services.assets.objects.fidelity import MOST_SURFACE, MOST_VOLUME

DEPTH = 1.5e-3
"""Largest depth of the surface in a hull, or distance of the hull from it, for joins below the limit of pieces, m."""
GROWTH = 0.02
"""Share of the volume that joins may add below the limit of pieces."""
SQUEEZE = 4e-4
"""Largest displacement of a side of a piece inwards, m."""
_SAMPLES, _PROBES = 6000, 100  # points on the whole surface, and on the hull of two pieces
_NEAR = 5e-4  # m; pieces whose boxes are nearer than this are neighbours
_ON = 1e-4  # m; points of a hull that are nearer to a piece than this belong to it
_LEAST = 1e-11  # m^3; smaller pieces are dropped


class _Join(NamedTuple):
    """Cost of joining two pieces."""

    cost: float
    checked: bool
    """True if `depth` includes parts that stand out from the surface; this is slow, and done for the cheapest joins."""
    first: int
    second: int
    depth: float
    growth: float
    hull: ConvexHull


class _Merger:
    """Pieces by number, the neighbours of each, and the possible joins."""

    def __init__(self, pieces: list[np.ndarray], triangles: np.ndarray, volume: float):
        """Takes the arguments of `merge`."""
        random = np.random.default_rng(0)
        self._surface = shapes.on_triangles(triangles, random.random((_SAMPLES, 3)))[0]
        self._tree = cKDTree(self._surface)
        self._probes = random.random((_PROBES, 3))
        self._volume = volume
        self.hulls = dict(enumerate(hull for hull in map(solid_hull, pieces) if hull is not None))
        self._count = len(self.hulls)
        self._neighbors: dict[int, set[int]] = {i: set() for i in self.hulls}
        self._joins: list[_Join] = []
        for i in self.hulls:
            for j in range(i):
                if _touch(self.hulls[i], self.hulls[j]):
                    self._neighbors[i].add(j)
                    self._neighbors[j].add(i)
                    self._consider(i, j)

    def reduce(self, max_pieces: int) -> None:
        """Makes joins, cheapest first, until none is left; below the limit of pieces only those within tolerances."""
        grown = 0.0
        while self._joins:
            join = heapq.heappop(self._joins)
            if join.first not in self.hulls or join.second not in self.hulls:
                continue
            enough = len(self.hulls) <= max_pieces
            if enough and (join.depth > DEPTH or grown + join.growth > GROWTH * self._volume):
                continue
            if not join.checked:
                self._check(join)
                continue
            grown += join.growth
            self._make(join)

    def _consider(self, i: int, j: int) -> None:
        """Enters the join of two pieces, by the depth of the surface points in their hull."""
        a, b = self.hulls[i], self.hulls[j]
        hull = shapes.hull_of(np.concatenate([a.points[a.vertices], b.points[b.vertices]]))
        boxed = ((self._surface > hull.min_bound) & (self._surface < hull.max_bound)).all(-1)
        depth = max(0.0, -_beyond(hull, self._surface[boxed]).min(initial=0.0))
        self._push(False, i, j, depth, max(0.0, hull.volume - a.volume - b.volume), hull)

    def _check(self, join: _Join) -> None:
        """Enters a join again, with the distance of its hull from the surface outside of the neighbouring pieces."""
        points, _, _ = shapes.on_triangles(join.hull.points[join.hull.simplices], self._probes)
        i, j = join.first, join.second
        for k in {i, j} | self._neighbors[i] | self._neighbors[j]:
            points = points[_beyond(self.hulls[k], points) > _ON]
        stands_out = self._tree.query(points)[0].max(initial=0.0)
        self._push(True, i, j, max(join.depth, stands_out), join.growth, join.hull)

    def _push(self, checked: bool, i: int, j: int, depth: float, growth: float, hull: ConvexHull) -> None:
        """Enters a join under its cost."""
        cost = depth / MOST_SURFACE + growth / (MOST_VOLUME * self._volume)
        heapq.heappush(self._joins, _Join(cost, checked, i, j, depth, growth, hull))

    def _make(self, join: _Join) -> None:
        """Replaces two pieces by their hull."""
        i, j, new = join.first, join.second, self._count
        self._count += 1
        del self.hulls[i], self.hulls[j]
        self.hulls[new] = join.hull
        self._neighbors[new] = (self._neighbors.pop(i) | self._neighbors.pop(j)) - {i, j}
        for k in self._neighbors[new]:
            self._neighbors[k] = self._neighbors[k] - {i, j} | {new}
            self._consider(new, k)


def merge(pieces: list[np.ndarray], max_pieces: int, triangles: np.ndarray, volume: float) -> list[np.ndarray]:
    """Joins neighbouring convex pieces until `max_pieces` are left, and then while the shape is preserved.

    The cost of a join is the volume that its hull adds and its deviation from the surface, each as a share of the
    tolerance (`fidelity.MOST_VOLUME`, `MOST_SURFACE`). The deviation is the depth of the deepest surface point in the
    hull, or the distance of its farthest point from the surface, by samples. Pieces that do not touch are never joined,
    so that more than `max_pieces` remain if there are more separate bodies.

    Args:
      pieces: vertices (V, 3) of each, m.
      max_pieces: largest number of pieces.
      triangles: (F, 3, 3) corners of the surface that they approximate, m.
      volume: volume of the object, m^3.
    """
    merger = _Merger(pieces, triangles, volume)
    merger.reduce(max_pieces)
    return [hull.points[hull.vertices] for hull in merger.hulls.values()]


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


def squeeze(vertices: np.ndarray, factor: float) -> np.ndarray:
    """A piece (V, 3) made thinner by a factor, each side by at most `SQUEEZE`.

    Hulls of bent walls fill the inner side of the bend; thinner ones have the right mean thickness.
    """
    middle = vertices.mean(0)
    axis = np.linalg.svd(vertices - middle, full_matrices=False)[2][-1]
    along = (vertices - middle) @ axis
    center = (along.max() + along.min()) / 2
    shift = (along - center) * max(1 - factor, 0.0)
    thick = np.abs(shift).max()
    return vertices - np.outer(shift * min(1.0, SQUEEZE / max(thick, 1e-12)), axis)


def _touch(a: ConvexHull, b: ConvexHull) -> bool:
    """True if the boxes around two hulls touch."""
    return bool((a.min_bound < b.max_bound + _NEAR).all() and (b.min_bound < a.max_bound + _NEAR).all())


def _beyond(hull: ConvexHull, points: np.ndarray) -> np.ndarray:
    """(N,) how far points (N, 3) are beyond the facet that they are farthest beyond, m; negative inside."""
    return (points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(-1)
