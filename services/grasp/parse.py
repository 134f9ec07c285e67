"""Constraints as people write them down, for one object: a direction, a part, a reference pose, a wrist path.

Files give positions in metres in the axes and with the origin of the object's own file. Grasp motions and constraint
sets, which know the object's frame, are taken as they are.
"""

import os
import pathlib
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from congrasp.common.errors import CongraspError
from congrasp.common.hands.motors import coupled
from congrasp.common.hands.spec import Hand
from congrasp.common.io.inputs import read_json
from congrasp.common.objects.spec import GraspObject
from congrasp.common.request import GraspRequest
from congrasp.common.rotations import continuous
from congrasp.common.task.constraints import CONSTRAINTS, get_constraint
from congrasp.common.task.constraints.base import Option
from congrasp.common.task.constraints.force import least_force
from congrasp.common.task.sampling import sets as constraint_sets
from congrasp.common.wire.codec import Message
from congrasp.services.assets.objects.headers import check_header
from congrasp.services.assets.objects.sizes import size_in_words
from congrasp.services.export.motion_file import GraspMotion, load_motion
from congrasp.services.grasp.wrist_paths import HUGE, read_csv
from congrasp.services.record.goals import grasp_span

ABOVE = "above"
"""The heading straight down, whatever the object's pose."""
_LARGEST = 4 << 20  # bytes of a JSON or CSV file
_FAR = 1.0  # m from an object beyond which nobody grasps it
_NEAR = 0.004  # m from a part within which a point of the surface belongs to it


class Written(NamedTuple):
    """What a person wrote, and for what."""

    texts: Mapping[str, Any]
    """By the names of the constraints' options; empty is none."""
    obj: GraspObject
    hand: Hand
    waypoints: int
    """K, of wrist trajectories."""

    @property
    def origin(self) -> np.ndarray:
        """(3,) m: the object's frame in the coordinates of its file."""
        return -np.asarray(self.obj.origin)


def read_request(obj: GraspObject, hand: Hand, waypoints: int, **texts: Any) -> GraspRequest:
    """The constraints that a person wrote down for an object.

    Args:
      obj: the object.
      hand: the hand.
      waypoints: K, of wrist trajectories.
      **texts: by the names of the constraints' options (`Constraint.options`); empty is none. Text is split at blanks
        and commas where an option takes several words; a sequence of words or numbers stands for such a text.

    Raises:
      CongraspError: something cannot be read or does not fit; the line names it.
    """
    options = {option.name: option for constraint in CONSTRAINTS for option in constraint.options}
    if unknown := sorted(set(texts) - set(options)):
        raise CongraspError(f"There is no constraint option '{unknown[0]}'.", f"Known: {', '.join(options)}.")
    plain = {name: _plain(option, texts.get(name, "")) for name, option in options.items()}
    written = Written(plain, obj, hand, waypoints)
    found: dict[str, dict[str, np.ndarray]] = {}
    for constraint in CONSTRAINTS:
        reader = READERS.get(constraint.name)
        given = reader(written) if reader else constraint.parse(written.texts, hand)
        if given is not None:
            found[constraint.name] = given
    avoid = _avoid(written) if "affordance" in found else None
    return GraspRequest({"heading": {}, **found}, avoid, above=written.texts["heading"] == ABOVE)


def _plain(option: Option, value: float | str | os.PathLike[str] | Iterable[Any]) -> str | tuple[str, ...]:
    """What was written for an option: its words where it takes several, else one text, empty for a switch that is off.

    A number stands for its text.
    """
    if option.switch:
        return "yes" if value else ""
    if isinstance(value, int | float):
        return f"{value:g}"
    text = os.fspath(value) if isinstance(value, str | os.PathLike) else ",".join(map(str, value))
    return tuple(text.replace(",", " ").split()) if option.many else text


def _heading(written: Written) -> dict[str, np.ndarray] | None:
    """Direction and position, as far as they are given."""
    heading, at = written.texts["heading"], written.texts["at"]
    found = {}
    if at:
        found["position"] = _numbers(at, 3, "--at") - written.origin
        _check_near(written.obj, found["position"], "--at")
    if heading not in ("", ABOVE):
        found["direction"] = _unit(_numbers(heading, 3, "--heading"), "--heading")
    return found or None


def _affordance(written: Written) -> dict[str, np.ndarray] | None:
    """It has no arrays of its own: what it asks for is in the avoid region."""
    return {} if written.texts["affordance"] or written.texts["avoid"] else None


