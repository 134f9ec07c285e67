"""Cuts dented polygons of mesh files into triangles inside of them."""

import numpy as np

# Most corners of a dented polygon that is cut, and of all that have more than four
_CORNERS, _CUT = (
    64,
    20_000,
)
_PART = 4096  # polygons at a time, whose corners stay in the processor's cache
_DENT = 0.01  # sine of the least turn of a corner against the others


def alike(counts: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """The numbers of corners from three on, ascending, each with the places (m,) of the faces that
    have as many.
    """
    order = np.argsort(counts, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(counts[order])) + 1)
    return [(int(counts[some[0]]), some) for some in groups if counts[some[0]] > 2]


def cut_dented(
    points: np.ndarray, groups: list[np.ndarray], notes: list[str]
) -> list[dict[int, list[list[int]]]]:
    """Cuts the polygons that a fan from their first corner would not cut.

    Args:
      points: (V, 3).
      groups: (m, n) indices of the points of polygons with n corners, n ascending.
      notes: the number of those that could not be cut is appended.

    Returns:
      Triangles of the dented polygons of each group, by their row; each has the places of three
      corners.
    """
    cut, budget, uncut = list[dict[int, list[list[int]]]](), _CUT, 0
    for group in groups:
        count, found = group.shape[1], dict[int, list[list[int]]]()
        turns = np.concatenate(
            [_turns(points[part]) for part in np.array_split(group, len(group) // _PART + 1)]
        )
        for k in np.flatnonzero((turns < -_DENT).any(1)).tolist():
            triangles: list[list[int]] = []
            if count == 4:
                dents = np.flatnonzero(turns[k] < -_DENT)
                order = [(int(dents[0]) + j) % 4 for j in range(4)]
                triangles = [order[:3], [order[0], *order[2:]]] if len(dents) == 1 else []
            elif count <= min(_CORNERS, budget):
                budget -= count
                triangles = _ears(points[group[k]])
            uncut += not triangles
            if triangles:
                found[k] = triangles
        cut.append(found)
    if uncut:
        notes.append(
            f"{uncut} of its dented polygons could not be cut and may be filled (export it as "
            f"triangles)"
        )
    return cut


def _normals(corners: np.ndarray) -> np.ndarray:
    """Normals (n, 3) of polygons (n, k, 3), as long as twice their areas."""
    spokes = corners - corners[:, :1]
    return np.cross(spokes, np.roll(spokes, -1, 1)).sum(1)


@np.errstate(all="ignore")
def _turns(corners: np.ndarray) -> np.ndarray:
    """(n, k) sines of the turns at the corners of polygons (n, k, 3), negative at dents."""
    sides, normals = np.roll(corners, -1, 1) - corners, _normals(corners)
    sides /= np.linalg.norm(sides, axis=-1, keepdims=True)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.einsum("nkd,nd->nk", np.cross(np.roll(sides, 1, 1), sides), normals)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products (...) of vectors (..., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _ears(corners: np.ndarray) -> list[list[int]]:
    """Triangles of a polygon (n, 3), cut off ear by ear; none if it crosses itself.

    Its points may coincide, as where a bridge leads to the outline of a hole.
    """
    (normal,) = _normals(corners[None])
    axis = int(np.abs(normal).argmax())
    first, second = ((axis + 1) % 3, (axis + 2) % 3)[:: 1 if normal[axis] > 0 else -1]
    flat = corners[:, [first, second]]
    left, found = np.arange(len(corners)), list[list[int]]()
    while len(left) > 3:
        here = flat[left]
        ears = np.roll(here, 1, 0), here, np.roll(here, -1, 0)
        others = np.ones((len(left), len(left)), bool)
        for start, end in zip(ears, (*ears[1:], ears[0]), strict=True):
            others &= _cross((end - start)[:, None], here - start[:, None]) >= 0
            others &= (here != start[:, None]).any(-1)
        free = np.flatnonzero((_cross(ears[1] - ears[0], ears[2] - ears[1]) > 0) & ~others.any(1))
        if not len(free):
            return []
        i = int(free[0])
        found.append([int(left[i - 1]), int(left[i]), int(left[(i + 1) % len(left)])])
        left = np.delete(left, i)
    return [*found, left.tolist()]
