"""Context of a constraint's option, and conversions from the frame of the object's file."""

from typing import NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.services.assets.objects.mesh_files import upright

_MAX_DISTANCE = 1.0
"""Largest distance from an object, m; places beyond it have another unit or origin."""


class Target(NamedTuple):
    """Context of an option: its name, the hand and the object."""

    name: str
    obj: GraspObject
    hand: Hand
    waypoints: int
    """K, of wrist trajectories."""

    def placed(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3), m, of the axes and origin of the object's file in the object frame."""
        return upright(points, self.obj.file_up) + self.obj.origin

    def turned(self, quaternions: np.ndarray) -> np.ndarray:
        """Orientations (..., 4) in the axes of the object's file in the object frame."""
        if self.obj.file_up == "z":
            return quaternions
        w, x, y, z = np.moveaxis(np.asarray(quaternions) / np.sqrt(2), -1, 0)
        return np.stack([w - x, x + w, y - z, z + y], -1)  # after a quarter turn about x

    def check_near(self, position: np.ndarray, what: str) -> None:
        """Raises a CongraspError if a place (3,), object frame, is so far away that its unit must
        be wrong.
        """
        with np.errstate(over="ignore"):
            away = float(np.linalg.norm(self.obj.points - position, axis=-1).min())
        if away > _MAX_DISTANCE:
            remedy = "Pass metres, in the coordinates of the object's file."
            raise CongraspError(f"{what} is {away:.3g} m away from '{self.obj.name}'.", remedy)


def unit_vector(vector: np.ndarray, name: str) -> np.ndarray:
    """The normalised vector."""
    largest = np.abs(vector).max()
    if largest < 1e-9:
        raise CongraspError(
            f"{name} has no direction: all its numbers are zero.",
            'Pass a direction, such as "0 0 -1".',
        )
    return vector / largest / np.linalg.norm(vector / largest)
