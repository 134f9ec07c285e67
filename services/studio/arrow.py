"""The drawn heading: an arrow in the object frame, and the roll of the hand around it."""

from typing import Any, NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.objects.shapes import matrix
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.sampling.headings import INWARD

LARGEST = 1e6
"""Bound on each number of a position (m) or direction from a page; its square is finite in single precision."""
_ROUND = 1e-6  # rad
_LOWEST = 0.012  # m above the table of a target from above


class Arrow(NamedTuple):
    """A heading in the object frame."""

    position: np.ndarray
    """(3,) target of the middle of the grasping hand, m."""
    direction: np.ndarray
    """(3,) unit, direction of the approach."""
    cross: np.ndarray
    """(3,) unit, orthogonal to the direction: along the hand's cross-finger axis."""

    def roll(self, up: np.ndarray) -> float:
        """Angle in rad, in (-π, π], by which the cross-finger axis is turned around the direction from level.

        Args:
          up: (3,) unit, away from the table.
        """
        level = _level(self.direction, up)
        other = np.cross(self.direction, level)
        angle = float(np.arctan2(self.cross @ other, self.cross @ level))
        return angle if angle > _ROUND - np.pi else np.pi  # -π and π are one angle, whose sign rounding would decide

    def with_roll(self, angle: float, up: np.ndarray) -> "Arrow":
        """The arrow with a roll of `angle` rad; see `roll`."""
        level = _level(self.direction, up)
        return self._replace(cross=np.cos(angle) * level + np.sin(angle) * np.cross(self.direction, level))


def arrow_of(position: Any, direction: Any, cross: Any) -> Arrow:
    """An arrow from values that a user sets.

    Args:
      position: (3,) target in the object frame, m.
      direction: (3,) of any length above zero.
      cross: (3,) cross-finger axis; made orthogonal to the direction.

    Raises:
      CongraspError: a value is not three numbers within `LARGEST`, or the direction is zero.
    """
    position, direction = vector("arrow's position", position), vector("arrow's direction", direction)
    length = np.linalg.norm(direction)
    if length < 1e-6:
        raise CongraspError("The arrow has no direction.", "Drag its tail away from its tip.")
    direction = direction / length
    return Arrow(position, direction, _orthogonal(vector("arrow's roll", cross), direction))


def from_above(obj: GraspObject, rest: int) -> Arrow:
    """The arrow straight down onto an object in a resting pose, with the cross-finger axis along its narrower side."""
    turn = matrix(obj.rest_poses[rest][3:])
    world = obj.points @ turn.T
    near = np.linalg.norm(world[:, :2] - (world[:, :2].max(0) + world[:, :2].min(0)) / 2, axis=-1)
    top = world[near.argsort()[: len(world) // 8], 2].max()
    middle = (world.max(0) + world.min(0)) / 2
    narrow = np.eye(3)[int(np.ptp(world[:, :2], axis=0).argmin())]
    height = max(top - INWARD, world[:, 2].min() + _LOWEST)
    target = np.array([middle[0], middle[1], height])
    return Arrow(target @ turn, np.array([0.0, 0.0, -1.0]) @ turn, narrow @ turn)


def vector(what: str, value: Any) -> np.ndarray:
    """(3,) finite numbers within `LARGEST`; raises a CongraspError for others."""
    try:
        found = np.asarray(value, float)
    except (TypeError, ValueError):
        found = np.zeros(0)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise CongraspError(f"The {what} must be three numbers, not {ascii(value)[:60]}.")
    if np.abs(found).max() > LARGEST:
        raise CongraspError(f"The {what} must be within {LARGEST:g} of zero.")
    return found


def _level(direction: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(3,) unit, orthogonal to a direction and parallel to the table; for a vertical one, any such."""
    level = np.cross(up, direction)
    length = np.linalg.norm(level)
    return level / length if length > 1e-3 else _orthogonal(np.eye(3)[np.abs(up).argmin()], direction)


def _orthogonal(wanted: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """(3,) unit, the part of a vector that is orthogonal to a direction; any orthogonal one if that part vanishes."""
    cross = wanted - wanted @ direction * direction
    if np.linalg.norm(cross) < 1e-3:
        cross = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    return cross / np.linalg.norm(cross)
