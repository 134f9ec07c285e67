"""Reference poses and wrist paths from files: motions, constraint sets, CSV, BVH and JSON."""

import pathlib
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from congrasp.common.episode.episode import Episode
from congrasp.common.episode.motion_file import load_motion
from congrasp.common.errors import CongraspError
from congrasp.common.hands.motors import follow_couplings
from congrasp.common.hands.spec import Hand
from congrasp.common.io.inputs import read_json
from congrasp.common.rotations import continuous
from congrasp.common.task.sampling import set_file
from congrasp.common.wire.codec import Message
from congrasp.services.assets.captures.approach import approach
from congrasp.services.assets.captures.references import follow_human_wrist
from congrasp.services.assets.captures.sequence import Dropped
from congrasp.services.assets.captures.surface import Surface
from congrasp.services.assets.objects.sizes import size_in_words
from congrasp.services.grasp.csv_paths import MAX_MAGNITUDE, read_csv
from congrasp.services.grasp.target import Target, unit_vector
from congrasp.services.grasp.wrist_paths import read_wrist_path

_MAX_BYTES = 4 << 20
"""Of a JSON or CSV file."""


def read_pose(text: str, target: Target) -> dict[str, np.ndarray]:
    """A reference pose from a motion, a constraint set, or JSON."""
    path, index = _split_number(text)
    if path.suffix == ".npz":
        motion = _read_motion(path, target.hand, index)
        last = grasp_part(motion)[1]
        position, quaternion = _wrist_on_object(motion, last)
        return {
            "q": motion.joint_position[last],
            "position": position[last],
            "quaternion": quaternion[last],
        }
    if path.name.endswith(set_file.SUFFIX):
        arrays = _set_of(path, target, index).arrays
        return {name: arrays[f"pose/{name}"][0, index] for name in ("q", "position", "quaternion")}
    content = _json(path, ("joints", "position", "quaternion"))
    q = _finger_angles(content["joints"], target.hand, path)
    position = target.placed(_floats(content["position"], (3,), f"'position' of {path}"))
    target.check_near(position, f"the wrist of {path}")
    quaternion = _floats(content["quaternion"], (4,), f"'quaternion' of {path}")
    turn = unit_vector(quaternion, "the quaternion")
    return {"q": q, "position": position, "quaternion": target.turned(turn)}


def _finger_angles(joints: Any, hand: Hand, path: pathlib.Path) -> np.ndarray:
    """(F,) finger angles within the hand's limits, from a list or by names of joints, rad."""
    names = [joint.name for joint in hand.joints]
    if isinstance(joints, dict):
        unknown = sorted(set(joints) - set(names))
        if unknown:
            raise CongraspError(
                f"the hand '{hand.name}' has no joint '{unknown[0]}'.",
                f"Choose from its joints: {', '.join(names)}.",
            )
        joints = [joints.get(name, 0.0) for name in names]
    q = _floats(joints, (len(names),), f"'joints' of {path}")
    largest = np.abs(q).max()
    if largest > 2 * np.pi:
        raise CongraspError(
            f"a joint angle of {path} is {largest:.4g}.", "Write joint angles in radians."
        )
    return follow_couplings(hand, np.clip(q, hand.lower, hand.upper))


def read_path(text: str, target: Target) -> dict[str, np.ndarray]:
    """A wrist trajectory from a motion, a constraint set, CSV, BVH, or JSON."""
    path, index = _split_number(text)
    file, _, joint = text.partition(":")
    if file.lower().endswith(".bvh"):
        return _path_of_joint(pathlib.Path(file), joint or "RightHand", target)
    if path.suffix == ".npz":
        motion = _read_motion(path, target.hand, index)
        first, last = grasp_part(motion)
        position, quaternion = _wrist_on_object(motion, first)
        grasp = slice(first, last + 1)
        return _resample(position[grasp], quaternion[grasp], target.waypoints, path)
    if path.name.endswith(set_file.SUFFIX):
        arrays = _set_of(path, target, index).arrays
        position = arrays["trajectory/position"][0, index]
        quaternion = arrays["trajectory/quaternion"][0, index]
        return _resample(position, quaternion, target.waypoints, path)
    if path.suffix.lower() == ".csv":
        position, quaternion = read_csv(path, _MAX_BYTES)
    else:
        content = _json(path, ("position", "quaternion"))
        count = len(content["position"]) if isinstance(content["position"], list) else 0
        position = _floats(content["position"], (count, 3), f"'position' of {path}")
        quaternion = _floats(content["quaternion"], (count, 4), f"'quaternion' of {path}")
    position = target.placed(position)
    target.check_near(position[-1], f"the end of {path}")
    return _resample(position, target.turned(quaternion), target.waypoints, path)


def _path_of_joint(path: pathlib.Path, joint: str, target: Target) -> dict[str, np.ndarray]:
    """Returns the path of a BVH joint up to the frame nearest to the object, with waypoints chosen
    as for captured paths.
    """
    recorded = read_wrist_path(path, joint=joint)
    position, rotation = follow_human_wrist(target.hand, recorded.position, recorded.rotation)
    position = position + target.obj.origin  # both are upright
    distances = Surface(target.obj).distance(position)
    frame = int(distances.argmin())
    target.check_near(position[frame], f"the joint '{joint}' of {path}")
    is_valid = np.ones(len(distances), bool)
    try:
        _, places, turns = approach(
            path.stem, position, rotation.as_matrix(), distances, is_valid, frame, target.waypoints
        )
    except Dropped as dropped:
        raise CongraspError(
            f"{path}: {dropped.reason}.", "Move the skeleton, or pass another joint."
        ) from None
    return {"position": places, "quaternion": turns}


