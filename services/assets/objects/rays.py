"""Parallel rays through triangles: where they cross them, and where they are inside.

A ray is inside where the winding number of the triangles around it is above zero: bodies may
overlap, and walls inside of others do not count.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

RAYS = 256
"""Rays along the longest side of the box around the triangles."""
OFF_GRID = np.array([0.1236068, 0.4142136, 0.7320508])
"""Shift of the rays, in spacings: corners at round numbers miss the rays."""


class RayGrid(NamedTuple):
    """A grid of rays along each axis."""

    low: np.ndarray
    """(3,) corner of the grid, m."""
    spacing: float
    """Distance of neighbouring rays, m."""


class Crossings(NamedTuple):
    """Crossings (N) of the rays along one axis with triangles."""

    axis: int
    """Axis of the rays, 0 to 2."""
    rays: np.ndarray
    """(N, 2) the ray of each crossing."""
    place: np.ndarray
    """(N,) where on the ray, in spacings."""
    points: np.ndarray
    """(N, 3) where in space, m."""
    normals: np.ndarray
    """(N, 3) unit normals of the triangles."""
    change: np.ndarray
    """(N,) of the winding number."""


class Intervals(NamedTuple):
    """The parts of rays that are inside, by indices of crossings."""

    entries: np.ndarray
    """(K,) where rays enter."""
    exits: np.ndarray
    """(K,) where they leave again."""
    closed: np.ndarray
    """(M,) ends of gaps that were closed."""


class _Hits(NamedTuple):
    """Crossings (N) of rays through the integers of the first two axes, along the third."""

    rays: np.ndarray
    """(N, 2) int."""
    place: np.ndarray
    """(N,)."""
    triangle: np.ndarray
    """(N,) int."""


def grid_of(triangles: np.ndarray) -> RayGrid:
    """Returns the grid of rays for triangles (F, 3, 3), m."""
    corners = triangles.reshape(-1, 3)
    longest = float(np.ptp(corners, axis=0).max())
    return RayGrid(corners.min(0), longest / RAYS)


def cast_rays(triangles: np.ndarray, grid: RayGrid) -> Iterator[Crossings]:
    """Yields the crossings of triangles (F, 3, 3), m, with the rays along each axis."""
    low, spacing = grid
    for axis in range(3):
        order = [(axis + 1) % 3, (axis + 2) % 3, axis]  # the rays run along the last of these
        shift = np.array([*OFF_GRID[order[:2]], 0.0])
        scaled = (triangles[..., order] - low[order]) / spacing + shift
        triangle_normals = _unit_normals(scaled)
        hits = _hits(scaled, triangle_normals)
        hit_normals = triangle_normals[hits.triangle]
        points = np.empty((len(hits.place), 3))
        points[:, order] = (np.column_stack([hits.rays, hits.place]) - shift) * spacing + low[order]
        normals = np.empty((len(hits.place), 3))
        normals[:, order] = hit_normals
        yield Crossings(
            axis=axis,
            rays=hits.rays,
            place=hits.place,
            points=points,
            normals=normals,
            change=-np.sign(hit_normals[:, 2]),
        )


def line_crossings(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the crossings of triangles (F, 3, 3) with lines along the third axis.

    Returns:
      (N, 2) integers of the first two axes through which the line passes, (N,) where on the line,
      and (N,) int change of the winding number.
    """
    normals = _unit_normals(triangles)
    hits = _hits(triangles, normals)
    change = -np.sign(normals[hits.triangle, 2]).astype(int)
    return hits.rays, hits.place, change


def intervals(crossings: Crossings, seam: float) -> Intervals:
    """Returns the parts of rays that are inside.

    Args:
      crossings: crossings of rays along an axis.
      seam: gaps narrower than this, in spacings, are closed.
    """
    order = np.lexsort((crossings.place, crossings.rays[:, 1], crossings.rays[:, 0]))
    rays = crossings.rays[order]
    place = crossings.place[order]
    inside = np.cumsum(crossings.change[order]) > 0.5
    before = np.r_[False, inside[:-1]]
    entries = np.flatnonzero(inside & ~before)
    exits = np.flatnonzero(~inside & before)
    if not len(entries):  # the rays miss the body
        return Intervals(entries, exits, entries)
    later_entries = entries[1:]
    earlier_exits = exits[:-1]
    same_ray = (rays[later_entries] == rays[earlier_exits]).all(-1)
    is_gap = ~same_ray | (place[later_entries] - place[earlier_exits] >= seam)
    closed = np.r_[later_entries[~is_gap], earlier_exits[~is_gap]]
    return Intervals(
        entries=order[entries[np.r_[True, is_gap]]],
        exits=order[exits[np.r_[is_gap, True]]],
        closed=order[closed],
    )


def _unit_normals(triangles: np.ndarray) -> np.ndarray:
    """(F, 3) unit normals of triangles (F, 3, 3); zeros for degenerate ones."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)


def _hits(triangles: np.ndarray, normals: np.ndarray) -> _Hits:
    """Crossings of rays through integers with triangles (F, 3, 3) of normals (F, 3).

    The lines of integers along the second axis are intersected with the triangles first, and the
    integers between both intersections are the rays.
    """
    first_axis = triangles[:, :, 0]
    triangle, row = _integers(first_axis.min(1), first_axis.max(1))
    start = triangles[triangle]
    end = np.roll(triangles, -1, axis=1)[triangle]
    crossed = (start[:, :, 0] <= row[:, None]) != (end[:, :, 0] <= row[:, None])
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (row[:, None] - start[:, :, 0]) / (end[:, :, 0] - start[:, :, 0])
        side = start[:, :, 1] + share * (end[:, :, 1] - start[:, :, 1])
    low = np.where(crossed, side, np.inf).min(1)
    high = np.where(crossed, side, -np.inf).max(1)
    span, column = _integers(low, high)
    triangle = triangle[span]
    row = row[span]
    corner = triangles[triangle, 0]
    normal = normals[triangle]
    rise = normal[:, 0] * (row - corner[:, 0]) + normal[:, 1] * (column - corner[:, 1])
    is_crossed = normal[:, 2] != 0
    place = corner[is_crossed, 2] - rise[is_crossed] / normal[is_crossed, 2]
    rays = np.column_stack([row, column])
    return _Hits(rays[is_crossed], place, triangle[is_crossed])


def _integers(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All integers k with low <= k < high for each of (N,) ranges.

    Returns:
      (K,) the range of each integer, and (K,) the integers.
    """
    first = np.ceil(low).astype(int)
    counts = np.maximum(np.ceil(high).astype(int) - first, 0)
    index = np.repeat(np.arange(len(low)), counts)
    starts = np.repeat(np.cumsum(counts) - counts, counts)
    return index, first[index] + np.arange(len(index)) - starts
