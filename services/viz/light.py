"""How much of a soft lamp and of the sky reaches a surface: both are many lamps, from each of which bodies are seen."""

import numpy as np

from services.viz.spans import spans
from services.viz.triangles import Triangles

MANY, FEW = (24, 48), (10, 20)
"""Lamps of the key light and of the sky: for large pictures, and for small ones and videos."""
_KEY_SIZE = 0.12  # radius of the key light at a distance of one
_GRID = 160  # samples along each side of what a lamp sees
_SKIN = 1.5  # how far above the surface its light is looked up, in samples


def light_on(
    points: np.ndarray, normals: np.ndarray, bodies: Triangles, key: np.ndarray, lamps: tuple[int, int]
) -> np.ndarray:
    """(n, 2) shares of the key light and of the sky that bodies let through to points of surfaces.

    Args:
      points: (n, 3).
      normals: (n, 3) of the surfaces there.
      bodies: what casts shadows.
      key: (3,) unit direction towards the key light.
      lamps: how many stand for the key light and for the sky.
    """
    light = np.zeros((len(points), 2), np.float32)
    for lamp in _disc(key, lamps[0], _KEY_SIZE).astype(np.float32):
        light[:, 0] += _reached(points, normals, bodies, lamp) / np.float32(lamps[0])
    whole = np.full(len(points), 1e-6, np.float32)
    for lamp in _dome(lamps[1]).astype(np.float32):
        facing = np.clip(0.75 * (normals @ lamp) + 0.25, 0, None)  # a lamp of the sky stands for a patch of it
        light[:, 1] += facing * _reached(points, normals, bodies, lamp)
        whole += facing
    light[:, 1] /= whole
    return light


def _reached(points: np.ndarray, normals: np.ndarray, bodies: Triangles, lamp: np.ndarray) -> np.ndarray:
    """(n,) shares of a far lamp in the direction (3,) that bodies let through to points (n, 3) with normals (n, 3).

    The four samples of the lamp's picture around a point are compared with it and mixed by how near they are, so that
    a shadow's edge is a sample wide.
    """
    if not len(bodies.faces):
        return np.ones(len(points), np.float32)
    side = np.cross(lamp, [1.0, 0.0, 0.0])
    side = side / np.linalg.norm(side)
    axes = np.stack([side, np.cross(lamp, side), lamp]).astype(np.float32)  # right, up, towards the lamp
    local = bodies.points @ axes.T
    low, high = local.min(0), local.max(0)
    sample = (high - low)[:2].max() / (_GRID - 3)
    corners = bodies.faces.T
    # One empty sample on each side: what is beyond the picture is in the light.
    x, y = ((local[:, 0] - low[0]) / sample + 1)[corners], ((high[1] - local[:, 1]) / sample + 1)[corners]
    seen = spans(x, y, bodies.closed, _GRID, _GRID)
    top = np.full(_GRID**2, -np.inf, np.float32)
    np.maximum.at(top, seen.sample, seen.scaled(local[:, 2][corners]).total())
    x, y, height = ((points + _SKIN * sample * normals) @ axes.T).T
    column = ((x - low[0]) / sample + 1).clip(0, _GRID - 1.001)
    row = ((high[1] - y) / sample + 1).clip(0, _GRID - 1.001)
    first = row.astype(np.int64) * _GRID + column.astype(np.int64)
    right, below = column % 1, row % 1
    height = height + sample
    upper, lower = (
        (1 - right) * (top[first + step] <= height) + right * (top[first + step + 1] <= height) for step in (0, _GRID)
    )
    return (1 - below) * upper + below * lower


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
