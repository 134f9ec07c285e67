"""Meshes cut finely enough for colours of their points to show a picture."""

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from common.objects.spec import Colours

_EDGE, _MOST_FACES = 0.006, 12_000
"""m, that no edge need be shorter than; faces beyond which a mesh is not cut finer."""
_OWN_EDGE, _OWN_MOST_FACES = 0.003, 40_000  # where a surface has colours of its own


def finer(
    vertices: np.ndarray, faces: np.ndarray, edge: float = _EDGE, most: int = _MOST_FACES
) -> tuple[np.ndarray, np.ndarray]:
    """The same surface (V, 3), (F, 3), cut until its edges are as short as `edge` (m) or it has `most` faces."""
    if len(faces) >= most:
        return np.asarray(vertices, np.float32), np.asarray(faces, np.int32)
    area = float(trimesh.Trimesh(vertices, faces, process=False).area)
    longest = max(edge, 2.2 * float(np.sqrt(area / most)))
    fine, cut = trimesh.remesh.subdivide_to_size(vertices, faces, longest, max_iter=12)[:2]
    merged = trimesh.Trimesh(fine, cut, process=False)
    merged.merge_vertices()
    return np.asarray(merged.vertices, np.float32), np.asarray(merged.faces, np.int32)


def painted(vertices: np.ndarray, faces: np.ndarray, colours: Colours) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A mesh (V, 3), (F, 3) cut finer, and (V', 3) uint8 sRGB of its points: of each the nearest known one's."""
    vertices, faces = finer(vertices, faces, _OWN_EDGE, _OWN_MOST_FACES)
    return vertices, faces, nearest(vertices, colours)


def nearest(points: np.ndarray, colours: Colours) -> np.ndarray:
    """(n, 3) uint8 sRGB at points (n, 3) of a surface."""
    return colours.values[cKDTree(colours.points).query(points)[1]]
