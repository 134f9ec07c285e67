"""A plane below the palm of a hand; needs only NumPy."""

import math

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.request import Pose
from congrasp.services.client.limits import as_numbers


class Floor:
    """Clearance of the palm above a plane, as a function of the wrist joints."""

    def __init__(self, plane: np.ndarray, wrist: Pose, palm: np.ndarray):
        """Takes the poses of an episode.

        Args:
          plane: (4,) a, b, c, d, world frame: points with a x + b y + c z >= d are above; (a, b, c) of length 1.
          wrist: the base of the wrist joints, world frame.
          palm: see `JointLimits`.

        Raises:
          CongraspError: the normal is not of length 1, or a number is not finite.
        """
        plane, position, quaternion = (as_numbers(x, n) for x, n in ((plane, 4), (wrist[0], 3), (wrist[1], 4)))
        if not abs(np.linalg.norm(plane[:3]) - 1.0) < 1e-3 or not abs(np.linalg.norm(quaternion) - 1.0) < 0.02:
            raise CongraspError("The table's normal and the wrist's quaternion must have the length 1.")
        self.normal = _matrix(quaternion).T @ plane[:3]
        """(3,) normal of the plane in the frame of the base."""
        self._offset, self._palm = plane[3] - plane[:3] @ position, palm
        if not math.isfinite(self._offset):
            raise CongraspError("The table's height and the wrist's position must be finite.")

    def clearance(self, u: np.ndarray) -> float:
        """Least distance, m, of the palm from the plane at wrist joints (6,); negative below it."""
        places = u[:3] + self._palm[:, :3] @ _turned(u[3:]).T
        return float((places @ self.normal - self._palm[:, 3]).min() - self._offset)


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    """(3, 3) rotation of a quaternion (4,), (w, x, y, z)."""
    w, (x, y, z) = quaternion[0], quaternion[1:]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def _turned(angles: np.ndarray) -> np.ndarray:
    """(3, 3) rotation by intrinsic x-y-z angles (3,)."""
    turns = (np.append(np.cos(half := angle / 2), np.sin(half) * np.eye(3)[axis]) for axis, angle in enumerate(angles))
    x, y, z = map(_matrix, turns)
    return x @ y @ z
