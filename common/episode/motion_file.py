"""Motion files: episodes as self-describing NPZ files, without the content of `Recorded`.

The names of the arrays are those of the episode's fields; `meta` is JSON text with the other fields
and the meaning of every array.
"""

import io
import json
import math
import os
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from congrasp.common.episode.arm import ARM_ARRAYS, arm_of_arrays
from congrasp.common.episode.constraints import activity_of_constraints
from congrasp.common.episode.episode import ARRAYS, Episode
from congrasp.common.errors import CongraspError
from congrasp.common.io.arrays import check_arrays, read_npz
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import file_name
from congrasp.common.objects.spec import Colours
from congrasp.common.task.constraints import CONSTRAINTS

FORMAT = 2
_READABLE_FORMATS = (1, FORMAT)
MAX_BYTES = 256 << 20
"""Limit of the total size of a file's arrays, bytes."""
_REMEDY = "Run 'congrasp grasp' again."
_LARGEST = 1e6
"""Bound of all numbers."""
_LONGEST_STEP_S = 1.0
_META = "meta"
_FACTS = ("hand", "object", "success", "control_dt", "constraints", "metrics", "about")
"""Fields in `meta`."""
_OLDER_NAMES = {"pose_joints": "pose_q"}
"""Names of goal arrays in files of format 1."""
_POINTS = "object_colour_points"
_VALUES = "object_colour_values"
_COLOURS = {
    _POINTS: "(P, 3) m, object frame, points of the surface whose colours are known",
    _VALUES: "(P, 3) sRGB from 0 to 255 there",
}
_INDICES = (_VALUES, "object_faces", "joint_link", "link_parent", "capsule_link")
_LINK_INDICES = ("link_parent", "joint_link", "capsule_link")
_UNIQUE_NAMES = ("joint_names", "link_names")
MOTION_ARRAYS = {
    "time": ARRAYS["time"],
    "table": ARRAYS["table"],
    "wrist_position": "(T, 3) m, world",
    "wrist_quaternion": "(T, 4) w x y z, wrist frame to world",
    **ARRAYS,
}
"""Meaning of each array of every file, with its shape, in the order of the file. The wrist is a
property of the episode.
"""


def _goal_meanings() -> dict[str, str]:
    """Meaning of each goal array, with its shape."""
    meanings = {}
    for constraint in CONSTRAINTS:
        for name, array in constraint.arrays.items():
            axes = ", ".join(map(str, array.shape))
            if len(array.shape) == 1:
                axes += ","
            meanings[f"{constraint.name}_{name}"] = f"({axes}) {array.meaning}"
    return meanings


_GOALS = _goal_meanings()


def save_motion(path: str | os.PathLike[str], motion: Episode) -> None:
    """Writes the motion of an episode as NPZ, atomically.

    The episode of a recording needs normalised quaternions (`Episode.normalised`).

    Raises:
      CongraspError: the name of the object is not valid, or the file cannot be written.
    """
    file_name(motion.object, "the object of a motion")
    meanings = dict(MOTION_ARRAYS)
    arrays: dict[str, Any] = {name: getattr(motion, name) for name in MOTION_ARRAYS}
    if motion.colours:
        meanings |= _COLOURS
        arrays[_POINTS] = motion.colours.points
        arrays[_VALUES] = motion.colours.values
    if motion.arm:
        meanings |= ARM_ARRAYS
        arrays |= motion.arm.arrays()
    for name, values in motion.goal.items():
        if name in _GOALS:
            meanings[name] = _GOALS[name]
            arrays[name] = values
    arrays[_META] = np.array(json.dumps(_meta_of(motion, meanings)))
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_atomically(pathlib.Path(path), buffer.getvalue())


def _meta_of(motion: Episode, meanings: Mapping[str, str]) -> dict[str, Any]:
    """Content of `meta`, with the meanings of the file's arrays."""
    meta: dict[str, Any] = {"format": FORMAT}
    for name in _FACTS:
        meta[name] = getattr(motion, name)
    if motion.arm:
        meta["arm"] = motion.arm.name
    meta["units"] = "m, rad, s, N"
    meta["quaternions"] = "(w, x, y, z)"
    meta["world"] = "z up, table's top at z = 0"
    meta["arrays"] = dict(meanings)
    return meta


