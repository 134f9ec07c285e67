"""Closed meshes whose bodies touch along edges, as manifolds."""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from trimesh.geometry import faces_to_edges
from trimesh.graph import is_watertight

_ANGLE_DECIMALS = 5
"""Decimals to which angles about an edge are equal, rad."""
_HALF_TURN = round(np.pi, _ANGLE_DECIMALS)


def manifold(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Returns a closed mesh in which each edge has two triangles.

    Where more triangles meet at an edge, those are connected between which the solid lies; vertices
    of unconnected ones are doubled.

    Args:
      vertices: (V, 3).
      faces: (F, 3), wound outwards.

    Returns:
      Vertices (W, 3) and faces (F, 3) of the same shape; None if the mesh is not closed, or its
      triangles overlap.
    """
    if is_watertight(faces_to_edges(faces))[0]:
        return vertices, faces
    pairs = _paired_edges(vertices, faces)
    if pairs is None:
        return None
    # Corners, numbered by face and place, are the same vertex if a pair of edges connects them.
    first, second = pairs.T
    starts = _next_corner(first), second
    ends = first, _next_corner(second)
    connected = np.concatenate([np.stack(starts, 1), np.stack(ends, 1)])
    count = faces.size
    ones = np.ones(len(connected), bool)
    graph = coo_matrix((ones, (connected[:, 0], connected[:, 1])), (count, count))
    _, vertex_of_corner = connected_components(graph, directed=False)
    _, first_corner = np.unique(vertex_of_corner, return_index=True)
    separated = vertex_of_corner.reshape(-1, 3)
    if not is_watertight(faces_to_edges(separated))[0]:
        return None
    return vertices[faces.reshape(-1)[first_corner]], separated


def _paired_edges(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray | None:
    """(P, 2) pairs of edges with the solid between their triangles, each by its first corner.

    None if an edge has no partner.
    """
    start = faces.reshape(-1)
    end = np.roll(faces, -1, axis=1).reshape(-1)
    opposite = np.roll(faces, -2, axis=1).reshape(-1)
    low = np.minimum(start, end)
    high = np.maximum(start, end)
    is_forward = start < end
    angle = _angles(vertices[low], vertices[high], vertices[opposite])
    edge = low.astype(np.int64) * len(vertices) + high
    # At the same angle, one body ends before the next one begins.
    order = np.lexsort([~is_forward, angle, edge])
    pairs = []
    for members in np.split(order, np.flatnonzero(np.diff(edge[order])) + 1):
        # Counterclockwise about the edge, the solid begins at a backward and ends at a forward one.
        forward = is_forward[members]
        if len(members) % 2 or (forward == np.roll(forward, 1)).any():
            return None
        beginnings = np.flatnonzero(~forward)
        endings = (beginnings + 1) % len(members)
        pairs.append(np.stack([members[beginnings], members[endings]], 1))
    return np.concatenate(pairs)


def _angles(low: np.ndarray, high: np.ndarray, opposite: np.ndarray) -> np.ndarray:
    """(N,) angles of triangles about their edges, counterclockwise seen against the edge, rad.

    Args:
      low: (N, 3) beginning of each edge; equal edges have equal ones.
      high: (N, 3) its end.
      opposite: (N, 3) the third corner of the triangle.
    """
    axis = high - low
    axis = axis / np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), 1e-300)
    least = np.eye(3)[np.abs(axis).argmin(-1)]
    across = np.cross(axis, least)
    upwards = np.cross(axis, across)
    direction = opposite - low
    along_upwards = np.einsum("nk,nk->n", direction, upwards)
    along_across = np.einsum("nk,nk->n", direction, across)
    angle = np.round(np.arctan2(along_upwards, along_across), _ANGLE_DECIMALS)
    return np.where(angle <= -_HALF_TURN, _HALF_TURN, angle)


def _next_corner(corner: np.ndarray) -> np.ndarray:
    """The following corner of the same triangle."""
    return corner - corner % 3 + (corner + 1) % 3
