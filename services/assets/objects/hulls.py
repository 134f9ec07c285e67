"""Convex hulls of pieces: their sizes, the points in them, and hulls of fewer vertices."""

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from congrasp.common.objects import shapes
from congrasp.common.objects.spec import MAX_MESH_VERTICES

SURFACE_SAMPLES = 6000
"""Points on an object's surface, whose depths in a hull are computed."""
_MIN_VOLUME_M3 = 1e-11
"""Volume of the smallest piece, m^3."""


def solid_hull(vertices: np.ndarray) -> ConvexHull | None:
    """Returns the convex hull of a piece (V, 3), m; None if its volume is negligible."""
    try:
        hull = shapes.hull_of(vertices)
    except QhullError:
        return None
    return hull if hull.volume > _MIN_VOLUME_M3 else None


def corners_of(hull: ConvexHull) -> np.ndarray:
    """Returns the vertices (V, 3) of a hull."""
    return hull.points[hull.vertices]


def signed_distances(hull: ConvexHull, points: np.ndarray) -> np.ndarray:
    """Returns signed distances (N,) of points (N, 3) to the hull's planes, negative inside, m."""
    return (points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(-1)


def deepest(hull: ConvexHull, triangles: np.ndarray) -> float:
    """Returns the depth in a hull of the deepest of some points on triangles (F, 3, 3), m."""
    random = np.random.default_rng(0).random((SURFACE_SAMPLES, 3))
    points = shapes.on_triangles(triangles, random)[0]
    return float(-signed_distances(hull, points).min())


def simplify(vertices: np.ndarray, max_vertices: int = MAX_MESH_VERTICES) -> np.ndarray:
    """Returns a convex piece of at most `max_vertices` vertices (V, 3), with the same volume.

    Starting from the extreme points along the axes, the point that sticks out furthest is added
    again and again; the result is then scaled about its centroid to the volume of the original.

    Raises:
      scipy.spatial.QhullError: the points lie in a plane.
    """
    hull = shapes.hull_of(vertices)
    points = corners_of(hull)
    if len(points) <= max_vertices:
        return points
    axes = np.linalg.svd(points - points.mean(0), full_matrices=False)[2]
    along = points @ axes.T
    extremes = [*along.argmax(0).tolist(), *along.argmin(0).tolist()]
    chosen = list(dict.fromkeys(extremes))
    while len(chosen) < max_vertices:
        equations = np.zeros((1, 4))
        if len(chosen) > 3:
            equations = shapes.hull_of(points[chosen]).equations
        outside = (points @ equations[:, :3].T + equations[:, 3]).max(-1)
        outside[chosen] = -np.inf
        chosen.append(int(outside.argmax()))
    corners = points[chosen]
    share = shapes.hull_of(corners).volume / hull.volume
    center = corners.mean(0)
    return center + (corners - center) * share ** (-1 / 3)
