"""Wrist paths from external motions: CSV, NPZ, and a joint of a BVH skeleton.

Results are in metres, in a world frame with the z axis up, for the wrist frame of the `human` hand:
fingers towards -y, thumb side +x, back of the hand +z.
"""

import pathlib
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.common.io.arrays import check_arrays, read_npz
from congrasp.services.grasp.bvh import read_bvh
from congrasp.services.grasp.csv_paths import MAX_MAGNITUDE, NORM_TOLERANCE, read_csv

MAX_CSV_BYTES = 32 << 20
"""Limit of the size of a CSV file."""
_Z_UP_FROM_Y_UP = Rotation.from_euler("x", 90, degrees=True)
"""Takes vectors of a BVH file's world frame, whose y axis is up, to a frame whose z axis is up."""
_BVH_UNIT = 0.01  # m
_FRAME_S = 0.01
"""Time between two frames of a CSV or NPZ file. Times in a CSV file only have to be in order."""
_AXES = {
    "+x": np.array([1.0, 0.0, 0.0]),
    "-x": np.array([-1.0, 0.0, 0.0]),
    "+y": np.array([0.0, 1.0, 0.0]),
    "-y": np.array([0.0, -1.0, 0.0]),
    "+z": np.array([0.0, 0.0, 1.0]),
    "-z": np.array([0.0, 0.0, -1.0]),
}


class WristPath(NamedTuple):
    """T frames of a wrist."""

    position: np.ndarray
    """(T, 3) m."""
    rotation: Rotation
    """T orientations of the wrist frame."""
    seconds: float
    """Time between two frames, s; 0.01 for CSV and NPZ files."""


def read_wrist_path(
    path: pathlib.Path, *, joint: str = "RightHand", fingers: str = "-y", back: str = "+z"
) -> WristPath:
    """Reads a wrist's path.

    Formats:

    * `.csv`: one line for each frame, with x, y, z in m and a quaternion w, x, y, z
    * `.npz`: arrays `position` (T, 3) in m and `quaternion` (T, 4); or a motion file of `congrasp
      grasp`, with `wrist_position` and `wrist_quaternion`
    * `.bvh`: a skeleton in cm, whose y axis is up

    Args:
      path: the file.
      joint: name of the wrist joint in a BVH file.
      fingers: axis of the file's wrist frame along which the fingers point, such as +x.
      back: axis of that frame towards the back of the hand.

    Raises:
      CongraspError: the file cannot be read or has no such joint, or the axes are unknown or not
        orthogonal.
    """
    if not path.is_file():
        raise CongraspError(f"There is no file {path}.", "Pass a CSV, NPZ or BVH file.")
    recorded = _read(path, joint)
    return recorded._replace(rotation=recorded.rotation * _file_from_hand(fingers, back))


def _read(path: pathlib.Path, joint: str) -> WristPath:
    """Returns the path in a file, with orientations of the file's own wrist frame."""
    kind = path.suffix.lower()
    if kind == ".bvh":
        position, rotation, seconds = read_bvh(path, joint)
        return WristPath(
            _Z_UP_FROM_Y_UP.apply(position * _BVH_UNIT), _Z_UP_FROM_Y_UP * rotation, seconds
        )
    if kind == ".csv":
        position, quaternion = read_csv(path, MAX_CSV_BYTES)
    elif kind == ".npz":
        position, quaternion = _read_npz(path)
    else:
        raise CongraspError(
            f"{path} is not a CSV, NPZ or BVH file.", "Convert it to one of these formats."
        )
    return WristPath(position, Rotation.from_quat(quaternion, scalar_first=True), _FRAME_S)


def _file_from_hand(fingers: str, back: str) -> Rotation:
    """Returns the rotation that takes vectors of the hand's wrist frame to the file's wrist frame.

    Args:
      fingers: axis of the file's wrist frame that is the hand's -y.
      back: axis of the file's wrist frame that is the hand's +z.

    Raises:
      CongraspError: an axis is unknown, or the axes are not orthogonal.
    """
    for name in (fingers, back):
        if name not in _AXES:
            raise CongraspError(f"'{name}' is not an axis.", f"Choose from: {', '.join(_AXES)}.")
    if _AXES[fingers] @ _AXES[back] != 0.0:
        raise CongraspError(
            f"The axis {fingers} of the fingers and the axis {back} of the back of the hand are "
            "not perpendicular.",
            "Pass two different axes of the wrist frame.",
        )
    y = -_AXES[fingers]
    z = _AXES[back]
    return Rotation.from_matrix(np.stack([np.cross(y, z), y, z], -1))


def _read_npz(path: pathlib.Path) -> tuple[np.ndarray, np.ndarray]:
    """Returns the positions (T, 3) and unit quaternions (T, 4) of an NPZ file."""
    remedy = "It needs 'position' and 'quaternion'."
    try:
        data = read_npz(path, remedy)
        is_motion_file = "wrist_position" in data
        prefix = "wrist_" if is_motion_file else ""
        # Shapes and units in the notation of `check_arrays`
        meanings = {f"{prefix}position": "(T, 3) m", f"{prefix}quaternion": "(T, 4) w x y z"}
        check_arrays(data, meanings, indices=(), largest=MAX_MAGNITUDE)
    except (KeyError, ValueError) as error:
        raise CongraspError(f"{path} cannot be read: {error}.", remedy) from None
    position, quaternion = (data[name].astype(float) for name in meanings)
    if np.abs(np.linalg.norm(quaternion, axis=-1) - 1).max() > NORM_TOLERANCE:
        raise CongraspError(
            f"{path} has quaternions whose length is not one.",
            "Write unit quaternions (w, x, y, z).",
        )
    return position, quaternion