def _split_number(text: str) -> tuple[pathlib.Path, int]:
    """Splits FILE:NUMBER into the file and the number, which is 0 for FILE alone."""
    name, colon, number = text.rpartition(":")
    if colon and number.isdecimal() and len(number) < 10:
        return pathlib.Path(name), int(number)
    return pathlib.Path(text), 0


def _read_motion(path: pathlib.Path, hand: Hand, index: int) -> Episode:
    """Reads the motion of a file.

    Raises:
      CongraspError: it is of another hand, or `index` is not 0, since a file holds one motion.
    """
    if index:
        raise CongraspError(
            f"{path} holds a single motion, without the number {index}.", f"Remove ':{index}'."
        )
    motion = load_motion(path)
    if motion.hand != hand.name:
        raise CongraspError(
            f"{path} is a motion of the hand '{motion.hand}', not '{hand.name}'.",
            "Pass a motion of this hand.",
        )
    return motion


def grasp_part(motion: Episode) -> tuple[int, int]:
    """The first frame of the grasp itself, and the last one before the lift or the table's
    removal.
    """
    first, end = motion.grasp_span
    last = max(end - 1, 0)
    return min(first, last), last


def _wrist_on_object(motion: Episode, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """The wrist (T, 3), (T, 4) in the object frame of one frame of the motion."""
    turn = Rotation.from_quat(motion.object_quaternion[frame], scalar_first=True).inv()
    wrist = Rotation.from_quat(motion.wrist_quaternion, scalar_first=True)
    position = turn.apply(motion.wrist_position - motion.object_position[frame])
    return position, (turn * wrist).as_quat(scalar_first=True)


def _set_of(path: pathlib.Path, target: Target, index: int) -> Message:
    """The constraint set in a file; raises a CongraspError for another hand or object, or without
    this number.
    """
    constraints = set_file.load(path)
    hand = target.hand
    obj = target.obj
    if constraints.meta["hand"] != hand.name:
        raise CongraspError(
            f"{path} is for the hand '{constraints.meta['hand']}', not '{hand.name}'.",
            "Pass a constraint set of this hand.",
        )
    size = np.ptp(obj.visual_vertices, axis=0)
    size_in_set = np.ptp(constraints.arrays["visual/vertices"], axis=0)
    if not np.allclose(size, size_in_set, rtol=0.02, atol=1e-3):
        scale = float(constraints.meta["object_scale"])
        remedy = "Pass the constraint set of this object."
        if scale != 1.0:
            remedy = (
                f"The {hand.name} hand is trained on objects {scale:g} times as large: add --scale "
                f"{scale:g}."
            )
        raise CongraspError(
            f"{path} is for an object of {size_in_words(size_in_set)}; '{obj.name}' has "
            f"{size_in_words(size)}.",
            remedy,
        )
    count = constraints.arrays["pose/q"].shape[1]
    if index >= count:
        raise CongraspError(
            f"{path} has no number {index}.",
            f"Its poses and trajectories have the numbers 0 to {count - 1}.",
        )
    return constraints


def _json(path: pathlib.Path, keys: tuple[str, ...]) -> dict[str, Any]:
    """A JSON file that has these keys."""
    remedy = (
        f"Write a JSON file with {', '.join(keys)}, or pass a motion (.npz) or a constraint set."
    )
    content = read_json(path, _MAX_BYTES, remedy)
    for key in keys:
        if not isinstance(content, dict) or key not in content:
            raise CongraspError(f"{path} lacks '{key}'.", remedy)
    return content


def _floats(values: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Returns numbers as an array of a shape.

    Raises:
      CongraspError: they have another shape, or one is not a finite number below `MAX_MAGNITUDE`.
    """
    try:
        array = np.asarray(values, float)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(0)
    if array.shape != shape or 0 in shape or not (np.abs(array) < MAX_MAGNITUDE).all():
        raise CongraspError(f"{what} must be {' x '.join(map(str, shape))} finite numbers.")
    return array


def _resample(
    position: np.ndarray, quaternion: np.ndarray, waypoints: int, path: pathlib.Path
) -> dict[str, np.ndarray]:
    """Resamples a path at points that divide its length evenly.

    Args:
      position: (n, 3) m.
      quaternion: (n, 4), w first.
      waypoints: number K of points.
      path: the file, for errors.

    Returns:
      `position` (K, 3) and `quaternion` (K, 4).

    Raises:
      CongraspError: the wrist does not move, or a quaternion is zero.
    """
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(position, axis=0), axis=-1))])
    moves = np.concatenate([[True], np.diff(along) > 1e-6])
    if moves.sum() < 2:
        raise CongraspError(
            f"the wrist does not move in {path}.", "Write at least two different waypoints."
        )
    if (np.linalg.norm(quaternion, axis=-1) < 1e-6).any():
        raise CongraspError(
            f"{path} has a quaternion of length zero.", "Write unit quaternions (w, x, y, z)."
        )
    along = along[moves]
    samples = np.linspace(0.0, along[-1], waypoints)
    places = np.stack([np.interp(samples, along, column) for column in position[moves].T], -1)
    turns = Slerp(along, Rotation.from_quat(quaternion[moves], scalar_first=True))(samples)
    return {"position": places, "quaternion": continuous(turns.as_quat(scalar_first=True))}
