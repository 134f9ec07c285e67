"""Texture coordinates of meshes that have none: charts of faces with one direction, packed into a
square.
"""

from typing import NamedTuple

import numpy as np
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

_MARGIN = 0.004
"""Space between charts, as a share of the root of the surface's area."""
_MIN_SIZE_M = 1e-12
"""Least side of the square, by which a surface that is a point is divided."""
_ACROSS = np.array([(1, 2), (2, 0), (0, 1)])
"""Axes of the plane onto which faces are projected along x, y and z."""


class Unwrapped(NamedTuple):
    """A mesh whose points have texture coordinates; its faces are those of the original, in the
    same order.
    """

    source: np.ndarray
    """(M,) int, index of each point in the original mesh; at a seam each chart has a separate
    point.
    """
    faces: np.ndarray
    """(F, 3) int."""
    uv: np.ndarray
    """(M, 2) in [0, 1], v upwards; lengths have the same scale everywhere, except across slanting
    faces.
    """


def unwrapped(vertices: np.ndarray, faces: np.ndarray) -> Unwrapped:
    """Returns texture coordinates of a mesh (V, 3), (F, 3), projected along the axis closest to
    each face's normal.
    """
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.abs(normals).argmax(1)
    is_backward = np.take_along_axis(normals, axis[:, None], 1)[:, 0] < 0
    count, chart = _charts(faces, 2 * axis + is_backward)
    chart_of_corner = np.repeat(chart, 3)
    corner_keys = np.stack([faces.ravel(), chart_of_corner], 1)
    keys, first, inverse = np.unique(corner_keys, axis=0, return_index=True, return_inverse=True)
    source, chart_of_point = keys.T
    axis_of_point = np.repeat(axis, 3)[first]
    is_mirrored = np.repeat(is_backward, 3)[first]
    flat = np.take_along_axis(vertices[source], _ACROSS[axis_of_point], 1)
    flat[:, 0] *= np.where(is_mirrored, -1, 1)  # seen from outside, not mirrored
    low = np.full((count, 2), np.inf)
    high = np.full((count, 2), -np.inf)
    np.minimum.at(low, chart_of_point, flat)
    np.maximum.at(high, chart_of_point, flat)
    area = np.linalg.norm(normals, axis=1).sum() / 2
    places, size = _packed(high - low, _MARGIN * float(np.sqrt(area)))
    uv = (flat - low[chart_of_point] + places[chart_of_point]) / max(size, _MIN_SIZE_M)
    return Unwrapped(source, inverse.reshape(faces.shape), uv)


def _charts(faces: np.ndarray, direction: np.ndarray) -> tuple[int, np.ndarray]:
    """Number of charts, and the chart (F,) of each face: adjacent faces (F, 3) of one direction
    (F,).
    """
    a, b = trimesh.graph.face_adjacency(faces).T
    is_same = direction[a] == direction[b]
    pairs = (a[is_same], b[is_same])
    links = coo_array((np.ones(is_same.sum(), bool), pairs), shape=(len(faces), len(faces)))
    return connected_components(links, directed=False)


def _packed(sizes: np.ndarray, margin: float) -> tuple[np.ndarray, float]:
    """Lower corners (n, 2) of rectangles (n, 2) in rows, the tallest first, and the side of the
    square around them.
    """
    sizes = sizes + margin
    area = sizes.prod(1).sum()
    width = max(float(sizes[:, 0].max()), float(np.sqrt(area)))
    places = np.zeros_like(sizes)
    x = 0.0
    y = 0.0
    row_height = 0.0
    for i in np.argsort(-sizes[:, 1], kind="stable"):
        if x + sizes[i, 0] > width * (1 + 1e-9):
            x = 0.0
            y += row_height
            row_height = 0.0
        places[i] = x, y
        x += sizes[i, 0]
        row_height = max(row_height, sizes[i, 1])
    return places + margin / 2, max(width, y + row_height)
