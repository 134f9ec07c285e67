"""Pinhole cameras: their axes, their key light, and the nearest one that sees some points."""

import dataclasses

import numpy as np

_KEY_LIGHT = np.array([-0.45, -0.55, 1.0])
"""Direction towards the key light: to the camera's right, away from the camera, up."""
FIELD_OF_VIEW = 26.0
"""Field of view of the cameras of `fit`, degrees."""
_FREE_SPACE = 1.06
"""Factor on the extent of the points, which leaves free space at the edges of the picture."""
_FIT_ROUNDS = 8
"""Rounds of `fit`; they converge to a fraction of a pixel."""


@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole camera at `position` that looks at `target`, both (3,) in the world frame; z is
    up.
    """

    position: np.ndarray
    target: np.ndarray
    field_of_view: float = 30.0
    """Degrees from the lower to the upper edge of the picture."""

    def axes(self) -> np.ndarray:
        """(3, 3) rows: right, up and forward."""
        forward = np.subtract(self.target, self.position)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(right, forward), forward])

    def key_light(self) -> np.ndarray:
        """(3,) unit direction towards the key light, which stays at the camera's left."""
        right = self.axes()[0]
        key = _KEY_LIGHT @ np.stack([right, np.cross([0.0, 0.0, 1.0], right), [0.0, 0.0, 1.0]])
        return key / np.linalg.norm(key)


def fit(points: np.ndarray, direction: np.ndarray, aspect: float) -> Camera:
    """The nearest camera that sees all points (N, 3).

    Args:
      points: (N, 3) m, world frame.
      direction: (3,) from the points to the camera.
      aspect: width of the picture over its height.
    """
    across, up = tangents(aspect)
    direction = np.asarray(direction, float) / np.linalg.norm(direction)
    target = (points.min(0) + points.max(0)) / 2
    axes = Camera(target + direction, target).axes()
    distance = 1.0
    # Distance and centre in turn
    for _ in range(_FIT_ROUNDS):
        x, y, z = axes @ (points - target).T
        distance = max((np.abs(x) / across - z).max(), (np.abs(y) / up - z).max())
        sides = np.stack([x, y]) / (distance + z)
        target = target + distance * (sides.max(1) + sides.min(1)) / 2 @ axes[:2]
    return Camera(target + distance * direction, target, FIELD_OF_VIEW)


def tangents(aspect: float) -> tuple[float, float]:
    """Half width and half height of a picture at a distance of one, without its free space."""
    half_height = float(np.tan(np.radians(FIELD_OF_VIEW) / 2)) / _FREE_SPACE
    return half_height * aspect, half_height
