"""Texture coordinates of a mesh: adjacent faces towards the same side are a chart; charts do not overlap."""

from typing import NamedTuple

import numpy as np
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

_MARGIN = 0.004  # space between charts, as a share of the root of the surface's area


class Unwrapped(NamedTuple):
    """A mesh whose points have texture coordinates; its faces are those of the original, in the same order."""

    source: np.ndarray
    """(M,) int, index of each point in the original mesh; at a seam each chart has a separate point."""
    faces: np.ndarray
    """(F, 3) int."""
    uv: np.ndarray
    """(M, 2) in [0, 1], v upwards; lengths have the same scale everywhere, except across slanting faces."""


def unwrapped(vertices: np.ndarray, faces: np.ndarray) -> Unwrapped:
    """Returns texture coordinates of a mesh (V, 3), (F, 3), projected along the axis closest to each face's normal."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.abs(normals).argmax(1)
    side = 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] < 0)
    a, b = trimesh.graph.face_adjacency(faces).T
    same = side[a] == side[b]
    links = coo_array((np.ones(same.sum(), bool), (a[same], b[same])), shape=(len(faces), len(faces)))
    count, chart = connected_components(links, directed=False)
    of_corner = np.repeat(chart, 3)
    pairs = np.stack([faces.ravel(), of_corner], 1)
    points, first, inverse = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
    source, chart_of = points.T
    across = np.array([(1, 2), (2, 0), (0, 1)])[np.repeat(axis, 3)[first]]
    flat = np.take_along_axis(vertices[source], across, 1)
    flat[:, 0] *= np.where(np.repeat(side, 3)[first] % 2, -1, 1)  # seen from outside, not mirrored
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, chart_of, flat)
    np.maximum.at(high, chart_of, flat)
    places, size = _packed(high - low, _MARGIN * float(np.sqrt(np.linalg.norm(normals, axis=1).sum() / 2)))
    uv = (flat - low[chart_of] + places[chart_of]) / max(size, 1e-12)
    return Unwrapped(source, inverse.reshape(faces.shape), uv)


def _packed(sizes: np.ndarray, margin: float) -> tuple[np.ndarray, float]:
    """Lower corners (n, 2) of rectangles (n, 2) in rows, the tallest first, and the side of the square around them."""
    sizes = sizes + margin
    width = max(float(sizes[:, 0].max()), float(np.sqrt(sizes.prod(1).sum())))
    places = np.zeros_like(sizes)
    x = y = row = 0.0
    for i in np.argsort(-sizes[:, 1], kind="stable"):
        if x + sizes[i, 0] > width * (1 + 1e-9):
            x, y, row = 0.0, y + row, 0.0
        places[i] = x, y
        x, row = x + sizes[i, 0], max(row, sizes[i, 1])
    return places + margin / 2, max(width, y + row)
