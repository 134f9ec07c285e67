"""Constraints from text and files, for one object: a direction, a part, a reference pose, a wrist
path.

Files give positions in metres in the axes and with the origin of the object's own file. Grasp
motions and constraint sets, which are in the object frame, are used unchanged.
"""

import os
import pathlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from congrasp.common.errors import CongraspError
from congrasp.common.hands.motors import coupled
from congrasp.common.hands.spec import Hand
from congrasp.common.io.inputs import numbers_in, read_json
from congrasp.common.objects.spec import GraspObject
from congrasp.common.request import GraspRequest
from congrasp.common.rotations import continuous
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.constraints.heading import ABOVE
from congrasp.common.task.constraints.specs import Option, Part
from congrasp.common.task.sampling import set_file
from congrasp.common.wire.codec import Message
from congrasp.services.assets.captures.approach import approach
from congrasp.services.assets.captures.references import followed
from congrasp.services.assets.captures.sequence import Dropped
from congrasp.services.assets.captures.surface import Surface
from congrasp.services.assets.objects.affordance import from_part
from congrasp.services.assets.objects.mesh_files import upright
from congrasp.services.assets.objects.options import size_in_words
from congrasp.services.export.motion_file import GraspMotion, load_motion
from congrasp.services.grasp.csv_paths import HUGE, read_csv
from congrasp.services.grasp.wrist_paths import read_wrist_path
from congrasp.services.record.episode import grasp_span

_LARGEST = 4 << 20  # bytes of a JSON or CSV file
_FAR = 1.0  # m from an object; places beyond it have another unit or origin


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
        if away > _FAR:
            remedy = "Give metres, in the axes and with the origin of its file."
            raise CongraspError(f"{what} lies {away:.3g} m from '{self.obj.name}'.", remedy)


def read_request(obj: GraspObject, hand: Hand, waypoints: int, **texts: Any) -> GraspRequest:
    """Reads the constraints of an object from texts.

    Args:
      obj: the object.
      hand: the hand.
      waypoints: K, of wrist trajectories.
      **texts: by the names of the constraints' options (`Constraint.options`); None or an empty
        text omits the option. Text is split at blanks and commas if an option takes several words;
        a number, and a sequence or an array of words or numbers, equal such a text.

    Raises:
      CongraspError: an option is unknown, cannot be read or does not fit the object; the message
        names it.
    """
    options = {option.name: option for constraint in CONSTRAINTS for option in constraint.options}
    if unknown := sorted(set(texts) - set(options)):
        raise CongraspError(
            f"There is no constraint option '{unknown[0]}'.", f"Known: {', '.join(options)}."
        )
    plain = {name: _plain(option, texts.get(name)) for name, option in options.items()}
    given = {
        name: _read(option, plain[name], Target(f"--{name}", obj, hand, waypoints))
        for name, option in options.items()
    }
    parsed = {constraint: constraint.parse(given, hand, obj) for constraint in CONSTRAINTS}
    found = {constraint.name: arrays for constraint, arrays in parsed.items() if arrays is not None}
    regions = [
        constraint.avoid_region(given, obj)
        for constraint in CONSTRAINTS
        if constraint.name in found
    ]
    avoid = next((region for region in regions if region is not None), None)
    return GraspRequest({"heading": {}, **found}, avoid, above=plain["heading"] == ABOVE)


def _read(option: Option, text: str | tuple[str, ...], target: Target) -> Any:
    """Returns the value of an option, by its kind; None if it is not given. Errors name the
    option.
    """
    if not text:
        return None
    if isinstance(text, tuple) or option.kind == "text" or text in option.words:
        return text
    try:
        return _READERS[option.kind](text, target)
    except CongraspError as error:
        raise CongraspError(
            str(error) if str(error).startswith(target.name) else f"{target.name}: {error}"
        ) from None


def _plain(option: Option, value: Any) -> str | tuple[str, ...]:
    """Returns the text of an option, or its words if it takes several; a flag that is off is an
    empty text.
    """
    if option.switch or value is None:
        return "yes" if value else ""
    if not isinstance(value, str | os.PathLike):
        value = ",".join(_words(value))
    text = os.fspath(value)
    return tuple(text.replace(",", " ").split()) if option.many else text


def _words(value: Any) -> list[str]:
    """The words of a text, a number, or a sequence of such, also nested and of different
    lengths.
    """
    nested = np.iterable(value) and not isinstance(value, str)
    return [word for part in value for word in _words(part)] if nested else [str(value)]


def _place(text: str, target: Target) -> np.ndarray:
    """(3,) m, object frame, of a place in the coordinates of the object's file."""
    position = target.placed(_numbers(text, target.name))
    target.check_near(position, target.name)
    return position


def _direction(text: str, target: Target) -> np.ndarray:
    """(3,) unit vector."""
    return _unit(upright(_numbers(text, target.name), target.obj.file_up), target.name)


def _numbers(text: str, name: str) -> np.ndarray:
    """(3,) finite numbers."""
    values = numbers_in(text)
    if len(values) != 3:
        example = f'{name} "0 0 -1"' + (f" or {name} {ABOVE}" if name == "--heading" else "")
        raise CongraspError(f"{name} is '{text}', not 3 numbers.", f"Write for example {example}.")
    return values


