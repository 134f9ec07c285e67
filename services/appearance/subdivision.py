"""Subdivision of surfaces, so that the colours of vertices can show a texture."""

import numpy as np

EDGE_M = 0.006
"""Default edge length at which subdivision stops."""
MOST_FACES = 12_000
"""Default limit of the number of faces."""
_EDGE_PER_MEAN_SIDE = 2.2
"""Longest edge of a surface with the most faces, per root of its area per face."""


def finer(
    vertices: np.ndarray, faces: np.ndarray, edge: float = EDGE_M, most: int = MOST_FACES
) -> tuple[np.ndarray, np.ndarray]:
    """Subdivides a surface by repeatedly halving its longest edges.

    Args:
      vertices: (V, 3).
      faces: (F, 3).
      edge: edge length at which subdivision stops, m; edges of large surfaces stay longer.
      most: most faces; a mesh with as many is returned unchanged.

    Returns:
      Vertices (V', 3) float32 and faces (F', 3) int32.
    """
    corners = np.asarray(vertices, float)[faces]
    if len(faces) >= most:
        return np.asarray(vertices, np.float32), np.asarray(faces, np.int32)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=-1).sum() / 2
    longest = max(edge, _EDGE_PER_MEAN_SIDE * float(np.sqrt(area / most)))
    points, indices = np.unique(
        bisected(corners, longest, most).reshape(-1, 3), axis=0, return_inverse=True
    )
    return points.astype(np.float32), indices.reshape(-1, 3).astype(np.int32)


def bisected(corners: np.ndarray, longest: float, most: float = np.inf) -> np.ndarray:
    """Bisects triangles at their longest sides until no side is longer than `longest`, or there are
    `most` triangles.

    Args:
      corners: (F, 3, C) positions of the corners, m, and further values, which are interpolated.
      longest: longest side, m.
      most: limit of the number of triangles; the longest sides are bisected first.
    """
    small = []
    count = len(corners)
    while len(corners):
        sides = np.linalg.norm(corners[:, [1, 2, 0], :3] - corners[..., :3], axis=-1)
        order = np.argsort(-sides.max(1))
        cut = order[: int(min((sides.max(1) > longest).sum(), most - count))]
        small.append(corners[order[len(cut) :]])
        first = (sides[cut].argmax(1)[:, None] + np.arange(3)) % 3
        start, end, across = np.take_along_axis(corners[cut], first[..., None], 1).swapaxes(0, 1)
        middle = (start + end) / 2
        corners = np.concatenate(
            [np.stack([start, middle, across], 1), np.stack([middle, end, across], 1)]
        )
        count += len(cut)
    return np.concatenate([*small, corners])
