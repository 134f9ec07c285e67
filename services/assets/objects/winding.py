"""Space that an open mesh encloses, by generalised winding numbers.

The winding number of a point is the share of directions in which a ray from it leaves the mesh more
often than it enters it: 1 inside of a closed mesh, 0 outside, and in between near a hole. A plane
hole is closed by its plane, where the number is 1/2. It is the mean over the 26 directions of
Lebedev's quadrature of degree 7 (Jacobson et al. 2013; Lebedev 1976). On a lattice these are the
directions to the neighbours of a point: one ray gives the crossings of all the points on it.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_erosion
from scipy.spatial import cKDTree

from congrasp.common.objects import shapes
from congrasp.services.assets.objects.hollows import MAX_OPENING_M
from congrasp.services.assets.objects.rays import OFF_GRID, line_crossings

_LATTICE_POINTS = 96
"""Points of the lattice along the longest side."""
_MARGIN_POINTS = 2
"""Points of the lattice outside of the mesh on each side."""
_WEIGHTS = {1: 1 / 21, 2: 4 / 105, 3: 9 / 280}
"""Weights of directions with one, two and three coordinates that are not zero."""
_SURFACE_SAMPLES = 100_000
"""Points of the surface from which the distance of the boundary is computed."""


class WindingNumbers(NamedTuple):
    """Winding numbers at the points of a lattice."""

    number: np.ndarray
    """(X, Y, Z) winding numbers."""
    low: np.ndarray
    """(3,) first point, m."""
    spacing: float
    """Distance of neighbouring points along an axis, m."""


class _Direction(NamedTuple):
    """A direction on the lattice, and its opposite."""

    axis: int
    """Last axis along which the direction has a coordinate other than zero; there it is 1."""
    steps: tuple[int, int]
    """Coordinates (-1, 0 or 1) along the two axes that follow `axis` in cyclic order."""
    weight: float
    """Weight of the direction in the mean."""


def open_volume(triangles: np.ndarray) -> float | None:
    """Returns the volume that an open mesh encloses, m^3.

    Args:
      triangles: (F, 3, 3) corners, which wind outwards, m.

    Returns:
      The volume where the winding number is above 1/2; None without any, or if an opening is wider
      than `MAX_OPENING_M`, as that of a sheet.
    """
    winding = winding_numbers(triangles)
    inside = winding.number > 0.5
    if not inside.any():
        return None
    boundary = inside & ~binary_erosion(inside)
    points = winding.low + winding.spacing * np.argwhere(boundary)
    random = np.random.default_rng(0).random((_SURFACE_SAMPLES, 3))
    samples = shapes.on_triangles(triangles, random)[0]
    distances = cKDTree(samples).query(points)[0]
    if distances.max() > MAX_OPENING_M / 2 + winding.spacing:
        return None
    return float(inside.sum()) * winding.spacing**3


def winding_numbers(triangles: np.ndarray, count: int = _LATTICE_POINTS) -> WindingNumbers:
    """Returns winding numbers of points in and around a mesh.

    Args:
      triangles: (F, 3, 3) corners, which wind outwards, m.
      count: points along the longest side.
    """
    corners = triangles.reshape(-1, 3)
    spacing = float(np.ptp(corners, axis=0).max()) / count
    low = corners.min(0) - _MARGIN_POINTS * spacing
    shape = np.ceil(np.ptp(corners, axis=0) / spacing).astype(int) + 2 * _MARGIN_POINTS + 2
    on_lattice = (triangles - low) / spacing + OFF_GRID
    number = np.zeros(shape)
    for direction in _directions():
        number += direction.weight * _both_ways(on_lattice, shape, direction)
    return WindingNumbers(number, low - OFF_GRID * spacing, spacing)


def _directions() -> Iterator[_Direction]:
    """Yields one direction of each of the 13 opposite pairs."""
    for axis, free in enumerate([(0, 0), (0, 1), (1, 1)]):
        after, before = free
        for first in range(-after, after + 1):
            for second in range(-before, before + 1):
                weight = _WEIGHTS[1 + abs(first) + abs(second)]
                yield _Direction(axis, (first, second), weight)


def _both_ways(on_lattice: np.ndarray, shape: np.ndarray, direction: _Direction) -> np.ndarray:
    """Sum of the winding numbers (X, Y, Z) by the rays along a direction and its opposite.

    The mesh is sheared so that the rays are parallel to an axis; points of the lattice remain on
    the lattice.

    Args:
      on_lattice: (F, 3, 3) corners; the points of the lattice are the integers.
      shape: (3,) of the lattice.
      direction: the direction.
    """
    order = np.roll(range(3), 2 - direction.axis)  # the rays' axis is the last
    steps = np.array(direction.steps)
    sheared = on_lattice[..., order].copy()
    sheared[..., :2] -= steps * sheared[..., 2:]
    rays, place, change = line_crossings(sheared)
    depth = shape[order[2]]
    offset = np.maximum(steps, 0) * (depth - 1)
    widths = shape[order[:2]] + np.abs(steps) * (depth - 1)
    entered = np.zeros((*widths, depth + 1), np.int16)
    first = rays + offset
    np.add.at(entered, (first[:, 0], first[:, 1], np.ceil(place).astype(int)), change)
    np.cumsum(entered, axis=-1, out=entered)
    i, j, k = np.ogrid[tuple(slice(size) for size in shape[order])]
    ray = (i - steps[0] * k + offset[0], j - steps[1] * k + offset[1])
    both = 2 * entered[*ray, k] - entered[*ray, depth]
    return np.moveaxis(both, [0, 1, 2], order)
