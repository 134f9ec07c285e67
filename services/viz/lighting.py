"""Soft light on surfaces: the key light and the sky are sets of distant lamps with shadow maps."""

from typing import NamedTuple

import numpy as np

from congrasp.services.viz.kernels import Bodies, light_of
from congrasp.services.viz.triangles import Triangles

_KEY_RADIUS = 0.12
"""Radius of the key light at a distance of one."""
_KEY_FACING = (0.0, 1.0)
_SKY_FACING = (0.75, 0.25)
"""Strength of their lamps, see `light_of`; a lamp of the sky represents a patch of it."""
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
    if not len(bodies.faces):
        return np.ones((len(points), 2))
    casting = Bodies(bodies.points, bodies.faces, bodies.closed)
    disc = _axes(_disc(key, lamps.key, _KEY_RADIUS))
    dome = _axes(_dome(lamps.sky))
    from_key = light_of(disc, _KEY_FACING, points, normals, casting, lamps.grid)
    from_sky = light_of(dome, _SKY_FACING, points, normals, casting, lamps.grid)
    return np.stack([from_key, from_sky], axis=-1)


def _axes(lamps: np.ndarray) -> np.ndarray:
    """(L, 3, 3) rows: right and up of lamps, and the unit directions (L, 3) towards them."""
    right = np.cross(lamps, [1.0, 0.0, 0.0])
    right = right / np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(lamps, right), lamps], axis=1)


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
