"""Files of constraint sets: headings, reference poses and wrist trajectories of one object for one
hand.
"""

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from congrasp.common.config import Split
from congrasp.common.errors import CongraspError
from congrasp.common.io.arrays import check_arrays
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import file_name, read_file
from congrasp.common.objects import store
from congrasp.common.objects.spec import SURFACE_POINTS, GraspObject
from congrasp.common.wire.codec import MAX_MESSAGE, Message, decode, encode

SUFFIX = ".constraints.safetensors"
REGIONS = ("whole surface", "graspable region")
"""The axis V: constraints for the whole surface, and for the graspable region only."""
FORMAT = 2
DEFAULT_MASS = 0.2
"""Mass of an object whose set was written before sets recorded it, kg."""
_MAX_NUMBER = 100.0
"""Bound of all numbers, m or rad."""
_MAX_SCALE = 100.0
"""Largest scale of an object."""
_MAX_MASS = 1000.0
"""Largest mass of an object, kg."""
_REMEDY = "Run 'congrasp constraints generate' again."
MEANING = {
    "surface/points": "(P, 3) m, object frame",
    "surface/normals": "(P, 3) outward unit normals at the points",
    "surface/avoid": "(P,) bool, the point belongs to the avoid region",
    "rest": (
        "(R, 7) resting poses in the world frame, position (m) and quaternion; the table's top is "
        "at z = 0"
    ),
    "heading/position": "(V, H, 3) m, object frame: target of the hand's centre",
    "heading/direction": "(V, H, 3) unit, object frame: direction in which the hand moves",
    "heading/cross": "(V, H, 3) unit, object frame: along the hand's cross-finger axis",
    "heading/allowed": "(V, R, H) bool, the heading clears the table",
    "heading/back": (
        "(V, R, H) m by which the position moves back along the direction to clear the table"
    ),
    "pose/q": "(V, M, F) rad, finger joints",
    "pose/position": "(V, M, 3) m, wrist in the object frame",
    "pose/quaternion": "(V, M, 4) wrist frame to object frame",
    "trajectory/position": (
        "(V, M, K, 3) m, wrist waypoints in the object frame; trajectory m ends at pose m"
    ),
    "trajectory/quaternion": "(V, M, K, 4) wrist frame to object frame",
    "pose/allowed": "(V, R, M) bool, the pose and its trajectory clear the table",
    "heading/training": (
        "(V, H) bool, the heading is for training (80 % are); the others are held out"
    ),
    "pose/training": (
        "(V, M) bool, the same for pose m and trajectory m (captured: 80 % of those of the data "
        "set)"
    ),
    "visual/vertices": "(n, 3) m, object frame",
    "visual/faces": "(m, 3) indices of vertices",
}


def load(path: pathlib.Path) -> Message:
    """Reads a set.

    Raises:
      CongraspError: the file is missing, of another kind, or damaged.
    """
    data = read_file(path, MAX_MESSAGE, _REMEDY)
    try:
        message = decode(data)
    except CongraspError as error:
        raise CongraspError(
            f"{path} cannot be read as a constraint set: {error}", _REMEDY
        ) from None
    if message.meta.get("kind") != "constraints" or message.meta.get("format") != FORMAT:
        raise CongraspError(f"{path} is not a constraint set of this version of congrasp.", _REMEDY)
    if "surface/points" in message.arrays and "surface/normals" not in message.arrays:
        message = _with_normals(message)
    missing = sorted(MEANING.keys() - message.arrays.keys())
    if missing:
        raise CongraspError(f"The constraint set {path} lacks '{missing[0]}'.", _REMEDY)
    try:
        _check(message)
    except (CongraspError, ValueError) as error:
        reason = str(error).split(". ")[0]
        raise CongraspError(f"The constraint set {path} is damaged: {reason}.", _REMEDY) from None
    return message


def load_for(
    folder: pathlib.Path, objects: Sequence[GraspObject], split: Split = "all"
) -> tuple[list[GraspObject], list[Message]]:
    """Returns the objects that have a set in a folder with a heading of the split, and their sets.

    Raises:
      CongraspError: a set cannot be read, or was made for another object of the same name.
    """
    chosen = []
    sets = []
    for obj in objects:
        path = folder / f"{obj.name}{SUFFIX}"
        if not path.is_file():
            continue
        constraints = load(path)
        if constraints.meta["object_digest"] != store.digest(obj):
            raise CongraspError(
                f"{path} was made for another object with the name '{obj.name}'.",
                "Pass the folder of that object, or generate the set again.",
            )
        if allowed_in_split(constraints, "heading", split)[0].any():
            chosen.append(obj)
            sets.append(constraints)
    return chosen, sets


def save(constraints: Message, folder: pathlib.Path) -> pathlib.Path:
    """Writes a set to a file named after its object; returns the file."""
    path = folder / f"{file_name(constraints.meta['object'], 'a constraint set')}{SUFFIX}"
    write_atomically(path, encode(constraints))
    return path


def allowed_in_split(
    constraints: Message, kind: Literal["heading", "pose"], split: Split
) -> np.ndarray:
    """(V, R, H or M) bool: headings or references of a split that clear the table."""
    allowed = constraints.arrays[f"{kind}/allowed"]
    training = constraints.arrays[f"{kind}/training"]
    members = {"all": np.ones_like(training), "training": training, "held-out": ~training}
    return allowed & members[split][:, None]


def _with_normals(message: Message) -> Message:
    """Returns a set of an earlier version with estimated normals; unchanged if its points are not
    an array (P, 3).
    """
    points = message.arrays["surface/points"]
    if points.ndim != 2 or points.shape[1] != 3 or not 1 <= len(points) <= SURFACE_POINTS:
        return message
    from congrasp.common.task.normals import estimated_normals  # imports JAX

    normals = np.array(estimated_normals(points[None])[0])
    return Message({**message.arrays, "surface/normals": normals}, message.meta)


def _check(message: Message) -> None:
    """Raises an error for invalid metadata, and for arrays that do not match `MEANING`."""
    _check_meta(message.meta)
    sizes = check_arrays(
        message.arrays,
        MEANING,
        indices=("visual/faces",),
        largest=_MAX_NUMBER,
        sizes={"V": len(REGIONS), "F": len(_names(message.meta.get("finger_joints")))},
    )
    faces = message.arrays["visual/faces"]
    if faces.min() < 0 or faces.max() >= sizes["n"]:
        raise ValueError("visual/faces names vertices that do not exist")


def _check_meta(meta: Mapping[str, Any]) -> None:
    """Raises an error for invalid metadata."""
    for name in ("object", "hand"):
        file_name(meta.get(name), f"the {name} of a constraint set")
    if not _is_number_up_to(meta.get("object_scale"), _MAX_SCALE):
        raise ValueError("its object_scale or object_digest is invalid")
    if not isinstance(meta.get("object_digest"), str):
        raise ValueError("its object_scale or object_digest is invalid")
    if not _is_number_up_to(meta.get("object_mass", DEFAULT_MASS), _MAX_MASS):
        raise ValueError("its object_mass is invalid")
    if len(_names(meta.get("variants"))) != len(REGIONS):
        raise ValueError(f"it has other variants than {', '.join(REGIONS)}")


def _is_number_up_to(value: Any, greatest: float) -> bool:
    """True for a positive number that is not above `greatest`."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return 0 < value <= greatest


def _names(value: Any) -> list[str]:
    """Returns a list of texts unchanged, and an empty one for anything else."""
    if isinstance(value, list) and all(isinstance(name, str) for name in value):
        return value
    return []
