"""What every importer yields: one captured grasp of one object by a right hand, in metres, in any world frame.

The wrist frame is that of the `human` hand: its origin at the wrist, fingers towards -y, the thumb's side +x, the back
of the hand +z.
"""

import dataclasses
import pathlib
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Items
from typing import Any

import numpy as np

from congrasp.common.errors import CongraspError

FINGERS = ("thumb", "index", "middle", "ring", "little")


class Dropped(Exception):
    """A sequence, or a file, that cannot be used.

    Attributes:
      name: the sequence's.
      rule: what excludes it, in two or three words, to count by.
      reason: why, as a sentence without a full stop.
    """

    def __init__(self, name: str, rule: str, reason: str):
        super().__init__(f"{name}: {reason}")
        self.name, self.rule, self.reason = name, rule, reason


@dataclasses.dataclass(frozen=True)
class Part:
    """A part of an object's surface, as a data set labels it."""

    name: str
    points: np.ndarray
    """(n, 3) m, in the frame of the mesh file."""


@dataclasses.dataclass(frozen=True)
class Sequence:
    """T frames of a hand and an object. Rotations are matrices from the named body's frame to the world."""

    name: str
    object_name: str
    mesh: pathlib.Path
    """The object's mesh file, or a folder that `congrasp objects import` takes."""
    wrist_position: np.ndarray
    """(T, 3)."""
    wrist_rotation: np.ndarray
    """(T, 3, 3)."""
    joints: np.ndarray
    """(T, 5, 4, 3) of each of `FINGERS` its three joints and its tip, from the palm outwards, in the wrist frame."""
    object_position: np.ndarray
    """(T, 3) of the mesh file's origin."""
    object_rotation: np.ndarray
    """(T, 3, 3) of the mesh file's axes."""
    present: np.ndarray
    """(T,) bool: hand and object are known in the frame."""
    q: np.ndarray | None = None
    """(T, 20) the `human` hand's finger angles, where the format has them."""
    grasp: int | None = None
    """The grasping frame, where the data set names it."""
    touching: np.ndarray | None = None
    """(T, 5) bool: which fingers touch the object, where the data set says it."""
    parts: Items[Part] = ()
    """The object's labelled parts, where the data set has them."""

    def __post_init__(self) -> None:
        frames = len(self.present)
        for field in ("wrist_position", "wrist_rotation", "joints", "object_position", "object_rotation"):
            values = getattr(self, field)
            if len(values) != frames:
                raise Dropped(self.name, "wrong layout", f"{field} has {len(values)} frames, but there are {frames}")
            if not np.isfinite(values[self.present]).all():
                raise Dropped(self.name, "not finite", f"{field} holds values that are not finite")


def read_or_drop(name: str, read: Callable[..., Sequence], *arguments: Any) -> Sequence | Dropped:
    """What `read(*arguments)` returns, or why the sequence of this name cannot be used."""
    try:
        return read(*arguments)
    except Dropped as dropped:
        return dropped
    except (CongraspError, OSError) as error:
        return Dropped(name, "unreadable", " ".join(str(error).split()))


def array_of(name: str, where: str, values: Mapping[str, Any], key: str, *shape: int | str) -> np.ndarray:
    """A copy of an array of floats that a file holds.

    Args:
      name: of the sequence.
      where: what holds the array, for the reason.
      values: what it holds by name.
      key: name of the array.
      shape: its sizes; a letter stands for any.

    Raises:
      Dropped: it is not there, or has another shape.
    """
    if key not in values:
        raise Dropped(name, "wrong layout", f"{where} has no '{key}'")
    array = np.array(values[key], float)
    pairs = zip(shape, array.shape, strict=False)
    if array.ndim != len(shape) or any(wanted != size for wanted, size in pairs if isinstance(wanted, int)):
        raise Dropped(name, "wrong layout", f"'{key}' of {where} has the shape {array.shape}, not {shape}")
    return array
