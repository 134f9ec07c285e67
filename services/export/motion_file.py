"""A grasp motion as one self-describing NPZ file."""

import io
import json
import math
import os
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.arrays import check_arrays, read_npz
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import file_name
from congrasp.common.objects.spec import Colours
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.services.export.motion import ARRAYS, GraspMotion
from congrasp.services.record.episode import ARM_ARRAYS, arm_of

FORMAT = 2
MAX_BYTES = 256 << 20
"""Limit of the total size of a motion's arrays, bytes."""
_FORMATS = (1, FORMAT)
"""Formats that can be read."""
_REMEDY = "Run 'congrasp grasp' again."
_LARGEST = 1e6
_UNIT_TOLERANCE = 1e-3
"""Largest difference of a quaternion's length from one."""
_INDICES = ("object_colour_values", "object_faces", "joint_link", "link_parent", "capsule_link")
_LINK_INDICES = ("link_parent", "joint_link", "capsule_link")
"""Arrays of indices of links."""
_QUATERNIONS = ("wrist_quaternion", "link_quaternion", "object_quaternion")
_META = "meta"
"""Array with the facts, as JSON."""
_FACTS = ("hand", "object", "success", "control_dt", "constraints", "metrics", "about")
"""Fields of a motion that are stored as JSON."""
_OLDER_NAMES = {"pose_joints": "pose_q"}
"""Names of goal arrays in files of format 1."""
_COLOUR_POINTS = "object_colour_points"
_COLOUR_VALUES = "object_colour_values"
_COLOUR_ARRAYS = {
    _COLOUR_POINTS: "(P, 3) m, object frame, points of the surface whose colours are known",
    _COLOUR_VALUES: "(P, 3) sRGB from 0 to 255 there",
}


def _meanings_of_goals() -> dict[str, str]:
    """Meanings of the goal arrays of all constraints, by their names in motions."""
    meanings = {}
    for constraint in CONSTRAINTS:
        for name, array in constraint.arrays.items():
            shape = ", ".join(map(str, array.shape))
            if len(array.shape) == 1:
                shape = f"{shape},"
            meanings[f"{constraint.name}_{name}"] = f"({shape}) {array.meaning}"
    return meanings


GOAL_ARRAYS = _meanings_of_goals()
"""Meaning of the goal arrays; like the others, each begins with the shape."""


def save_motion(path: str | os.PathLike[str], motion: GraspMotion) -> None:
    """Writes a motion as NPZ, atomically.

    Raises:
      CongraspError: the file cannot be written.
    """
    arrays: dict[str, Any] = {name: getattr(motion, name) for name in ARRAYS}
    meanings = dict(ARRAYS)
    if motion.colours:
        arrays[_COLOUR_POINTS] = motion.colours.points
        arrays[_COLOUR_VALUES] = motion.colours.values
        meanings |= _COLOUR_ARRAYS
    if motion.arm:
        arrays |= motion.arm.arrays()
        meanings |= ARM_ARRAYS
    arrays |= motion.goal
    meanings |= {name: GOAL_ARRAYS[name] for name in motion.goal}
    meta: dict[str, Any] = {"format": FORMAT}
    meta |= {name: getattr(motion, name) for name in _FACTS}
    if motion.arm:
        meta["arm"] = motion.arm.name
    meta |= {
        "units": "m, rad, s, N",
        "quaternions": "(w, x, y, z)",
        "world": "z up, table's top at z = 0",
        "arrays": meanings,
    }
    arrays[_META] = np.array(json.dumps(meta))
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_atomically(pathlib.Path(path), buffer.getvalue())


def load_motion(path: str | os.PathLike[str]) -> GraspMotion:
    """Reads a motion.

    Raises:
      CongraspError: there is no such file, it is another kind of file, larger than `MAX_BYTES`, or
        damaged, or a quaternion is not normalised.
    """
    arrays = read_npz(pathlib.Path(path), _REMEDY, kind="a grasp motion", largest=MAX_BYTES)
    try:
        meta = json.loads(str(arrays.pop(_META)))
        if meta["format"] not in _FORMATS:
            raise CongraspError(f"{path} has format {meta['format']!r:.20}, not {FORMAT}.", _REMEDY)
        motion = _motion_of(meta, arrays)
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        raise CongraspError(f"{path} is not a grasp motion ({reason[:200]}).", _REMEDY) from None
    check_quaternions(motion, path)
    return motion