def _force(written: Written) -> dict[str, np.ndarray] | None:
    """The limit that is given, or the least one for the object's weight."""
    if not written.texts["gentle"]:
        return get_constraint("force").parse(written.texts, written.hand)
    if written.texts["force"]:
        raise CongraspError("--force and --gentle both set the force limit.", "Leave one out.")
    return {"limit": np.asarray(least_force(written.obj.mass, 1.0), np.float32)}


def _numbers(text: str, count: int, name: str) -> np.ndarray:
    """(count,) finite numbers."""
    try:
        values = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (count,) or not np.isfinite(values).all():
        example = f'{name} "0 0 -1"' + (f" or {name} {ABOVE}" if name == "--heading" else "")
        raise CongraspError(f"{name} is '{text}', not {count} numbers.", f"Write for example {example}.")
    return values


def _unit(vector: np.ndarray, name: str) -> np.ndarray:
    """The vector at length 1."""
    largest = np.abs(vector).max()
    if largest < 1e-9:
        raise CongraspError(f"{name} has no direction: all its numbers are zero.", "Make one of them 1 or -1.")
    return vector / largest / np.linalg.norm(vector / largest)


def _avoid(written: Written) -> np.ndarray:
    """(512,) bool, the avoid region; what is named on both sides belongs to the nearer one."""
    obj, affordance, avoid = written.obj, written.texts["affordance"], written.texts["avoid"]
    graspable_distance = _distance(obj, affordance, "--affordance") if affordance else None
    avoid_distance = _distance(obj, avoid, "--avoid") if avoid else None
    if graspable_distance is None:
        assert avoid_distance is not None
        region = avoid_distance < _NEAR
    elif avoid_distance is None:
        region = graspable_distance >= _NEAR
    else:
        region = avoid_distance < graspable_distance
    if region.all() and not affordance:
        raise CongraspError(f"'{avoid}' is all of '{obj.name}', so that nothing may be touched.", "Avoid a part of it.")
    if region.all():
        raise CongraspError(
            f"Nothing of '{affordance or avoid}' lies on the surface of '{obj.name}'.",
            "The part must be in the coordinates of the object's file; name it with --affordance.",
        )
    if not region.any():
        raise CongraspError(f"'{affordance or avoid}' leaves no difference: all of '{obj.name}' may be touched.")
    return region


def _check_near(obj: GraspObject, position: np.ndarray, what: str) -> None:
    """Raises a CongraspError if a place (3,), object frame, is so far off that its unit must be another."""
    with np.errstate(over="ignore"):
        away = float(np.linalg.norm(obj.points - position, axis=-1).min())
    if away > _FAR:
        raise CongraspError(
            f"{what} lies {away:.3g} m from '{obj.name}'.", "Give metres, in the axes and with the origin of its file."
        )


def _distance(obj: GraspObject, text: str, name: str) -> np.ndarray:
    """(512,) m from the surface's points to a part."""
    path = pathlib.Path(text)
    if not path.suffix and not path.exists():
        names = [word.strip() for word in text.split(",")]
        for part in names:
            if part not in obj.part_names:
                raise CongraspError(
                    f"{name}: '{obj.name}' has no part '{part}'.",
                    f"Its parts are: {', '.join(obj.part_names)}; or name a mesh file of the part.",
                )
        inside = np.isin(obj.labels, [obj.part_names.index(part) for part in names])
        return np.where(inside, 0.0, 1.0)
    if not path.is_file():
        raise CongraspError(f"{name}: there is no file {path}.", "Check the path.")
    check_header(path, path.suffix.lower(), "Export it as PLY.")
    try:
        geometry: Any = trimesh.load_scene(path, process=False).to_geometry()
        points = np.asarray(geometry.vertices, float)
        if len(getattr(geometry, "faces", ())):
            points = np.concatenate([points, trimesh.sample.sample_surface(geometry, 8000, seed=0)[0]])
    except OSError as error:
        raise CongraspError(f"{name}: {path} cannot be read: {error.strerror or error}.", "Check the path.") from None
    except Exception as error:  # the readers raise whatever they stumble over
        raise CongraspError(f"{name}: {path} cannot be read as a mesh ({error}).", "Export it as PLY.") from None
    points = points[np.isfinite(points).all(-1)]
    if not len(points):
        raise CongraspError(f"{name}: {path} holds no points.", "Export the part as PLY.")
    return cKDTree(points * obj.file_scale + np.asarray(obj.origin)).query(obj.points)[0]


