"""Subdivision of surfaces, so that the colours of vertices can show a texture."""

import numpy as np

_MAX_EDGE_M = 0.006
_MAX_TRIANGLES = 12_000
_EDGE_PER_TRIANGLE_SIZE = 2.2
"""Ratio of the longest edge of a subdivided surface to the root of the mean area of its triangles.

With a smaller ratio, the limit of the number of triangles would end the subdivision halfway."""


def subdivide(
    vertices: np.ndarray,
    faces: np.ndarray,
    max_edge: float = _MAX_EDGE_M,
    max_faces: int = _MAX_TRIANGLES,
) -> tuple[np.ndarray, np.ndarray]:
    """Subdivides a surface by repeatedly halving its longest edges.

    Args:
      vertices: (V, 3) m.
      faces: (F, 3).
      max_edge: edge length at which subdivision stops, m; edges of a large surface stay longer,
        so that all of its parts are subdivided alike.
      max_faces: limit of the number of triangles. A mesh with at least as many is returned with the
        same vertices and faces.

    Returns:
      Vertices (V', 3) float32 and faces (F', 3) int32. The vertices of a subdivided mesh are
      sorted; equal ones are merged, and those without a face are left out.
    """
    if len(faces) >= max_faces:
        return np.asarray(vertices, np.float32), np.asarray(faces, np.int32)
    corners = np.asarray(vertices, float)[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=-1).sum() / 2
    triangle_size = float(np.sqrt(area / max_faces))
    reachable_edge = max(max_edge, _EDGE_PER_TRIANGLE_SIZE * triangle_size)
    small_corners = bisect_longest(corners, reachable_edge, max_faces)
    points, indices = np.unique(small_corners.reshape(-1, 3), axis=0, return_inverse=True)
    return points.astype(np.float32), indices.reshape(-1, 3).astype(np.int32)


def bisect_longest(
    corners: np.ndarray, max_edge: float, max_triangles: int | None = None
) -> np.ndarray:
    """Bisects triangles at their longest edges until no edge is longer than a limit.

    No gap opens: an edge that is too long is halved at its middle in both triangles that share it,
    though not always in the same round. Only `max_triangles` may end the bisection between the two.

    Args:
      corners: (F, 3, C) positions of the corners, m, and further values, which are interpolated.
      max_edge: longest edge, m.
      max_triangles: limit of the number of triangles, None without one; the longest edges are
        halved first. More triangles are returned unchanged.

    Returns:
      Triangles (F', 3, C).
    """
    finished = []
    count = len(corners)
    while len(corners):
        edges = np.linalg.norm(corners[:, [1, 2, 0], :3] - corners[..., :3], axis=-1)
        longest_first = np.argsort(-edges.max(1))
        cut_count = int((edges.max(1) > max_edge).sum())
        if max_triangles is not None:
            cut_count = min(cut_count, max(0, max_triangles - count))
        to_cut = longest_first[:cut_count]
        finished.append(corners[longest_first[cut_count:]])
        # Rotates each triangle so that its longest edge leads from its first to its second corner
        start_index = edges[to_cut].argmax(1)
        order = (start_index[:, None] + np.arange(3)) % 3
        rotated = np.take_along_axis(corners[to_cut], order[..., None], 1)
        start = rotated[:, 0]
        end = rotated[:, 1]
        opposite = rotated[:, 2]
        middle = (start + end) / 2
        first_halves = np.stack([start, middle, opposite], 1)
        second_halves = np.stack([middle, end, opposite], 1)
        corners = np.concatenate([first_halves, second_halves])
        count += cut_count
    return np.concatenate([*finished, corners])
