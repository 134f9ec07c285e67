"""Meshes cut finely enough for colours of their points to show a picture."""

import functools

import numpy as np
from scipy.spatial import cKDTree

from congrasp.common.objects.spec import Colours

_EDGE, _MOST_FACES = 0.006, 12_000
"""m, that no edge need be shorter than; most faces."""
_OWN_EDGE, _OWN_MOST_FACES = 0.003, 40_000  # where a surface has colours of its own


def finer(
    vertices: np.ndarray, faces: np.ndarray, edge: float = _EDGE, most: int = _MOST_FACES
) -> tuple[np.ndarray, np.ndarray]:
    """The same surface, its longest edges halved again and again.

    Args:
      vertices: (V, 3).
      faces: (F, 3).
      edge: how short edges need be, m; on a large surface they stay longer.
      most: how many faces there may be; a mesh that has as many is left as it is.

    Returns:
      Vertices (V', 3) float32 and faces (F', 3) int32.
    """
    corners = np.asarray(vertices, float)[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1).sum() / 2
    longest = max(edge, 2.2 * float(np.sqrt(area / most)))
    if len(faces) >= most:
        return np.asarray(vertices, np.float32), np.asarray(faces, np.int32)
    while len(corners) < most:
        sides = np.linalg.norm(corners[:, [1, 2, 0]] - corners, axis=-1)
        order = np.argsort(-sides.max(1))[: most - len(corners)]
        order = order[sides[order].max(1) > longest]
        if not len(order):
            break
        first = (sides[order].argmax(1)[:, None] + np.arange(3)) % 3
        start, end, across = np.take_along_axis(corners[order], first[..., None], 1).swapaxes(0, 1)
        middle = (start + end) / 2
        corners[order] = np.stack([start, middle, across], 1)
        corners = np.concatenate([corners, np.stack([middle, end, across], 1)])
    points, found = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    return points.astype(np.float32), found.reshape(-1, 3).astype(np.int32)


def painted(vertices: np.ndarray, faces: np.ndarray, colours: Colours) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A mesh (V, 3), (F, 3) cut finer, and (V', 3) uint8 sRGB of its points: of each the nearest known one's.

    What was found for the last few objects is kept; the arrays are read-only.
    """
    kinds = (vertices, float), (faces, np.int64), (colours.points, float), (colours.values, np.uint8)
    return _painted(*(np.asarray(array, kind).tobytes() for array, kind in kinds))


@functools.lru_cache(maxsize=8)
def _painted(*content: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`painted` by the content of its arrays, which tells objects apart."""
    kinds = float, np.int64, float, np.uint8
    corners, faces, *own = (np.frombuffer(a, kind).reshape(-1, 3) for a, kind in zip(content, kinds, strict=True))
    vertices, faces = finer(corners, faces, _OWN_EDGE, _OWN_MOST_FACES)
    found = vertices, faces, nearest(vertices, Colours(*own))
    for array in found:
        array.flags.writeable = False
    return found


def nearest(points: np.ndarray, colours: Colours) -> np.ndarray:
    """(n, 3) uint8 sRGB at points (n, 3) of a surface."""
    return colours.values[cKDTree(colours.points).query(points)[1]]