def _pose(written: Written) -> dict[str, np.ndarray] | None:
    """A reference pose from a motion, a constraint set, or JSON."""
    text, hand, obj, origin = written.texts["pose"], written.hand, written.obj, written.origin
    if not text:
        return None
    path, index = numbered(text)
    if path.suffix == ".npz":
        motion = _motion(path, hand, index)
        last = grasp_part(motion)[1]
        position, quaternion = _wrist_on_object(motion, last)
        return _reference(motion.joint_position[last], position[last], quaternion[last])
    if path.name.endswith(constraint_sets.SUFFIX):
        arrays = _set_of(path, hand, obj, index).arrays
        return {name: arrays[f"pose/{name}"][0, index] for name in ("q", "position", "quaternion")}
    given = _json(path, "--pose", ("joints", "position", "quaternion"))
    joints, names = given["joints"], [joint.name for joint in hand.joints]
    if isinstance(joints, dict):
        if unknown := sorted(set(joints) - set(names)):
            raise CongraspError(f"--pose: the hand '{hand.name}' has no joint '{unknown[0]}'.", f"Known: {names}.")
        joints = [joints.get(name, 0.0) for name in names]
    q = _floats(joints, (len(names),), f"--pose: 'joints' of {path}")
    position = _floats(given["position"], (3,), f"--pose: 'position' of {path}") - origin
    _check_near(obj, position, f"--pose: the wrist of {path}")
    if np.abs(q).max() > 2 * np.pi:
        raise CongraspError(f"--pose: a joint of {path} is at {np.abs(q).max():.4g}.", "Angles are in radians.")
    turn = _unit(_floats(given["quaternion"], (4,), f"--pose: 'quaternion' of {path}"), "--pose: the quaternion")
    return _reference(coupled(hand, np.clip(q, hand.lower, hand.upper)), position, turn)


def _reference(q: np.ndarray, position: np.ndarray, quaternion: np.ndarray) -> dict[str, np.ndarray]:
    """The goal arrays of a reference pose."""
    return {"q": q, "position": position, "quaternion": quaternion}


def _trajectory(written: Written) -> dict[str, np.ndarray] | None:
    """A wrist trajectory from a motion, a constraint set, CSV, or JSON."""
    text, hand, obj, origin = written.texts["trajectory"], written.hand, written.obj, written.origin
    waypoints = written.waypoints
    if not text:
        return None
    path, index = numbered(text)
    if path.suffix == ".npz":
        motion = _motion(path, hand, index)
        first, last = grasp_part(motion)
        position, quaternion = _wrist_on_object(motion, first)
        return _resampled(position[first : last + 1], quaternion[first : last + 1], waypoints, str(path))
    if path.name.endswith(constraint_sets.SUFFIX):
        arrays = _set_of(path, hand, obj, index).arrays
        position, quaternion = (arrays[f"trajectory/{name}"][0, index] for name in ("position", "quaternion"))
        return _resampled(position, quaternion, waypoints, str(path))
    if path.suffix.lower() == ".csv":
        try:
            position, quaternion = read_csv(path, _LARGEST)
        except CongraspError as error:
            raise CongraspError(f"--trajectory: {error}") from None
    else:
        given = _json(path, "--trajectory", ("position", "quaternion"))
        count = len(given["position"]) if isinstance(given["position"], list) else 0
        position = _floats(given["position"], (count, 3), f"--trajectory: 'position' of {path}")
        quaternion = _floats(given["quaternion"], (count, 4), f"--trajectory: 'quaternion' of {path}")
    _check_near(obj, position[-1] - origin, f"--trajectory: the end of {path}")
    return _resampled(position - origin, quaternion, waypoints, str(path))


def numbered(text: str) -> tuple[pathlib.Path, int]:
    """The file and the number in FILE or FILE:NUMBER; 0 without."""
    name, colon, number = text.rpartition(":")
    return (
        (pathlib.Path(name), int(number))
        if colon and number.isdecimal() and len(number) < 10
        else (pathlib.Path(text), 0)
    )


def _motion(path: pathlib.Path, hand: Hand, index: int) -> GraspMotion:
    """A motion of this hand; a file holds one."""
    if index:
        raise CongraspError(f"{path} is one motion and has no number {index}.", "Leave the number out.")
    motion = load_motion(path)
    if motion.hand != hand.name:
        raise CongraspError(f"{path} is a motion of the hand '{motion.hand}', not '{hand.name}'.")
    return motion


