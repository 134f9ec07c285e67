"""Cubes that tile the space in and around a closed mesh."""

from typing import NamedTuple

import numpy as np

from congrasp.common.objects import shapes
from congrasp.services.assets.objects.rays import (
    OFF_GRID,
    Crossings,
    RayGrid,
    cast_rays,
    intervals,
)

_SURFACE_SAMPLES = 100_000
"""Points whose cubes are inside if the rays miss a body."""


class Voxels(NamedTuple):
    """Cubes that tile the space in and around a closed mesh."""

    inside: np.ndarray
    """(X, Y, Z) bool; a wall thinner than a cube is a layer without holes, too."""
    low: np.ndarray
    """(3,) center of the first cube, m."""
    spacing: float
    """m."""

    def at(self, points: np.ndarray) -> tuple[np.ndarray, ...]:
        """Returns indices of the cubes around points (N, 3); outside of the grid the nearest."""
        nearest = np.rint((points - self.low) / self.spacing).astype(int)
        return tuple(np.clip(nearest, 0, np.array(self.inside.shape) - 1).T)


def voxels(triangles: np.ndarray, margin: float, count: int = 128) -> Voxels:
    """Returns cubes of the space inside a closed mesh, and outside up to a margin.

    Args:
      triangles: (F, 3, 3) corners, which wind outwards, m.
      margin: m.
      count: cubes along the longest side.
    """
    corners = triangles.reshape(-1, 3)
    spacing = float(np.ptp(corners, axis=0).max()) / count
    edge = int(np.ceil(margin / spacing)) + 1
    low = corners.min(0) - edge * spacing
    shape = np.ceil(np.ptp(corners, axis=0) / spacing).astype(int) + 2 * edge + 2
    inside = np.zeros(shape, bool)
    for crossings in cast_rays(triangles, RayGrid(low, spacing)):
        inside |= _inside_along(crossings, shape)
    cubes = Voxels(inside, low - OFF_GRID * spacing, spacing)
    if not inside.any():
        random = np.random.default_rng(0).random((_SURFACE_SAMPLES, 3))
        points = shapes.on_triangles(triangles, random)[0]
        inside[cubes.at(points)] = True
    return cubes


def _inside_along(crossings: Crossings, shape: np.ndarray) -> np.ndarray:
    """Cubes (X, Y, Z) bool of a grid of this shape (3,) that are inside, by rays along an axis."""
    entries, exits, _ = intervals(crossings, 0.0)
    shift = OFF_GRID[crossings.axis]
    start = np.ceil(crossings.place[entries] + shift).astype(int)
    end = np.ceil(crossings.place[exits] + shift).astype(int)
    order = np.roll(range(3), 2 - crossings.axis)  # the rays' axis is the last
    steps = np.zeros(shape[order], np.int8)
    rows = crossings.rays[entries].T
    np.add.at(steps, (*rows, start), 1)
    np.add.at(steps, (*rows, np.maximum(end, start + 1)), -1)
    filled = np.cumsum(steps, -1, dtype=np.int8) > 0
    return np.moveaxis(filled, [0, 1, 2], order)
