"""Dented polygons of mesh files, cut into triangles inside of them."""

import mapbox_earcut
import numpy as np

_MAX_CORNERS = 1000
"""Corners of a dented polygon that is cut. One that crosses itself takes 0.1 s."""
_MAX_CORNERS_IN_FILE = 20_000
"""Corners of all cut polygons of more than four corners."""
_POLYGONS_AT_A_TIME = 4096
"""Polygons whose corners stay in the processor's cache."""
_MIN_DENT_SINE = 0.01
"""Sine of the least turn of a corner against the others."""
_MAX_AREA_ERROR = 1e-6
"""Relative difference between the areas of a polygon and of its triangles. It is larger if the
polygon crosses itself.
"""

Triangles = list[list[int]]
"""Triangles of a polygon, by the places of their three corners."""


def alike(counts: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """Groups faces by their number of corners.

    Args:
      counts: (F,) number of corners of each face.

    Returns:
      The numbers of corners from three on, ascending, each with the places (m,) of the faces that
      have as many.
    """
    order = np.argsort(counts, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(counts[order])) + 1)
    alike_groups = []
    for places in groups:
        count = int(counts[places[0]])
        if count > 2:
            alike_groups.append((count, places))
    return alike_groups


def cut_dented(
    points: np.ndarray, groups: list[np.ndarray], notes: list[str]
) -> list[dict[int, Triangles]]:
    """Cuts the polygons that a fan from their first corner would not cut.

    Args:
      points: (V, 3).
      groups: (m, n) indices of the points of polygons with n corners, n ascending.
      notes: the number of those that could not be cut is appended.

    Returns:
      Triangles of the dented polygons of each group, by their row.
    """
    cuts: list[dict[int, Triangles]] = []
    corners_left = _MAX_CORNERS_IN_FILE
    uncut = 0
    for polygons in groups:
        corner_count = polygons.shape[1]
        is_dent = _dents(points, polygons)
        group_cuts: dict[int, Triangles] = {}
        for row in np.flatnonzero(is_dent.any(1)).tolist():
            triangles: Triangles = []
            if corner_count == 4:
                triangles = _cut_quadrangle(is_dent[row])
            elif corner_count <= min(_MAX_CORNERS, corners_left):
                corners_left -= corner_count
                triangles = _ears(points[polygons[row]])
            if triangles:
                group_cuts[row] = triangles
            else:
                uncut += 1
        cuts.append(group_cuts)
    if uncut:
        notes.append(
            f"{uncut} of its dented polygons could not be cut and may be filled (export it as "
            f"triangles)"
        )
    return cuts


def _dents(points: np.ndarray, polygons: np.ndarray) -> np.ndarray:
    """(m, n) bool, True for corners of polygons (m, n) that turn against the others."""
    batches = np.array_split(polygons, len(polygons) // _POLYGONS_AT_A_TIME + 1)
    turns = np.concatenate([_turns(points[batch]) for batch in batches])
    return turns < -_MIN_DENT_SINE


def _cut_quadrangle(is_dent: np.ndarray) -> Triangles:
    """Two triangles that meet at the dent (4,) bool of a quadrangle; none if it has several."""
    dents = np.flatnonzero(is_dent)
    if len(dents) != 1:
        return []
    a, b, c, d = [(int(dents[0]) + j) % 4 for j in range(4)]
    return [[a, b, c], [a, c, d]]


def _normals(corners: np.ndarray) -> np.ndarray:
    """Normals (n, 3) of polygons (n, k, 3), as long as twice their areas."""
    spokes = corners - corners[:, :1]
    return np.cross(spokes, np.roll(spokes, -1, 1)).sum(1)


@np.errstate(all="ignore")
def _turns(corners: np.ndarray) -> np.ndarray:
    """(n, k) sines of the turns at the corners of polygons (n, k, 3), negative at dents."""
    sides = np.roll(corners, -1, 1) - corners
    sides /= np.linalg.norm(sides, axis=-1, keepdims=True)
    normals = _normals(corners)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    turns = np.cross(np.roll(sides, 1, 1), sides)
    return np.einsum("nkd,nd->nk", turns, normals)


def _ears(corners: np.ndarray) -> Triangles:
    """n - 2 triangles of a polygon (n, 3); none if it crosses itself.

    Its points may coincide, as where a bridge leads to the outline of a hole. Earcut then leaves
    some out, and triangles without an area take their places.
    """
    flat = _flattened(corners)
    corner_count = len(flat)
    ends = np.array([corner_count], np.uint32)
    triangles = mapbox_earcut.triangulate_float64(flat, ends).reshape(-1, 3).astype(int)
    (normal,) = _normals(corners[None])
    error = np.linalg.norm(_normals(corners[triangles]).sum(0) - normal)
    if not error <= _MAX_AREA_ERROR * np.linalg.norm(normal):
        return []
    missing_count = corner_count - 2 - len(triangles)
    return triangles.tolist() + missing_count * [[0, 0, 0]]


def _flattened(corners: np.ndarray) -> np.ndarray:
    """(n, 2) a polygon (n, 3) seen along the axis of its largest projection, anticlockwise."""
    (normal,) = _normals(corners[None])
    axis = int(np.abs(normal).argmax())
    first = (axis + 1) % 3
    second = (axis + 2) % 3
    if normal[axis] > 0:
        return np.ascontiguousarray(corners[:, [first, second]])
    return np.ascontiguousarray(corners[:, [second, first]])
