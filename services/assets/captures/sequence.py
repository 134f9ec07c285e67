"""Output of importers: a captured grasp of one object by a right hand, in any world frame, m.

Importers share `frames_of`, `array_of`, `with_gaps_filled` and `Meshes`.

The wrist frame is that of the `human` hand: its origin at the wrist, fingers towards -y, the
thumb's side +x, the back of the hand +z.
"""

import dataclasses
import math
import pathlib
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Items
from typing import Any

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import file_name
from congrasp.services.assets.objects.file_kinds import SUFFIXES

_MAX_REASON_LENGTH = 200
_UNIT_TOLERANCE = 0.05
"""Largest deviation of a quaternion's length from one."""
_FRAME_FIELDS = (
    "wrist_position",
    "wrist_rotation",
    "joints",
    "object_position",
    "object_rotation",
)
"""Fields of a sequence that have a value for each frame."""
FINGERS = ("thumb", "index", "middle", "ring", "little")


class Dropped(Exception):
    """A sequence or file that cannot be used.

    Attributes:
      name: name of the sequence.
      rule: the rule that excludes it, in two or three words, for counting.
      reason: the reason as a sentence without a full stop.
    """

    def __init__(self, name: str, rule: str, reason: str):
        super().__init__(f"{name}: {reason}")
        self.name = name
        self.rule = rule
        self.reason = reason


@dataclasses.dataclass(frozen=True)
class Part:
    """A part of an object's surface, labelled by a data set."""

    name: str
    points: np.ndarray
    """(n, 3) m, in the frame of the mesh file."""


@dataclasses.dataclass(frozen=True)
class Sequence:
    """T frames of a hand and an object.

    Rotations are matrices from a body's frame to the world frame.
    """

    name: str
    object_name: str
    mesh: pathlib.Path
    """Mesh file of the object, or a folder accepted by `congrasp objects import`."""
    wrist_position: np.ndarray
    """(T, 3)."""
    wrist_rotation: np.ndarray
    """(T, 3, 3)."""
    joints: np.ndarray
    """(T, 5, 4, 3) three joints and the tip of each of `FINGERS`, from the palm outwards, in the
    wrist frame.
    """
    object_position: np.ndarray
    """(T, 3) positions of the mesh file's origin."""
    object_rotation: np.ndarray
    """(T, 3, 3) rotations of the mesh file's axes."""
    present: np.ndarray
    """(T,) bool: hand and object are known in the frame."""
    q: np.ndarray | None = None
    """(T, 20) finger angles of the `human` hand, if the format has them."""
    grasp: int | None = None
    """Grasping frame, if the data set names it."""
    touching: np.ndarray | None = None
    """(T, 5) bool: fingers that touch the object, if the data set has them."""
    parts: Items[Part] = ()
    """Labelled parts of the object, if the data set has them."""

    def __post_init__(self) -> None:
        frames = len(self.present)
        for field in _FRAME_FIELDS:
            values = getattr(self, field)
            if len(values) != frames:
                raise Dropped(
                    self.name,
                    "wrong layout",
                    f"{field} has {len(values)} frames, but there are {frames}",
                )
            if not np.isfinite(values[self.present]).all():
                raise Dropped(self.name, "not finite", f"{field} has values that are not finite")


def read_or_drop(name: str, read: Callable[..., Sequence], *arguments: Any) -> Sequence | Dropped:
    """Reads a sequence, or returns the reason why it cannot be used.

    Args:
      name: name of the sequence.
      read: function that reads it.
      arguments: arguments of the function.
    """
    try:
        return read(*arguments)
    except Dropped as dropped:
        return dropped
    except (CongraspError, OSError) as error:
        return Dropped(name, "unreadable", " ".join(str(error).split()))
    except (AttributeError, LookupError, TypeError, ValueError) as error:  # values of other types
        message = " ".join(str(error).split())[:_MAX_REASON_LENGTH]
        return Dropped(name, "wrong layout", f"{type(error).__name__}: {message}")


