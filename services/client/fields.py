"""Fields of queries: names, conversion to arrays, checks of units; needs only NumPy."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from congrasp.common.errors import RefusedError
from congrasp.common.request import GraspRequest, Pose

NORMALS = "surface_normals"
"""Name of the normals at the points of a query."""
CAMERA = "camera_position"
"""Name of the position of the camera."""
MEASURED = ("q", "u", "object_position", "object_quaternion")
"""Fields that every state has, unless the policy has a camera."""
INITIAL_POSE = ("object_position_initial", "object_quaternion_initial")
"""Fields with the object's pose at the start of the episode, or the mean while it rests."""
WRIST_DOF = 6
"""Number of the virtual wrist joints: translations, then rotations."""
_REQUIRED = ("surface", "q", "wrist", "object_pose")
_REQUIRED_WITH_CAMERA = ("cloud", "q", "wrist")
_MAX_SPREAD_M = 1.0  # median deviation of points from their median
_MAX_ANGLE_RAD = 2 * math.pi
_ANGLES = re.compile(r"(?:\w+_)?q(?:_initial|_target)?|u")
"""Names of fields with angles; those of `u` are its last three numbers."""


def require(names: Sequence[str], fields: Mapping[str, Any]) -> None:
    """Raises a RefusedError for the first field that is absent."""
    lacking = [name for name in names if name not in fields]
    if lacking:
        raise RefusedError(f"The query lacks the field '{lacking[0]}'.")


def as_numbers(name: str, value: Any) -> np.ndarray:
    """Returns a field's value as an array, unchanged if it is bool, else as float32.

    Raises:
      RefusedError: the value is not a numeric array.
    """
    try:
        array = np.asarray(value)
        return array if array.dtype == bool else array.astype(np.float32)
    except (TypeError, ValueError):
        raise RefusedError(f"The field '{name}' is not a numeric array.") from None


def checked(values: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Returns fields as arrays, in metres and radians.

    Raises:
      RefusedError: a field is not a numeric array, or is in mm, cm or degrees.
    """
    fields = {name: as_numbers(name, value) for name, value in values.items()}
    # The policy itself refuses numbers that are not finite.
    with np.errstate(invalid="ignore"):
        for name in ("surface_points", "cloud"):
            _check_metres(name, fields.get(name))
        for name, field in fields.items():
            _check_radians(name, field)
    return fields


def _check_metres(name: str, points: np.ndarray | None) -> None:
    """Raises a RefusedError for points in mm or cm, by their median."""
    if points is None or points.ndim != 2 or not points.size:
        return
    spread = np.median(np.abs(points - np.median(points, 0)))
    if spread > _MAX_SPREAD_M:
        raise RefusedError(
            f"The median extent of the field '{name}' would be {spread:.3g} m.",
            "Give it in metres.",
        )


def _check_radians(name: str, field: np.ndarray) -> None:
    """Raises a RefusedError for angles in degrees."""
    if not _ANGLES.fullmatch(name):
        return
    angles = field.ravel()
    if name == "u":
        angles = angles[3:]
    largest = np.abs(angles).max(initial=0.0)
    if _MAX_ANGLE_RAD < largest < math.inf:
        raise RefusedError(
            f"The field '{name}' has an angle of {largest:.4g}.", "Give it in radians."
        )


def episode_fields(request: GraspRequest) -> dict[str, np.ndarray]:
    """Returns the constant fields of an episode's queries, and the first targets.

    Raises:
      RefusedError: the request lacks a required field, or a field is not a numeric array.
    """
    required = _REQUIRED if request.cloud is None else _REQUIRED_WITH_CAMERA
    lacking = [f"'{name}'" for name in required if getattr(request, name) is None]
    if lacking or request.wrist is None:
        raise RefusedError(
            f"The request lacks {' and '.join(lacking)}.",
            "Pass the measured values to GraspRequest.",
        )
    if request.above:
        raise RefusedError(
            "The request has the option `above`, which a control loop does not support.",
            "Pass an explicit direction of the heading.",
        )
    base_position, base_quaternion = position_and_quaternion("wrist", request.wrist)
    position, quaternion = position_and_quaternion("object_pose", request.object_pose)
    values = {
        "q_initial": request.q,
        "q_target": request.q,
        "u_target": np.zeros(WRIST_DOF),
        "base_position": base_position,
        "base_quaternion": base_quaternion,
        "object_position_initial": position,
        "object_quaternion_initial": quaternion,
        "cloud": request.cloud,
        "surface_points": request.surface,
        "surface_avoid": request.avoid,
        "surface_normals": request.normals,
        "camera_position": request.camera,
    }
    return checked({name: value for name, value in values.items() if value is not None})


def position_and_quaternion(name: str, pose: Pose | None) -> tuple[Any, Any]:
    """Returns position and quaternion of the pose in a request's field `name`; None for both if
    there is no pose.

    Raises:
      RefusedError: the pose is not a pair.
    """
    if pose is None:
        return None, None
    try:
        position, quaternion = pose
    except (TypeError, ValueError):
        raise RefusedError(f"'{name}' must be a (position, quaternion) pair.") from None
    return position, quaternion