def load_motion(path: str | os.PathLike[str]) -> Episode:
    """Reads a motion.

    Raises:
      CongraspError: there is no such file, it is another kind of file, larger than `MAX_BYTES`, or
        damaged, or a quaternion is not normalised.
    """
    arrays = read_npz(pathlib.Path(path), _REMEDY, kind="a grasp motion", largest=MAX_BYTES)
    try:
        meta = json.loads(str(arrays.pop(_META)))
        if meta["format"] not in _READABLE_FORMATS:
            raise CongraspError(f"{path} has format {meta['format']!r:.20}, not {FORMAT}.", _REMEDY)
        motion = _parse(meta, arrays)
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        reason = str(error)
        if isinstance(error, KeyError):
            reason = f"it has no {error}"
        raise CongraspError(f"{path} is not a grasp motion ({reason[:200]}).", _REMEDY) from None
    motion.check_quaternions(str(path))
    return motion


def _parse(meta: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Episode:
    """Returns the motion of a file.

    Raises:
      ValueError, LookupError, TypeError, AttributeError: the content is not that of a motion.
      CongraspError: it is not, either; the text is for the user.
    """
    facts = {name: meta[name] for name in _FACTS}
    facts["constraints"] = tuple(facts["constraints"])
    _check_facts(facts)
    goal = {}
    for name, values in arrays.items():
        new_name = _OLDER_NAMES.get(name, name)
        if new_name in _GOALS:
            goal[new_name] = values
    meanings = {**MOTION_ARRAYS, **{name: _GOALS[name] for name in goal}}
    has_colours = _POINTS in arrays or _VALUES in arrays
    if has_colours:
        meanings |= _COLOURS
    _check_arrays({**arrays, **goal}, meanings)
    colours = None
    if has_colours:
        colours = Colours(arrays[_POINTS], arrays[_VALUES].astype(np.uint8))
    arm = None
    if "arm" in meta:
        arm = arm_of_arrays(str(meta["arm"]), arrays, len(arrays["time"]))
    of_file: dict[str, Any] = {name: arrays[name] for name in ARRAYS}
    return Episode(
        **facts,
        **of_file,
        colours=colours,
        goal=goal,
        active=activity_of_constraints(facts["constraints"]),
        arm=arm,
    )


def _check_facts(facts: Mapping[str, Any]) -> None:
    """Raises a ValueError or CongraspError for a fact with another type than in `Episode`."""
    for name in ("hand", "object"):
        file_name(facts[name], f"the {name} of a motion")
    if not isinstance(facts["success"], bool) or not isinstance(facts["about"], dict):
        raise ValueError("success is no boolean, or about no object")
    if not all(isinstance(name, str) for name in facts["constraints"]):
        raise ValueError("constraints are no names")
    numbers = {"control_dt": facts["control_dt"], **facts["metrics"]}
    for name, number in numbers.items():
        if not isinstance(number, (int, float)) or not math.isfinite(number):
            raise ValueError(f"{name} is not a finite number")
    if not 0 < numbers["control_dt"] <= _LONGEST_STEP_S:
        raise ValueError("control_dt is not above 0 and at most 1 s")


def _check_arrays(arrays: Mapping[str, np.ndarray], meanings: Mapping[str, str]) -> None:
    """Raises a ValueError if an array does not match its meaning, or has invalid values."""
    sizes = check_arrays(arrays, meanings, indices=_INDICES, largest=_LARGEST)
    faces = arrays["object_faces"]
    if faces.min() < 0 or faces.max() >= sizes["V"]:
        raise ValueError("object_faces names vertices that do not exist")
    for name in _LINK_INDICES:
        least = -1 if name == "link_parent" else 0
        if arrays[name].min() < least or arrays[name].max() >= sizes["L"]:
            raise ValueError(f"{name} names links that do not exist")
    for name in _UNIQUE_NAMES:
        if len(np.unique(arrays[name])) < len(arrays[name]):
            raise ValueError(f"{name} has a name twice")
    if _VALUES in arrays:
        values = arrays[_VALUES]
        if values.min() < 0 or values.max() > 255:
            raise ValueError(f"{_VALUES} are not from 0 to 255")
    lower, upper = arrays["joint_limits"].T
    if not (lower <= upper).all():
        raise ValueError("joint_limits are in the wrong order")
    scale = arrays["object_file_scale"]
    if not (arrays["capsule_radius"] > 0).all() or not 0 < scale < _LARGEST:
        raise ValueError("capsule_radius or object_file_scale is not above zero")
