"""Subdivision of surfaces, so that the colours of vertices can show a texture."""

import numpy as np

_MAX_EDGE_M = 0.006
_MAX_FACES = 12_000
_EDGE_PER_FACE_SIZE = 2.2
"""Longest edge of a surface at the limit of its faces, in roots of the mean area of a face: a
shorter one would exceed the limit."""


def subdivide(
    vertices: np.ndarray,
    faces: np.ndarray,
    max_edge: float = _MAX_EDGE_M,
    max_faces: int = _MAX_FACES,
) -> tuple[np.ndarray, np.ndarray]:
    """Subdivides a surface by repeatedly halving its longest edges.

    Args:
      vertices: (V, 3) m.
      faces: (F, 3).
      max_edge: edge length at which subdivision stops, m; edges of large surfaces stay longer.
      max_faces: limit of the number of faces; a mesh with as many is returned unchanged.

    Returns:
      Vertices (V', 3) float32 and faces (F', 3) int32.
    """
    corners = np.asarray(vertices, float)[faces]
    if len(faces) >= max_faces:
        return np.asarray(vertices, np.float32), np.asarray(faces, np.int32)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=-1).sum() / 2
    face_size = float(np.sqrt(area / max_faces))
    longest = max(max_edge, _EDGE_PER_FACE_SIZE * face_size)
    small_corners = bisect_longest(corners, longest, max_faces)
    points, indices = np.unique(small_corners.reshape(-1, 3), axis=0, return_inverse=True)
    return points.astype(np.float32), indices.reshape(-1, 3).astype(np.int32)


def bisect_longest(
    corners: np.ndarray, max_side: float, max_triangles: float = np.inf
) -> np.ndarray:
    """Returns triangles (F', 3, C) bisected at their longest sides until no side is longer than a
    limit.

    Args:
      corners: (F, 3, C) positions of the corners, m, and further values, which are interpolated.
      max_side: longest side, m.
      max_triangles: limit of the number of triangles; the longest sides are bisected first.
    """
    finished = []
    count = len(corners)
    while len(corners):
        sides = np.linalg.norm(corners[:, [1, 2, 0], :3] - corners[..., :3], axis=-1)
        longest_first = np.argsort(-sides.max(1))
        too_long = (sides.max(1) > max_side).sum()
        to_cut = longest_first[: int(min(too_long, max_triangles - count))]
        finished.append(corners[longest_first[len(to_cut) :]])
        # Corners from the start of the longest side on
        order = (sides[to_cut].argmax(1)[:, None] + np.arange(3)) % 3
        ordered = np.take_along_axis(corners[to_cut], order[..., None], 1)
        start, end, opposite = ordered.swapaxes(0, 1)
        middle = (start + end) / 2
        first_halves = np.stack([start, middle, opposite], 1)
        second_halves = np.stack([middle, end, opposite], 1)
        corners = np.concatenate([first_halves, second_halves])
        count += len(to_cut)
    return np.concatenate([*finished, corners])
