"""Visibility of a soft key light and of the sky from a surface: both are sets of distant lamps with shadow maps."""

from typing import NamedTuple

import numpy as np

from congrasp.services.viz.kernels import add_light, cover
from congrasp.services.viz.triangles import Triangles


class Lamps(NamedTuple):
    """Resolution of a soft light."""

    key: int
    """Number of lamps of the key light."""
    sky: int
    """Number of lamps of the sky."""
    grid: int
    """Samples along each side of a shadow map."""


MANY, FEW = Lamps(24, 48, 160), Lamps(12, 24, 160)
"""For bodies in large pictures, and in small ones."""
ON_TABLE = Lamps(48, 160, 64)
"""For a table top: the shadow of a high body is so wide that few lamps would show as bands."""
_KEY_SIZE = 0.12  # radius of the key light at a distance of one
_SKIN = 1.5  # height above the surface at which its light is looked up, in samples


def light_on(points: np.ndarray, normals: np.ndarray, bodies: Triangles, key: np.ndarray, lamps: Lamps) -> np.ndarray:
    """(n, 2) shares of the key light and of the sky that bodies let through to points of surfaces.

    Args:
      points: (n, 3).
      normals: (n, 3) of the surfaces there.
      bodies: bodies that cast shadows.
      key: (3,) unit direction towards the key light.
      lamps: numbers of lamps, and their resolution.
    """
    light, whole = np.zeros((2, len(points))), np.full(len(points), 1e-6)
    for lamp in _disc(key, lamps.key, _KEY_SIZE):
        _add(lamp, lamps.grid, np.full(len(points), 1 / lamps.key), points, normals, bodies, light[0])
    for lamp in _dome(lamps.sky):
        facing = np.clip(0.75 * (normals @ lamp) + 0.25, 0, None)  # a lamp represents a patch of the sky
        _add(lamp, lamps.grid, facing, points, normals, bodies, light[1])
        whole += facing
    light[1] /= whole
    return light.T


def _add(
    lamp: np.ndarray,
    grid: int,
    strength: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    bodies: Triangles,
    total: np.ndarray,
) -> None:
    """Adds the visible share of a distant lamp in direction (3,), times a strength (n,), to the points' light (n,)."""
    if not len(bodies.faces):
        total += strength
        return
    side = np.cross(lamp, [1.0, 0.0, 0.0])
    side = side / np.linalg.norm(side)
    axes = np.stack([side, np.cross(lamp, side), lamp])  # right, up, towards the lamp
    x, y, height = axes @ bodies.points.T
    sample = max(np.ptp(x), np.ptp(y)) / (grid - 3)
    # One empty sample on each side, so that points beyond the map are lit.
    left, upper = x.min() - sample, y.max() + sample
    top, owner = np.full((grid, grid), -np.inf, np.float32), np.empty((grid, grid), np.int32)
    corners = np.stack([x - left, upper - y], -1) / sample
    cover(corners, height, bodies.faces, bodies.closed, top, owner)
    lifted = points + np.float32(_SKIN * sample) * normals
    add_light(lifted, strength, axes, np.array([left, upper, sample]), sample, top, total)


def _disc(direction: np.ndarray, count: int, radius: float) -> np.ndarray:
    """(count, 3) directions around a unit direction, spread over a disc by the golden angle."""
    side = np.cross(direction, [0.0, 0.0, 1.0])
    side = side / np.linalg.norm(side)
    other = np.cross(direction, side)
    step = np.arange(count) + 0.5
    r, angle = radius * np.sqrt(step / count), step * np.pi * (3 - np.sqrt(5))
    spread = direction + (r * np.cos(angle))[:, None] * side + (r * np.sin(angle))[:, None] * other
    return spread / np.linalg.norm(spread, axis=1, keepdims=True)


def _dome(count: int) -> np.ndarray:
    """(count, 3) directions spread evenly over the upper half of the sphere."""
    step = np.arange(count) + 0.5
    z, angle = 0.08 + 0.92 * step / count, step * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], -1)
