"""Colours of an object's surface: those of its file, or of its graspable and avoid regions."""

import functools

import numpy as np
from scipy.spatial import cKDTree

from congrasp.common.objects.spec import Colours
from congrasp.services.appearance.palette import AVOID, GRASPABLE
from congrasp.services.appearance.subdivision import finer

_EDGE_M = 0.003
"""Edge length at which the subdivision of coloured surfaces stops."""
_MOST_FACES = 40_000
"""Limit of the number of faces of coloured surfaces."""
_NEIGHBOURS = 8
"""Known points that determine a colour."""
_SIMILAR = 24.0
"""Distance of similar colours in sRGB from 0 to 255, a standard deviation."""
_LEAST_WIDTH_M = 1e-9


def painted(
    vertices: np.ndarray, faces: np.ndarray, colours: Colours
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Subdivides a mesh (V, 3), (F, 3); returns it with (V', 3) uint8 sRGB (`colours_at`).

    Results of the last few objects are cached; the arrays are read-only.
    """
    return _painted(
        np.asarray(vertices, float).tobytes(),
        np.asarray(faces, np.int64).tobytes(),
        np.asarray(colours.points, float).tobytes(),
        np.asarray(colours.values, np.uint8).tobytes(),
    )


@functools.lru_cache(maxsize=8)
def _painted(
    vertices: bytes, faces: bytes, points: bytes, values: bytes
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`painted` by the content of its arrays, as a cache key."""
    fine_vertices, fine_faces = finer(
        np.frombuffer(vertices, float).reshape(-1, 3),
        np.frombuffer(faces, np.int64).reshape(-1, 3),
        _EDGE_M,
        _MOST_FACES,
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
    shares = np.where(avoid[:, None], AVOID, GRASPABLE)
    return Colours(points, np.round(255 * shares).astype(np.uint8))


def colours_at(points: np.ndarray, colours: Colours) -> np.ndarray:
    """(n, 3) uint8 sRGB at points (n, 3) of a surface, from the nearest known points.

    The known point whose colour most of its neighbours share, by their distances, wins; the result
    is the mean of the similar ones. So an edge between two colours is sharp, and has no teeth as
    with the single nearest point.
    """
    neighbours = np.arange(min(_NEIGHBOURS, len(colours.points))) + 1
    distance, index = cKDTree(colours.points).query(points, k=neighbours)
    width = np.maximum(distance.mean(1, keepdims=True), _LEAST_WIDTH_M)
    weight = np.exp(-((distance / width) ** 2)).astype(np.float32)
    values = colours.values[index].astype(np.float32)
    best = np.full(len(points), -1.0, np.float32)
    mean = np.zeros((len(points), 3), np.float32)
    for candidate in range(len(neighbours)):
        apart = np.square(values - values[:, candidate, None]).sum(-1)
        similar = weight * np.exp(-apart / (2 * _SIMILAR**2))
        support = similar.sum(1)
        is_better = support > best
        best[is_better] = support[is_better]
        total = np.einsum("nk,nkd->nd", similar[is_better], values[is_better])
        mean[is_better] = total / support[is_better, None]
    return np.round(mean).astype(np.uint8)
