"""Clearance of the palm above the table; needs only NumPy."""

import math

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.request import Pose
from congrasp.services.client.arrays import as_numbers
from congrasp.services.client.fields import position_and_quaternion

_NORMAL_TOLERANCE = 1e-3  # of the length of a plane's normal
_QUATERNION_TOLERANCE = 0.02  # of the length of a measured quaternion


class Floor:
    """Clearance of the palm above a plane, as a function of the wrist joints."""

    def __init__(self, plane: np.ndarray, wrist: Pose, palm: np.ndarray):
        """Takes the poses of an episode.

        Args:
          plane: (4,) a, b, c, d, world frame: points with a x + b y + c z >= d are above; (a, b, c)
            of length 1.
          wrist: the base of the wrist joints, world frame.
          palm: see `JointLimits`.

        Raises:
          CongraspError: the wrist is not a pose, the normal is not of length 1, or a number is not
            finite.
        """
        plane = as_numbers(plane, 4)
        wrist_position, wrist_quaternion = position_and_quaternion("wrist", wrist)
        position = as_numbers(wrist_position, 3)
        quaternion = as_numbers(wrist_quaternion, 4)
        is_normal = abs(np.linalg.norm(plane[:3]) - 1.0) < _NORMAL_TOLERANCE
        is_rotation = abs(np.linalg.norm(quaternion) - 1.0) < _QUATERNION_TOLERANCE
        if not is_normal or not is_rotation:
            raise CongraspError(
                "The table's normal and the wrist's quaternion must have the length 1."
            )
        self.normal = _matrix(quaternion).T @ plane[:3]
        """(3,) normal of the plane in the frame of the base."""
        self._offset = plane[3] - plane[:3] @ position  # of the plane along the normal, m
        self._palm = palm
        if not math.isfinite(self._offset):
            raise CongraspError("The table's height and the wrist's position must be finite.")

    def clearance(self, u: np.ndarray) -> float:
        """Least distance, m, of the palm from the plane at wrist joints (6,); negative below it."""
        centres = u[:3] + self._palm[:, :3] @ _rotation(u[3:]).T  # in the frame of the base
        return float((centres @ self.normal - self._palm[:, 3]).min() - self._offset)


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    """(3, 3) rotation of a quaternion (4,), (w, x, y, z)."""
    w, x, y, z = quaternion
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def _rotation(angles: np.ndarray) -> np.ndarray:
    """(3, 3) rotation by intrinsic x-y-z angles (3,)."""
    x, y, z = (_axis_rotation(axis, angle) for axis, angle in enumerate(angles))
    return x @ y @ z


def _axis_rotation(axis: int, angle: float) -> np.ndarray:
    """(3, 3) rotation about a coordinate axis."""
    half = angle / 2
    return _matrix(np.append(np.cos(half), np.sin(half) * np.eye(3)[axis]))