def _unit(vector: np.ndarray, name: str) -> np.ndarray:
    """The normalised vector."""
    largest = np.abs(vector).max()
    if largest < 1e-9:
        raise CongraspError(
            f"{name} has no direction: all its numbers are zero.", "Make one of them 1 or -1."
        )
    return vector / largest / np.linalg.norm(vector / largest)


def _part(text: str, target: Target) -> Part:
    """A part of the object: a mesh file in the coordinates of its file, or names of its parts."""
    path, obj = pathlib.Path(text), target.obj
    names = [word.strip() for word in text.split(",")]
    if path.exists() and set(names) <= set(obj.part_names):
        raise CongraspError(
            f"'{text}' is a file here, and a part of '{obj.name}'.", f"Pass ./{text} for the file."
        )
    if not path.suffix and not path.exists():
        if unknown := [part for part in names if part not in obj.part_names]:
            known = f"Its parts are: {', '.join(obj.part_names)}; or name a mesh file of the part."
            raise CongraspError(f"'{obj.name}' has no part '{unknown[0]}'.", known)
        inside = np.isin(obj.labels, [obj.part_names.index(part) for part in names])
        return Part(text, np.where(inside, 0.0, 1.0))
    if not path.is_file():
        raise CongraspError(f"there is no file {path}.", "Check the path.")
    return Part(text, from_part(obj, path))


def _pose(text: str, target: Target) -> dict[str, np.ndarray]:
    """A reference pose from a motion, a constraint set, or JSON."""
    path, index = _numbered(text)
    if path.suffix == ".npz":
        motion = _motion(path, target.hand, index)
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
    given, hand = _json(path, ("joints", "position", "quaternion")), target.hand
    joints, names = given["joints"], [joint.name for joint in hand.joints]
    if isinstance(joints, dict):
        if unknown := sorted(set(joints) - set(names)):
            raise CongraspError(
                f"the hand '{hand.name}' has no joint '{unknown[0]}'.", f"Known: {names}."
            )
        joints = [joints.get(name, 0.0) for name in names]
    q = _floats(joints, (len(names),), f"'joints' of {path}")
    if np.abs(q).max() > 2 * np.pi:
        raise CongraspError(
            f"a joint of {path} is at {np.abs(q).max():.4g}.", "Angles are in radians."
        )
    position = target.placed(_floats(given["position"], (3,), f"'position' of {path}"))
    target.check_near(position, f"the wrist of {path}")
    turn = _unit(_floats(given["quaternion"], (4,), f"'quaternion' of {path}"), "the quaternion")
    q = coupled(hand, np.clip(q, hand.lower, hand.upper))
    return {"q": q, "position": position, "quaternion": target.turned(turn)}


def _path(text: str, target: Target) -> dict[str, np.ndarray]:
    """A wrist trajectory from a motion, a constraint set, CSV, BVH, or JSON."""
    path, index = _numbered(text)
    file, _, joint = text.partition(":")
    if file.lower().endswith(".bvh"):
        return _recorded(pathlib.Path(file), joint or "RightHand", target)
    if path.suffix == ".npz":
        motion = _motion(path, target.hand, index)
        first, last = grasp_part(motion)
        position, quaternion = (
            values[first : last + 1] for values in _wrist_on_object(motion, first)
        )
        return _resampled(position, quaternion, target.waypoints, path)
    if path.name.endswith(set_file.SUFFIX):
        arrays = _set_of(path, target, index).arrays
        position, quaternion = (
            arrays[f"trajectory/{name}"][0, index] for name in ("position", "quaternion")
        )
        return _resampled(position, quaternion, target.waypoints, path)
    if path.suffix.lower() == ".csv":
        position, quaternion = read_csv(path, _LARGEST)
    else:
        given = _json(path, ("position", "quaternion"))
        count = len(given["position"]) if isinstance(given["position"], list) else 0
        position = _floats(given["position"], (count, 3), f"'position' of {path}")
        quaternion = _floats(given["quaternion"], (count, 4), f"'quaternion' of {path}")
    position = target.placed(position)
    target.check_near(position[-1], f"the end of {path}")
    return _resampled(position, target.turned(quaternion), target.waypoints, path)


def _recorded(path: pathlib.Path, joint: str, target: Target) -> dict[str, np.ndarray]:
    """The path of a BVH joint to the frame nearest to the object, cut like captured paths."""
    recorded = read_wrist_path(path, joint=joint)
    position, rotation = followed(target.hand, recorded.position, recorded.rotation)
    position = position + target.obj.origin  # both are upright
    away = Surface(target.obj).distance(position)
    frame = int(away.argmin())
    target.check_near(position[frame], f"the joint '{joint}' of {path}")
    known = np.ones(len(away), bool)
    try:
        _, places, turns = approach(
            path.stem, position, rotation.as_matrix(), away, known, frame, target.waypoints
        )
    except Dropped as dropped:
        raise CongraspError(
            f"{path}: {dropped.reason}.", "Move the skeleton, or name another joint."
        ) from None
    return {"position": places, "quaternion": turns}