def grasp_part(motion: GraspMotion) -> tuple[int, int]:
    """The first frame of the grasp itself, and the last one before the lift or the table's removal."""
    first, end = grasp_span(motion.about, motion.control_dt, motion.table)
    last = max(end - 1, 0)
    return min(first, last), last


def _wrist_on_object(motion: GraspMotion, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """The wrist (T, 3), (T, 4) in the frame of the object as it is in one frame of the motion."""
    turn = Rotation.from_quat(motion.object_quaternion[frame], scalar_first=True).inv()
    wrist = Rotation.from_quat(motion.wrist_quaternion, scalar_first=True)
    return turn.apply(motion.wrist_position - motion.object_position[frame]), (turn * wrist).as_quat(scalar_first=True)


def _set_of(path: pathlib.Path, hand: Hand, obj: GraspObject, index: int) -> Message:
    """A constraint set of this hand and object, which has a pose and a trajectory of this number."""
    constraints = constraint_sets.load(path)
    if constraints.meta["hand"] != hand.name:
        raise CongraspError(f"{path} is for the hand '{constraints.meta['hand']}', not '{hand.name}'.")
    own, wanted = (np.ptp(x, axis=0) for x in (obj.visual_vertices, constraints.arrays["visual/vertices"]))
    if not np.allclose(own, wanted, rtol=0.02, atol=1e-3):
        scale = float(constraints.meta["object_scale"])
        its = f"It is for objects {scale:g} times as large, as the {hand.name} hand is trained: add --scale {scale:g}."
        raise CongraspError(
            f"{path} is for an object of {size_in_words(wanted)}; '{obj.name}' has {size_in_words(own)}.",
            "Name the set of this object." if scale == 1.0 else its,
        )
    count = constraints.arrays["pose/q"].shape[1]
    if index >= count:
        raise CongraspError(f"{path} has no number {index}.", f"Its poses and trajectories are 0 to {count - 1}.")
    return constraints


def _json(path: pathlib.Path, name: str, keys: tuple[str, ...]) -> dict[str, Any]:
    """A JSON file that has these keys."""
    remedy = f"Write a JSON file with {', '.join(keys)}, or name a motion (.npz) or a constraint set."
    try:
        given = read_json(path, _LARGEST, remedy)
    except OSError as error:
        raise CongraspError(f"{name}: {path} cannot be read: {error.strerror}.", remedy) from None
    except CongraspError as error:
        raise CongraspError(f"{name}: {error}") from None
    for key in keys:
        if not isinstance(given, dict) or key not in given:
            raise CongraspError(f"{name}: {path} lacks '{key}'.", remedy)
    return given


def _floats(values: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Numbers of this shape that can be meant."""
    try:
        array = np.asarray(values, float)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(0)
    if array.shape != shape or 0 in shape or not (np.abs(array) < HUGE).all():
        raise CongraspError(f"{what} must be {' x '.join(map(str, shape))} finite numbers.")
    return array


def _resampled(position: np.ndarray, quaternion: np.ndarray, waypoints: int, what: str) -> dict[str, np.ndarray]:
    """`waypoints` poses evenly spread along a path (n, 3), (n, 4)."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(position, axis=0), axis=-1))])
    kept = np.concatenate([[True], np.diff(along) > 1e-6])
    if kept.sum() < 2:
        raise CongraspError(
            f"--trajectory: the wrist does not move in {what}.", "Give two different waypoints or more."
        )
    if (np.linalg.norm(quaternion, axis=-1) < 1e-6).any():
        raise CongraspError(f"--trajectory: {what} has a quaternion of length zero.")
    position, quaternion, along = position[kept], quaternion[kept], along[kept]
    wanted = np.linspace(0.0, along[-1], waypoints)
    places = np.stack([np.interp(wanted, along, column) for column in position.T], -1)
    turns = Slerp(along, Rotation.from_quat(quaternion, scalar_first=True))(wanted)
    return {"position": places, "quaternion": continuous(turns.as_quat(scalar_first=True))}


READERS: dict[str, Callable[[Written], dict[str, np.ndarray] | None]] = {
    "heading": _heading,
    "affordance": _affordance,
    "pose": _pose,
    "trajectory": _trajectory,
    "force": _force,
}
"""Readers of constraints that take files or the object's own coordinates; the others parse by themselves."""
