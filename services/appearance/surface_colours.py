"""Colours of an object's surface: those of its file, or of its graspable and avoid regions."""

import functools

import numpy as np
from scipy.spatial import cKDTree

from congrasp.common.objects.spec import Colours
from congrasp.services.appearance.palette import AVOID, GRASPABLE
from congrasp.services.appearance.subdivision import subdivide

_MAX_EDGE_M = 0.003
"""Edge length at which the subdivision of coloured surfaces stops."""
_MAX_FACES = 40_000
"""Limit of the number of faces of coloured surfaces."""
_NEIGHBOURS = 8
"""Known points that determine a colour."""
_COLOUR_SIGMA = 24.0
"""Standard deviation of the Gaussian by which the similarity of two colours decreases with their
distance in sRGB, from 0 to 255."""
_MIN_MEAN_DISTANCE_M = 1e-9


def paint_surface(
    vertices: np.ndarray, faces: np.ndarray, colours: Colours
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Subdivides a mesh and colours its vertices.

    Results of the last few objects are cached; the arrays are read-only.

    Args:
      vertices: (V, 3) m.
      faces: (F, 3).
      colours: known points of the surface.

    Returns:
      Vertices (V', 3), faces (F', 3), and the colours (V', 3) uint8 sRGB of the vertices.
    """
    return _paint_surface_bytes(
        np.asarray(vertices, float).tobytes(),
        np.asarray(faces, np.int64).tobytes(),
        np.asarray(colours.points, float).tobytes(),
        np.asarray(colours.values, np.uint8).tobytes(),
    )


@functools.lru_cache(maxsize=8)
def _paint_surface_bytes(
    vertices: bytes, faces: bytes, points: bytes, values: bytes
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`paint_surface` by the content of its arrays, as a cache key."""
    fine_vertices, fine_faces = subdivide(
        np.frombuffer(vertices, float).reshape(-1, 3),
        np.frombuffer(faces, np.int64).reshape(-1, 3),
        _MAX_EDGE_M,
        _MAX_FACES,
    )
    colours = Colours(
        np.frombuffer(points, float).reshape(-1, 3), np.frombuffer(values, np.uint8).reshape(-1, 3)
    )
    vertex_colours = colours_at(fine_vertices, colours)
    for array in (fine_vertices, fine_faces, vertex_colours):
        array.flags.writeable = False
    return fine_vertices, fine_faces, vertex_colours


def region_colours(points: np.ndarray, avoid: np.ndarray) -> Colours:
    """Colours of surface points (P, 3), m, in the avoid region (P,) bool or the graspable
    region.
    """
    rgb = np.where(avoid[:, None], AVOID, GRASPABLE)
    return Colours(points, np.round(255 * rgb).astype(np.uint8))


def colours_at(points: np.ndarray, colours: Colours) -> np.ndarray:
    """Returns the colours (n, 3) uint8 sRGB at points (n, 3) of a surface, by a vote of the nearest
    known points.

    Each neighbour proposes its colour. A neighbour supports a proposal the more, the nearer it is
    and the more similar its colour is (a Gaussian of both distances). The result is the mean of the
    neighbours' colours, weighted by their support for the proposal with the most. So an edge
    between two colours is sharp, and is not jagged as with the single nearest point.

    Args:
      points: (n, 3) m.
      colours: known points of the surface.
    """
    ranks = np.arange(min(_NEIGHBOURS, len(colours.points))) + 1
    distance, index = cKDTree(colours.points).query(points, k=ranks)
    mean_distance = np.maximum(distance.mean(1, keepdims=True), _MIN_MEAN_DISTANCE_M)
    nearness = np.exp(-((distance / mean_distance) ** 2)).astype(np.float32)
    neighbours = colours.values[index].astype(np.float32)
    most_votes = np.full(len(points), -1.0, np.float32)
    result = np.zeros((len(points), 3), np.float32)
    for rank in range(len(ranks)):
        proposal = neighbours[:, rank, None]
        squared_difference = np.square(neighbours - proposal).sum(-1)
        support = nearness * np.exp(-squared_difference / (2 * _COLOUR_SIGMA**2))
        votes = support.sum(1)
        is_better = votes > most_votes
        most_votes[is_better] = votes[is_better]
        total = np.einsum("nk,nkd->nd", support[is_better], neighbours[is_better])
        result[is_better] = total / votes[is_better, None]
    return np.round(result).astype(np.uint8)