def _motion_of(meta: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> GraspMotion:
    """Returns the motion of a file's content.

    Raises:
      ValueError, LookupError, TypeError, AttributeError: the content is not that of a motion.
    """
    facts = {name: meta[name] for name in _FACTS}
    facts["constraints"] = tuple(facts["constraints"])
    _check_facts(facts)
    arrays = {_OLDER_NAMES.get(name, name): array for name, array in arrays.items()}
    goal = {name: array for name, array in arrays.items() if name in GOAL_ARRAYS}
    has_colours = bool(_COLOUR_ARRAYS.keys() & arrays.keys())
    meanings = dict(ARRAYS)
    if has_colours:
        meanings |= _COLOUR_ARRAYS
    meanings |= {name: GOAL_ARRAYS[name] for name in goal}
    _check_arrays(arrays, meanings)
    colours = None
    if has_colours:
        colours = Colours(arrays[_COLOUR_POINTS], arrays[_COLOUR_VALUES].astype(np.uint8))
    arm = None
    if "arm" in meta:
        arm = arm_of(str(meta["arm"]), arrays, len(arrays["time"]))
    fields: dict[str, Any] = {name: arrays[name] for name in ARRAYS}
    return GraspMotion(**facts, **fields, colours=colours, goal=goal, arm=arm)


def _check_facts(facts: dict[str, Any]) -> None:
    """Raises a ValueError or CongraspError for a fact with another type than in `GraspMotion`."""
    for name in ("hand", "object"):
        file_name(facts[name], f"the {name} of a motion")
    if not (isinstance(facts["success"], bool) and isinstance(facts["about"], dict)):
        raise ValueError("success is no boolean, or about no object")
    if not all(isinstance(name, str) for name in facts["constraints"]):
        raise ValueError("constraints are no names")
    numbers = {"control_dt": facts["control_dt"], **facts["metrics"]}
    for name, number in numbers.items():
        if not isinstance(number, (int, float)) or not math.isfinite(number):
            raise ValueError(f"{name} is not a finite number")
    if not 0 < numbers["control_dt"] <= 1:
        raise ValueError("control_dt is not above 0 and at most 1 s")


def _check_arrays(arrays: dict[str, np.ndarray], meanings: dict[str, str]) -> None:
    """Raises a ValueError if an array does not match its meaning, or has invalid values."""
    sizes = check_arrays(arrays, meanings, indices=_INDICES, largest=_LARGEST)
    faces = arrays["object_faces"]
    if faces.min() < 0 or faces.max() >= sizes["V"]:
        raise ValueError("object_faces names vertices that do not exist")
    for name in _LINK_INDICES:
        lowest = -1 if name == "link_parent" else 0
        if arrays[name].min() < lowest or arrays[name].max() >= sizes["L"]:
            raise ValueError(f"{name} names links that do not exist")
    for name in ("joint_names", "link_names"):
        if len(np.unique(arrays[name])) < len(arrays[name]):
            raise ValueError(f"{name} has a name twice")
    colours = arrays.get(_COLOUR_VALUES, np.zeros(1))
    if colours.min() < 0 or colours.max() > 255:
        raise ValueError(f"{_COLOUR_VALUES} are not from 0 to 255")
    if not (arrays["joint_limits"][:, 0] <= arrays["joint_limits"][:, 1]).all():
        raise ValueError("joint_limits are in the wrong order")
    if not (arrays["capsule_radius"] > 0).all() or not 0 < arrays["object_file_scale"] < _LARGEST:
        raise ValueError("capsule_radius or object_file_scale is not above zero")


def check_quaternions(motion: GraspMotion, name: object) -> None:
    """Raises a CongraspError for quaternions that are not normalised, which recordings may also
    hold.

    Args:
      motion: the motion.
      name: its file, or a name, for the message.
    """
    for owner in (motion, motion.arm):
        for array_name in _QUATERNIONS:
            quaternions = getattr(owner, array_name, None)
            if quaternions is None:
                continue
            lengths = np.linalg.norm(quaternions, axis=-1)
            if not (np.abs(lengths - 1) <= _UNIT_TOLERANCE).all():
                raise CongraspError(
                    f"{name}'s {array_name} has quaternions that are not normalised.", _REMEDY
                )