def _numbered(text: str) -> tuple[pathlib.Path, int]:
    """The file and the number in FILE or FILE:NUMBER; the number is 0 by default."""
    name, colon, number = text.rpartition(":")
    if colon and number.isdecimal() and len(number) < 10:
        return pathlib.Path(name), int(number)
    return pathlib.Path(text), 0


def _motion(path: pathlib.Path, hand: Hand, index: int) -> GraspMotion:
    """The motion in a file; raises a CongraspError for another hand, or an `index` other than 0."""
    if index:
        raise CongraspError(
            f"{path} is one motion and has no number {index}.", "Leave the number out."
        )
    motion = load_motion(path)
    if motion.hand != hand.name:
        raise CongraspError(f"{path} is a motion of the hand '{motion.hand}', not '{hand.name}'.")
    return motion


def grasp_part(motion: GraspMotion) -> tuple[int, int]:
    """The first frame of the grasp itself, and the last one before the lift or the table's
    removal.
    """
    first, end = grasp_span(motion.about, motion.control_dt, motion.table)
    last = max(end - 1, 0)
    return min(first, last), last


def _wrist_on_object(motion: GraspMotion, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """The wrist (T, 3), (T, 4) in the object frame of one frame of the motion."""
    turn = Rotation.from_quat(motion.object_quaternion[frame], scalar_first=True).inv()
    wrist = Rotation.from_quat(motion.wrist_quaternion, scalar_first=True)
    return turn.apply(motion.wrist_position - motion.object_position[frame]), (
        turn * wrist
    ).as_quat(scalar_first=True)


def _set_of(path: pathlib.Path, target: Target, index: int) -> Message:
    """The constraint set in a file; raises a CongraspError for another hand or object, or without
    this number.
    """
    constraints, hand, obj = set_file.load(path), target.hand, target.obj
    if constraints.meta["hand"] != hand.name:
        raise CongraspError(
            f"{path} is for the hand '{constraints.meta['hand']}', not '{hand.name}'."
        )
    own, wanted = (
        np.ptp(x, axis=0) for x in (obj.visual_vertices, constraints.arrays["visual/vertices"])
    )
    if not np.allclose(own, wanted, rtol=0.02, atol=1e-3):
        scale = float(constraints.meta["object_scale"])
        its = (
            f"The {hand.name} hand is trained on objects {scale:g} times as large: add --scale "
            f"{scale:g}."
        )
        raise CongraspError(
            f"{path} is for an object of {size_in_words(wanted)}; '{obj.name}' has "
            f"{size_in_words(own)}.",
            "Name the set of this object." if scale == 1.0 else its,
        )
    count = constraints.arrays["pose/q"].shape[1]
    if index >= count:
        raise CongraspError(
            f"{path} has no number {index}.", f"Its poses and trajectories are 0 to {count - 1}."
        )
    return constraints


def _json(path: pathlib.Path, keys: tuple[str, ...]) -> dict[str, Any]:
    """A JSON file that has these keys."""
    remedy = (
        f"Write a JSON file with {', '.join(keys)}, or name a motion (.npz) or a constraint set."
    )
    given = read_json(path, _LARGEST, remedy)
    for key in keys:
        if not isinstance(given, dict) or key not in given:
            raise CongraspError(f"{path} lacks '{key}'.", remedy)
    return given


def _floats(values: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """(*shape) numbers below `HUGE`; raises a CongraspError for others."""
    try:
        array = np.asarray(values, float)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(0)
    if array.shape != shape or 0 in shape or not (np.abs(array) < HUGE).all():
        raise CongraspError(f"{what} must be {' x '.join(map(str, shape))} finite numbers.")
    return array


def _resampled(
    position: np.ndarray, quaternion: np.ndarray, waypoints: int, path: pathlib.Path
) -> dict[str, np.ndarray]:
    """`waypoints` poses evenly spread along a path (n, 3), (n, 4)."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(position, axis=0), axis=-1))])
    kept = np.concatenate([[True], np.diff(along) > 1e-6])
    if kept.sum() < 2:
        raise CongraspError(
            f"the wrist does not move in {path}.", "Give two different waypoints or more."
        )
    if (np.linalg.norm(quaternion, axis=-1) < 1e-6).any():
        raise CongraspError(f"{path} has a quaternion of length zero.")
    position, quaternion, along = position[kept], quaternion[kept], along[kept]
    wanted = np.linspace(0.0, along[-1], waypoints)
    places = np.stack([np.interp(wanted, along, column) for column in position.T], -1)
    turns = Slerp(along, Rotation.from_quat(quaternion, scalar_first=True))(wanted)
    return {"position": places, "quaternion": continuous(turns.as_quat(scalar_first=True))}


_READERS: dict[str, Callable[[str, Target], Any]] = {
    "direction": _direction,
    "place": _place,
    "part": _part,
    "pose": _pose,
    "path": _path,
}
"""Readers of an option's text by its kind (`Option.kind`); their arguments are the text and the
option's target.
"""
