"""Reflection at the plane x = 0, of the world and of every frame in it; needs nothing but numpy.

A left hand is the mirror image of a right one, and so is everything that it does: a policy of the
right hand grasps the mirrored object under mirrored constraints, and the mirror image of its motion
is that of the left hand. Joint angles are unchanged, because joint axes are mirrored as axes of
rotation.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

_VECTORS = (
    "position",
    "direction",
    "cross",
    "velocity",
    "force",
    "points",
    "cloud",
    "vertices",
    "normals",
    "pos",
)
_WRIST = ("u", "u_target", "u_velocity")


def vector(array: Any) -> np.ndarray:
    """Mirrored positions, directions or forces (..., 3)."""
    return np.asarray(array) * np.array([-1, 1, 1], np.int8)


def axial(array: Any) -> np.ndarray:
    """Mirrored axes of rotation or angular velocities (..., 3)."""
    return np.asarray(array) * np.array([1, -1, -1], np.int8)


def quaternion(array: Any) -> np.ndarray:
    """Mirrored rotations (..., 4), (w, x, y, z)."""
    return np.asarray(array) * np.array([1, 1, -1, -1], np.int8)


def wrist(array: Any) -> np.ndarray:
    """Mirrored wrist joints in the last six places (..., 6 or more): x, y, z, then intrinsic x-y-z
    angles.
    """
    array = np.asarray(array)
    return np.concatenate([array[..., :-6], vector(array[..., -6:-3]), axial(array[..., -3:])], -1)


def fields(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Mirrored arrays of a state, a goal or an episode, each by the last words of its name."""
    return {name: _field(name, array) for name, array in arrays.items()}


def _field(name: str, array: Any) -> Any:
    """One mirrored array."""
    last = name.rpartition("/")[2]
    if last in _WRIST or last == "action":
        return wrist(array)
    if last.endswith("_faces"):
        return np.asarray(array)[..., ::-1]
    if last.endswith("angular_velocity"):
        return axial(array)
    if "quaternion" in last or last.endswith("_quat"):
        return quaternion(array)
    kind = last.removesuffix("_initial").rpartition("_")[2]
    is_vector = kind in _VECTORS and last != "q_velocity"
    if is_vector and np.shape(array)[-1:] == (3,):
        return vector(array)
    return array
