"""Constraints as people write them down, for one object: a direction, a part, a reference pose, a wrist path.

Files give positions in metres in the axes and with the origin of the object's own file. Grasp motions and constraint
sets, which know the object's frame, are taken as they are.
"""

import dataclasses
import json
import pathlib
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from common.errors import CongraspError
from common.hands.spec import Hand
from common.objects.spec import GraspObject
from common.wire.codec import Message
from services.assets.objects.sizes import size_in_words
from services.export.motion_file import GraspMotion, load_motion
from services.grasp import constraint_sets

ABOVE = "above"
"""The heading straight down, whatever the object's pose."""
_FAR = 1.0  # m from an object beyond which nobody grasps it
_NEAR = 0.004  # m from a part within which a point of the surface belongs to it


@dataclasses.dataclass(frozen=True, eq=False)
class Reference:
    """A reference pose, object frame."""

    q: np.ndarray
    """(F,) finger angles, rad."""
    position: np.ndarray
    """(3,) wrist, m."""
    quaternion: np.ndarray
    """(4,) wrist, w x y z."""


@dataclasses.dataclass(frozen=True, eq=False)
class Asked:
    """Constraints on one object, object frame; what is None is free."""

    direction: np.ndarray | None = None
    """(3,) unit, the way the hand comes."""
    above: bool = False
    """The hand comes within 30 degrees of straight down."""
    position: np.ndarray | None = None
    """(3,) m, where the middle of the grasping hand should be."""
    minus: np.ndarray | None = None
    """(512,) bool, which points of the surface must not be touched."""
    pose: Reference | None = None
    trajectory: tuple[np.ndarray, np.ndarray] | None = None
    """(K, 3) and (K, 4) wrist waypoints."""


def read_asked(
    obj: GraspObject,
    hand: Hand,
    waypoints: int,
    *,
    heading: str = "",
    at: str = "",
    affordance: str = "",
    avoid: str = "",
    pose: str = "",
    trajectory: str = "",
) -> Asked:
    """The constraints that a user wrote down; empty text is none.

    Args:
      obj: the object.
      hand: the hand.
      waypoints: K, of the wrist trajectory.
      heading: three numbers in the axes of the object's file, or `above`.
      at: three numbers, m, in the file's axes and with its origin.
      affordance: what to grasp: a mesh of it in the coordinates of the object's file, or names of the object's parts.
      avoid: what not to touch, likewise.
      pose: a motion (.npz), a constraint set (FILE:NUMBER takes that one of its poses), or JSON.
      trajectory: a motion, a constraint set, JSON, or CSV.

    Raises:
      CongraspError: something cannot be read or does not fit; the line names it.
    """
    origin = -np.asarray(obj.origin)
    position = _numbers(at, 3, "--at") - origin if at else None
    if position is not None:
        _check_near(obj, position, "--at")
    direction = None if heading in ("", ABOVE) else _unit(_numbers(heading, 3, "--heading"), "--heading")
    return Asked(
        direction=direction,
        above=heading == ABOVE,
        position=position,
        minus=_minus(obj, affordance, avoid) if affordance or avoid else None,
        pose=_pose(pose, hand, obj, origin) if pose else None,
        trajectory=_trajectory(trajectory, hand, obj, origin, waypoints) if trajectory else None,
    )


def _numbers(text: str, count: int, name: str) -> np.ndarray:
    try:
        values = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (count,) or not np.isfinite(values).all():
        example = f'{name} "0 0 -1"' + (f" or {name} {ABOVE}" if name == "--heading" else "")
        raise CongraspError(f"{name} is '{text}', not {count} numbers.", f"Write for example {example}.")
    return values


def _unit(vector: np.ndarray, name: str) -> np.ndarray:
    size = np.linalg.norm(vector)
    if size < 1e-9:
        raise CongraspError(
            f"{name} has no direction: all its numbers are zero.", f'Write for example {name} "0 0 -1".'
        )
    return vector / size


def _minus(obj: GraspObject, affordance: str, avoid: str) -> np.ndarray:
    """(512,) bool, O-; what is named on both sides belongs to the nearer one."""
    plus_distance = _distance(obj, affordance, "--affordance") if affordance else None
    minus_distance = _distance(obj, avoid, "--avoid") if avoid else None
    if plus_distance is None:
        assert minus_distance is not None
        minus = minus_distance < _NEAR
    elif minus_distance is None:
        minus = plus_distance >= _NEAR
    else:
        minus = minus_distance < plus_distance
    if minus.all() and not affordance:
        raise CongraspError(f"'{avoid}' is all of '{obj.name}', so that nothing may be touched.", "Avoid a part of it.")
    if minus.all():
        raise CongraspError(
            f"Nothing of '{affordance or avoid}' lies on the surface of '{obj.name}'.",
            "The part must be in the coordinates of the object's file; name it with --affordance.",
        )
    if not minus.any():
        raise CongraspError(f"'{affordance or avoid}' leaves no difference: all of '{obj.name}' may be touched.")
    return minus


