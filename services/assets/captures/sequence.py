"""Output of importers: one captured grasp of one object by a right hand, in metres, in any world frame.

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
    """A sequence or file that cannot be used.

    Attributes:
      name: name of the sequence.
      rule: the rule that excludes it, in two or three words, for counting.
      reason: the reason as a sentence without a full stop.
    """

    def __init__(self, name: str, rule: str, reason: str):
        super().__init__(f"{name}: {reason}")
        self.name, self.rule, self.reason = name, rule, reason


@dataclasses.dataclass(frozen=True)
class Part:
    """A part of an object's surface, labelled by a data set."""

    name: str
    points: np.ndarray
    """(n, 3) m, in the frame of the mesh file."""


@dataclasses.dataclass(frozen=True)
class Sequence:
    """T frames of a hand and an object. Rotations are matrices from a body's frame to the world frame."""

    name: str
    object_name: str
    mesh: pathlib.Path
    """Mesh file of the object, or a folder accepted by `congrasp objects import`."""
    wrist_position: np.ndarray
    """(T, 3)."""
    wrist_rotation: np.ndarray
    """(T, 3, 3)."""
    joints: np.ndarray
    """(T, 5, 4, 3) three joints and the tip of each of `FINGERS`, from the palm outwards, in the wrist frame."""
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
        for field in ("wrist_position", "wrist_rotation", "joints", "object_position", "object_rotation"):
            values = getattr(self, field)
            if len(values) != frames:
                raise Dropped(self.name, "wrong layout", f"{field} has {len(values)} frames, but there are {frames}")
            if not np.isfinite(values[self.present]).all():
                raise Dropped(self.name, "not finite", f"{field} holds values that are not finite")


def read_or_drop(name: str, read: Callable[..., Sequence], *arguments: Any) -> Sequence | Dropped:
    """Returns the result of `read(*arguments)`, or the reason why the sequence of this name cannot be used."""
    try:
        return read(*arguments)
    except Dropped as dropped:
        return dropped
    except (CongraspError, OSError) as error:
        return Dropped(name, "unreadable", " ".join(str(error).split()))


def array_of(name: str, where: str, values: Mapping[str, Any], key: str, *shape: int | str) -> np.ndarray:
    """Returns a copy of an array of floats from a file.

    Args:
      name: name of the sequence.
      where: container of the array, for the reason.
      values: arrays by name.
      key: name of the array.
      shape: expected sizes; a letter matches any.

    Raises:
      Dropped: the array is missing, or has another shape.
    """
    if key not in values:
        raise Dropped(name, "wrong layout", f"{where} has no '{key}'")
    array = np.array(values[key], float)
    pairs = zip(shape, array.shape, strict=False)
    if array.ndim != len(shape) or any(wanted != size for wanted, size in pairs if isinstance(wanted, int)):
        raise Dropped(name, "wrong layout", f"'{key}' of {where} has the shape {array.shape}, not {shape}")
    return array