def array_of(
    name: str, where: str, values: Mapping[str, Any], key: str, *shape: int | str
) -> np.ndarray:
    """Returns an array of floats from a file.

    Args:
      name: name of the sequence.
      where: container of the array, for the reason.
      values: arrays by name.
      key: name of the array.
      shape: expected sizes; a letter matches any. As many numbers in another shape count if all
        sizes are given.

    Raises:
      Dropped: the array is missing, holds no numbers, or has another shape.
    """
    if key not in values:
        raise Dropped(name, "wrong layout", f"{where} has no '{key}'")
    try:
        array = np.array(values[key], float)
    except (TypeError, ValueError):
        raise Dropped(name, "wrong layout", f"'{key}' of {where} is not a numeric array") from None
    fixed_sizes = [size for size in shape if isinstance(size, int)]
    if len(fixed_sizes) == len(shape) and array.size == math.prod(fixed_sizes):
        return array.reshape(fixed_sizes)
    if not _has_sizes(array, shape):
        raise Dropped(
            name, "wrong layout", f"'{key}' of {where} has the shape {array.shape}, not {shape}"
        )
    return array


def _has_sizes(array: np.ndarray, shape: tuple[int | str, ...]) -> bool:
    """True for an array of these sizes, where a letter matches any."""
    if array.ndim != len(shape):
        return False
    for expected, size in zip(shape, array.shape, strict=True):
        if isinstance(expected, int) and size != expected:
            return False
    return True


def frames_of(
    name: str, where: str, values: Mapping[str, Any], shapes: Mapping[str, tuple[int | str, ...]]
) -> list[np.ndarray]:
    """Returns arrays (T, ...) of floats, one entry a frame.

    Args:
      name: name of the sequence.
      where: container of the arrays, for the reason.
      values: arrays by name.
      shapes: names of the arrays, with the expected sizes of a frame (`array_of`).

    Raises:
      Dropped: an array is missing, or has another shape or number of frames.
    """
    arrays = [array_of(name, where, values, key, "T", *shape) for key, shape in shapes.items()]
    counts = [len(array) for array in arrays]
    if len(set(counts)) > 1:
        text = ", ".join(f"'{key}' {count}" for key, count in zip(shapes, counts, strict=True))
        raise Dropped(name, "wrong layout", f"the numbers of frames in {where} differ: {text}")
    return arrays


def is_unit(quaternions: np.ndarray) -> np.ndarray:
    """Returns (...) bool: quaternions (..., 4) of length one, except for rounding."""
    return np.abs(np.linalg.norm(quaternions, axis=-1) - 1) < _UNIT_TOLERANCE


def with_gaps_filled(name: str, present: np.ndarray, *arrays: np.ndarray) -> list[np.ndarray]:
    """Returns arrays (T, ...) with the first known frame in place of missing ones.

    Raises:
      Dropped: no frame is known.
    """
    if not present.any():
        raise Dropped(name, "frames missing", "no frame has both the hand and the object")
    frames = np.where(present, np.arange(len(present)), present.argmax())
    return [array[frames] for array in arrays]


def _mesh_path(folder: pathlib.Path, name: str, inside: str) -> pathlib.Path | None:
    """The mesh file of an object in a folder, else the folder of its name; None without both."""
    files = [folder / f"{name}{suffix}" for suffix in SUFFIXES]
    if inside:
        files.append(folder / name / inside)
    for file in files:
        if file.is_file():
            return file
    if (folder / name).is_dir():
        return folder / name
    return None


@dataclasses.dataclass(frozen=True)
class Meshes:
    """Folders searched for the meshes of objects, in this order."""

    folders: tuple[pathlib.Path, ...]

    def beside(self, *folders: pathlib.Path) -> "Meshes":
        """Returns the search folders followed by those of the data set."""
        return Meshes((*self.folders, *folders))

    def find(self, sequence: str, *names: str, inside: str = "") -> pathlib.Path:
        """Finds the mesh file `<name>.*`, or the folder `<name>`, of the first name with either.

        Args:
          sequence: name of the sequence that needs it.
          names: names of the object.
          inside: file in the folder, if it has several.

        Raises:
          Dropped: there is no such mesh.
        """
        for name in names:
            file_name(name, "the mesh of an object")
            for folder in self.folders:
                path = _mesh_path(folder, name, inside)
                if path is not None:
                    return path
        where = ""
        if self.folders:
            where = f" in {', '.join(map(str, self.folders))}"
        raise Dropped(
            sequence,
            "no mesh",
            f"there is no mesh of '{names[-1]}'{where}: pass its folder with --meshes",
        )
