"""The space inside of a closed mesh: its measures, and points in it."""

from typing import NamedTuple

import numpy as np
from trimesh.triangles import mass_properties

from congrasp.common.objects import shapes
from congrasp.services.assets.objects.rays import Crossings, cast_rays, grid_of, intervals

SEAM_WIDTH_M = 4e-4
"""Gaps along a ray that are narrower than this count as closed."""
_MIN_OVERLAP = 1e-3
"""Share of its volume that a mesh may count twice."""


class Enclosed(NamedTuple):
    """Measures of the space inside a closed mesh; bodies that overlap count once."""

    volume: float
    """m^3."""
    area: float
    """Of the outer surface, m^2; faces that touch are not part of it."""
    center: np.ndarray
    """(3,) m, centroid."""
    inertia: np.ndarray
    """(3, 3) m^5 about the centroid, at a density of 1."""
    overlaps: bool
    """True if bodies overlap: the other fields are then estimates, and exact otherwise."""


class _Overlap(NamedTuple):
    """Spans (K) of rays where bodies overlap, and the inner surface there."""

    length: np.ndarray
    """(K,) m."""
    weight: np.ndarray
    """(K,) m^3: volume of a span, times the number of further bodies, a third for each axis."""
    middle: np.ndarray
    """(K, 3) m."""
    inner_area: float
    """Area of the triangles inside of other bodies, estimated by these rays, m^2."""


def enclosed(triangles: np.ndarray) -> Enclosed:
    """Measures the space inside a closed mesh.

    What lies in several of its bodies, by rays along each axis, is taken off the mesh's integrals.

    Args:
      triangles: (F, 3, 3) corners, which wind outwards, m.
    """
    exact = mass_properties(triangles, density=1.0)
    volume = float(exact["volume"])
    center = np.asarray(exact["center_mass"])
    first_moment = volume * center
    second_moment = _second_moment(exact["inertia"]) + volume * np.outer(center, center)
    crosses = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = float(np.linalg.norm(crosses, axis=-1).sum() / 2)
    counted_twice = 0.0
    grid = grid_of(triangles)
    for crossings in cast_rays(triangles, grid):
        overlap = _overlap(crossings, grid.spacing)
        weight = overlap.weight
        axis = crossings.axis
        counted_twice += weight.sum()
        first_moment -= weight @ overlap.middle
        second_moment -= (weight[:, None] * overlap.middle).T @ overlap.middle
        second_moment[axis, axis] -= weight @ overlap.length**2 / 12
        area -= overlap.inner_area
    if counted_twice < _MIN_OVERLAP * volume:
        return Enclosed(volume, area, center, np.asarray(exact["inertia"]), overlaps=False)
    volume -= counted_twice
    center = first_moment / volume
    second_moment -= volume * np.outer(center, center)
    inertia = np.trace(second_moment) * np.eye(3) - second_moment
    return Enclosed(volume, area, center, inertia, overlaps=True)


def interior(triangles: np.ndarray, count: int) -> np.ndarray:
    """Returns evenly distributed points (`count`, 3) inside of a closed mesh.

    Args:
      triangles: (F, 3, 3) corners, which wind outwards, m.
      count: number of points.
    """
    grid = grid_of(triangles)
    starts = []
    ends = []
    for crossings in cast_rays(triangles, grid):
        entries, exits, _ = intervals(crossings, SEAM_WIDTH_M / grid.spacing)
        starts.append(crossings.points[entries])
        ends.append(crossings.points[exits])
    start = np.concatenate(starts)
    end = np.concatenate(ends)
    if not len(start):
        random = np.random.default_rng(0).random((count, 3))
        return shapes.on_triangles(triangles, random)[0]
    lengths = np.linalg.norm(end - start, axis=-1)
    along = np.cumsum(lengths)
    positions = (np.arange(count) + 0.5) / count * along[-1]
    chosen = np.searchsorted(along, positions)
    share = (along[chosen] - positions) / lengths[chosen]
    return end[chosen] - share[:, None] * (end - start)[chosen]


def _overlap(crossings: Crossings, spacing: float) -> _Overlap:
    """Spans of rays along an axis in two bodies or more."""
    # Entries precede exits at the same place.
    order = np.lexsort(
        (
            -crossings.change,
            np.round(crossings.place, 4),
            crossings.rays[:, 1],
            crossings.rays[:, 0],
        )
    )
    winding = np.cumsum(crossings.change[order])
    points = crossings.points[order]
    start = np.flatnonzero(winding > 1.5)  # up to the next crossing
    length = (points[start + 1] - points[start])[:, crossings.axis]
    weight = (winding[start] - 1) * length * spacing**2 / 3
    middle = (points[start] + points[start + 1]) / 2
    # Rays along the axis k meet a patch in proportion to |n_k|: each crossing stands for
    # 1 / sum |n_k|.
    is_inner = np.minimum(winding, np.r_[0, winding[:-1]]) > 0.5
    inner_normals = crossings.normals[order[is_inner]]
    inner_area = float((spacing**2 / np.abs(inner_normals).sum(-1)).sum())
    return _Overlap(length, weight, middle, inner_area)


def _second_moment(inertia: np.ndarray) -> np.ndarray:
    """The integral (3, 3) of x x^T of a body with this inertia."""
    return np.trace(inertia) / 2 * np.eye(3) - inertia
