"""Soft light on surfaces: the key light and the sky are sets of distant lamps with shadow maps."""

from typing import NamedTuple

import numpy as np

from congrasp.services.viz.kernels import add_light, cover
from congrasp.services.viz.triangles import Triangles

_KEY_RADIUS = 0.12
"""Radius of the key light at a distance of one."""
_LIFT_SAMPLES = 1.5
"""Height above the surface at which its light is looked up, in samples of the shadow map."""
_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
_LOWEST_SKY = 0.08
"""Height of the lowest lamps of the sky, as the sine of their elevation."""


class Lamps(NamedTuple):
    """Resolution of a soft light."""

    key: int
    """Number of lamps of the key light."""
    sky: int
    """Number of lamps of the sky."""
    grid: int
    """Samples along each side of a shadow map."""


MANY = Lamps(24, 48, 160)
"""For bodies in large pictures."""
FEW = Lamps(12, 24, 160)
"""For bodies in small pictures."""
ON_TABLE = Lamps(48, 160, 64)
"""For a table top: the shadow of a high body is so wide that few lamps would show as bands."""


def light_on(
    points: np.ndarray, normals: np.ndarray, bodies: Triangles, key: np.ndarray, lamps: Lamps
) -> np.ndarray:
    """Shares of the key light and of the sky that reach points of surfaces past the bodies.

    Args:
      points: (n, 3).
      normals: (n, 3) of the surfaces there.
      bodies: bodies that cast shadows.
      key: (3,) unit direction towards the key light.
      lamps: numbers of lamps, and their resolution.

    Returns:
      (n, 2) key light and sky, from 0 to 1.
    """
    count = len(points)
    light = np.zeros((2, count))
    even = np.full(count, 1 / lamps.key)
    for lamp in _disc(key, lamps.key, _KEY_RADIUS):
        light[0] += _lamp_light(lamp, lamps.grid, even, points, normals, bodies)
    unshadowed = np.full(count, 1e-6)
    for lamp in _dome(lamps.sky):
        # A lamp represents a patch of the sky
        facing = np.clip(0.75 * (normals @ lamp) + 0.25, 0, None)
        light[1] += _lamp_light(lamp, lamps.grid, facing, points, normals, bodies)
        unshadowed += facing
    light[1] /= unshadowed
    return light.T


def _lamp_light(
    lamp: np.ndarray,
    grid: int,
    strength: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    bodies: Triangles,
) -> np.ndarray:
    """(n,) light of a distant lamp on points (n, 3).

    Args:
      lamp: (3,) unit direction towards the lamp.
      grid: samples along each side of its shadow map.
      strength: (n,) its light without shadow.
      points: (n, 3).
      normals: (n, 3) of the surfaces there.
      bodies: bodies that cast shadows.
    """
    if not len(bodies.faces):
        return strength
    right = np.cross(lamp, [1.0, 0.0, 0.0])
    right = right / np.linalg.norm(right)
    axes = np.stack([right, np.cross(lamp, right), lamp])  # right, up, towards the lamp
    x, y, height = axes @ bodies.points.T
    sample = max(np.ptp(x), np.ptp(y)) / (grid - 3)
    # One empty sample on each side, so that points beyond the map are lit.
    left = x.min() - sample
    upper = y.max() + sample
    top = np.full((grid, grid), -np.inf, np.float32)
    owner = np.empty((grid, grid), np.int32)
    corners = np.stack([x - left, upper - y], -1) / sample
    cover(corners, height, bodies.faces, bodies.closed, top, owner)
    lifted = points + np.float32(_LIFT_SAMPLES * sample) * normals
    light = np.zeros(len(points))
    add_light(lifted, strength, axes, np.array([left, upper, sample]), sample, top, light)
    return light


def _disc(direction: np.ndarray, count: int, radius: float) -> np.ndarray:
    """(count, 3) directions around a unit direction, spread over a disc by the golden angle."""
    side = np.cross(direction, [0.0, 0.0, 1.0])
    side = side / np.linalg.norm(side)
    other = np.cross(direction, side)
    step = np.arange(count) + 0.5
    r = radius * np.sqrt(step / count)
    angle = step * _GOLDEN_ANGLE
    offset = (r * np.cos(angle))[:, None] * side + (r * np.sin(angle))[:, None] * other
    spread = direction + offset
    return np.asarray(spread / np.linalg.norm(spread, axis=1, keepdims=True))


def _dome(count: int) -> np.ndarray:
    """(count, 3) directions spread evenly over the upper half of the sphere."""
    step = np.arange(count) + 0.5
    z = _LOWEST_SKY + (1 - _LOWEST_SKY) * step / count
    angle = step * _GOLDEN_ANGLE
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], -1)
