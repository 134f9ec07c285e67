"""MyoDM's reference motions (MyoSuite): NPZ files with the joints of MyoHand, and an object's pose.

`time (T,)` s; `robot (T, 29)`: three slides (m), three hinges, pronation, deviation and wrist
flexion, then the twenty finger joints in the order of the `human` hand (rad); `object (T, 7)`:
position (m) and quaternion (w, x, y, z). A file is named `MyoHand_<object>_<action>.npz`. The arm
is MyoHand's at its table (Apache-2.0, MyoHub): slides and hinges move a base in front of the table.
Shoulder and elbow do not bend, so that only pronation, deviation and flexion move the wrist in the
base. The object's slides are relative to a point above the table's centre.
"""

import pathlib
from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.hands.mano import ManoModel
from congrasp.common.io.arrays import runs_back
from congrasp.common.io.pickles import read_archive
from congrasp.services.assets.captures.human import joint_positions
from congrasp.services.assets.captures.sequence import (
    Dropped,
    Meshes,
    Sequence,
    frames_of,
    is_unit,
    read_or_drop,
    with_gaps_filled,
)

HOLDS = "MyoHand_<object>_<action>.npz"
_BASE = np.array([0.1, -0.55, 0.32])
"""Position of MyoHand's base, m, world frame."""
_ELBOW = np.array([0.002797970, 0.304212085, -0.000513865])
"""Origin of the forearm, m, in the base."""
_FOREARM = Rotation.from_quat(
    [0.000281544, 0.707106501, -0.000281544, 0.707106949], scalar_first=True
)
"""Orientation of the forearm in the base at a pronation of 0."""
_PRONATION = np.array([-0.017161, 0.992666, -0.119668])
"""Axis of the pronation in the forearm; its length is about 1."""
_WRIST = np.array([0.018, -0.242, 0.025])
"""Position of the wrist, m, in the forearm."""
_OBJECT = np.array([0.0, 0.0, 0.035])
"""Position of the object, m, world frame, while its slides are zero."""
_MAX_ANGLE_RAD = 2 * np.pi


def read(
    path: pathlib.Path, meshes: Meshes, model: ManoModel | None = None
) -> Iterator[Sequence | Dropped]:
    """Yields the sequences of a file, or of all NPZ files of a folder; MANO is not used."""
    for file in sorted(path.glob("**/*.npz")) if path.is_dir() else [path]:
        yield read_or_drop(file.stem, _sequence, file, meshes)


def wrist_pose(arm_joints: np.ndarray) -> tuple[np.ndarray, Rotation]:
    """World positions (T, 3), m, and orientations of the wrist.

    Args:
      arm_joints: (T, 9) slides (m), hinges, pronation, deviation and flexion (rad).
    """
    arm = Rotation.from_euler("XYZ", arm_joints[:, 3:6])
    axis = _PRONATION / np.linalg.norm(_PRONATION)
    forearm = arm * _FOREARM * Rotation.from_rotvec(arm_joints[:, 6:7] * axis)
    wrist = (
        forearm
        * Rotation.from_rotvec(arm_joints[:, 7:8] * [0, 0, 1])
        * Rotation.from_rotvec(arm_joints[:, 8:9] * [1, 0, 0])
    )
    return _BASE + arm_joints[:, :3] + arm.apply(_ELBOW) + forearm.apply(_WRIST), wrist


def _sequence(file: pathlib.Path, meshes: Meshes) -> Sequence:
    """Reads the sequence of a file."""
    name = file.stem
    time, robot, pose = frames_of(
        name, "the file", read_archive(file), {"time": (), "robot": (29,), "object": (7,)}
    )
    if runs_back(time).any():  # only its order matters: a `Sequence` has no times
        raise Dropped(
            name,
            "wrong layout",
            "its time decreases: sort its frames, and keep only one motion in the file",
        )
    present = np.isfinite(robot).all(-1) & np.isfinite(pose).all(-1) & is_unit(pose[:, 3:])
    if not present.any():
        reason = "no frame has finite joints and an object with a unit quaternion (w, x, y, z)"
        raise Dropped(name, "frames missing", reason)
    robot, pose = with_gaps_filled(name, present, robot, pose)
    largest = float(np.abs(robot[:, 3:]).max())
    if largest > _MAX_ANGLE_RAD:
        raise Dropped(
            name,
            "wrong units",
            f"a joint angle is {largest:.4g}: check that angles are in radians",
        )
    position, rotation = wrist_pose(robot[:, :9])
    object_name = name.removeprefix("MyoHand_").rsplit("_", 1)[0]
    return Sequence(
        name=name,
        object_name=object_name,
        mesh=meshes.find(name, object_name),
        wrist_position=position,
        wrist_rotation=rotation.as_matrix(),
        joints=joint_positions(robot[:, 9:]),
        object_position=pose[:, :3] + _OBJECT,
        object_rotation=Rotation.from_quat(pose[:, 3:], scalar_first=True).as_matrix(),
        present=present,
        q=robot[:, 9:],
    )