def _check_near(obj: GraspObject, position: np.ndarray, what: str) -> None:
    """Raises a CongraspError if a place (3,), object frame, is so far off that its unit must be another."""
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


def _pose(text: str, hand: Hand, obj: GraspObject, origin: np.ndarray) -> Reference:
    path, index = numbered(text)
    if path.suffix == ".npz":
        motion = _motion(path, hand)
        last = _removal(motion)
        position, quaternion = _wrist_on_object(motion, last)
        return Reference(motion.joint_position[last], position[last], quaternion[last])
    if path.name.endswith(constraint_sets.SUFFIX):
        arrays = _set_of(path, hand, obj, index).arrays
        return Reference(*(arrays[f"pose/{name}"][0, index] for name in ("q", "position", "quaternion")))
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
    return Reference(np.clip(q, hand.lower, hand.upper), position, turn)


def _trajectory(
    text: str, hand: Hand, obj: GraspObject, origin: np.ndarray, waypoints: int
) -> tuple[np.ndarray, np.ndarray]:
    path, index = numbered(text)
    if path.suffix == ".npz":
        motion = _motion(path, hand)
        position, quaternion = _wrist_on_object(motion, 0)
        last = _removal(motion) + 1
        return _resampled(position[:last], quaternion[:last], waypoints, str(path))
    if path.name.endswith(constraint_sets.SUFFIX):
        arrays = _set_of(path, hand, obj, index).arrays
        position, quaternion = (arrays[f"trajectory/{name}"][0, index] for name in ("position", "quaternion"))
        return _resampled(position, quaternion, waypoints, str(path))
    if path.suffix.lower() == ".csv":
        try:
            rows = np.genfromtxt(path, delimiter=",", comments="#", ndmin=2)
        except (OSError, ValueError) as error:
            raise CongraspError(f"--trajectory: {path} cannot be read: {str(error).splitlines()[0]}.") from None
        rows = rows[~np.isnan(rows).all(-1)]  # a line of names
        table = _floats(rows, (len(rows), 7), f"--trajectory: {path} (x, y, z, qw, qx, qy, qz in every line)")
        position, quaternion = table[:, :3], table[:, 3:]
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
    return (pathlib.Path(name), int(number)) if colon and number.isdigit() else (pathlib.Path(text), 0)


def _motion(path: pathlib.Path, hand: Hand) -> GraspMotion:
    motion = load_motion(path)
    if motion.hand != hand.name:
        raise CongraspError(f"{path} is a motion of the hand '{motion.hand}', not '{hand.name}'.")
    return motion


def _removal(motion: GraspMotion) -> int:
    """The last moment with the table."""
    return max(int(motion.table.sum()) - 1, 0)


def _wrist_on_object(motion: GraspMotion, moment: int) -> tuple[np.ndarray, np.ndarray]:
    """The wrist (T, 3), (T, 4) in the frame of the object as it is at one moment."""
    turn = Rotation.from_quat(motion.object_quaternion[moment], scalar_first=True).inv()
    wrist = Rotation.from_quat(motion.wrist_quaternion, scalar_first=True)
    return turn.apply(motion.wrist_position - motion.object_position[moment]), (turn * wrist).as_quat(scalar_first=True)


def _set_of(path: pathlib.Path, hand: Hand, obj: GraspObject, index: int) -> Message:
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
    remedy = f"Write a JSON file with {', '.join(keys)}, or name a motion (.npz) or a constraint set."
    try:
        given = json.loads(path.read_text())
    except OSError as error:
        raise CongraspError(f"{name}: {path} cannot be read: {error.strerror}.", remedy) from None
    except ValueError:
        raise CongraspError(f"{name}: {path} is not JSON.", remedy) from None
    for key in keys:
        if not isinstance(given, dict) or key not in given:
            raise CongraspError(f"{name}: {path} lacks '{key}'.", remedy)
    return given


def _floats(values: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    try:
        array = np.asarray(values, float)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != shape or 0 in shape or not np.isfinite(array).all():
        raise CongraspError(f"{what} must be {' x '.join(map(str, shape))} finite numbers.")
    return array


def _resampled(
    position: np.ndarray, quaternion: np.ndarray, waypoints: int, what: str
) -> tuple[np.ndarray, np.ndarray]:
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
    turns = Slerp(along, Rotation.from_quat(quaternion, scalar_first=True))(wanted).as_quat(scalar_first=True)
    signs = np.where(np.concatenate([[1.0], np.einsum("ij,ij->i", turns[1:], turns[:-1])]) < 0, -1.0, 1.0)
    return places, turns * np.cumprod(signs)[:, None]  # continuous in sign
