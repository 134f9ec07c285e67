"""Records with which a constraint declares its goal arrays, observation, reward, errors, relations
and command-line options.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np

from congrasp.common.hands.spec import Hand
from congrasp.common.task.types import Array, Goal, Surface

Window = Literal["approach", "hold"]
"""Steps over which an error is averaged: before the table's removal, or in the `hold_steps` after
it.
"""


@dataclasses.dataclass(frozen=True)
class GoalArray:
    """A goal array of a constraint, as the annotation of its field in the NamedTuple."""

    shape: tuple[int | str, ...]
    """Shape without the batch axis; each entry is a symbol of `symbol_sizes` or a number."""
    meaning: str
    """Unit, frame and meaning."""
    kind: Literal["real", "position", "direction", "quaternion", "flag"] = "real"
    """Kind of value: positions, directions and quaternions are in the object frame, and the latter
    two must be unit vectors; flags are booleans."""
    neutral: tuple[float, ...] = ()
    """Last axis of the value used where no request gives one; zeros by default."""
    required: bool = True
    """True if a request for the constraint must include the array."""


class Weight(NamedTuple):
    """One term of the reward."""

    name: str
    """Name of the term and of its weight."""
    default: float
    """Default weight, in units of reward per control step."""
    meaning: str
    """Symbol in the paper, and unit."""


class ErrorSpec(NamedTuple):
    """Definition of an error of a constraint; the paper's definitions are in its section
    Metrics.
    """

    name: str
    """Name of the episode's metric, such as `heading_rad`."""
    unit: str
    """rad, m, or empty for a ratio."""
    window: Window
    tolerance: float
    """Largest error at which the constraint counts as met in one step."""
    scale: float
    """Scale that makes errors of different kinds comparable when grasps are compared."""
    meaning: str
    """Description of the compared quantity in displays."""
    column: str = ""
    """Name in tables and their JSON; `name` if empty."""
    block: str = ""
    """Block of the constraint without which the error is undefined, if its other blocks can be
    active alone.
    """


class ObservationField(NamedTuple):
    """A contiguous field of the observation."""

    name: str
    size: int
    meaning: str
    """Unit and frame; "wrist" is the wrist frame."""
    privileged: bool = False
    """True if only a simulator knows the values: a tracked observation lacks them."""


class Relation(NamedTuple):
    """Relation of a constraint to a weaker one when both are requested and cannot both be met."""

    weaker: str
    """Name of the other constraint."""
    settled: Literal["overridden", "redirected", "refused"]
    """Effect on the weaker constraint; a refused request is an error."""
    measure: Callable[[Hand, Surface, Goal], dict[str, Array]]
    """Distances (B, ...) between the two, by name."""
    contradicts: Callable[[Mapping[str, Array]], Array]
    """(B,) bool from these distances: the two cannot both be met."""
    message: Callable[[Hand, Mapping[str, Any]], str]
    """One or two sentences with the distances of one environment, as NumPy."""


class Option(NamedTuple):
    """Option of `congrasp grasp` that requests a constraint."""

    name: str
    help: str
    kind: Literal["text", "direction", "place", "part", "pose", "path"] = "text"
    """Kind of the parsed value: a text; three numbers in the axes of the object's file, normalised;
    three numbers in the coordinates of the file, converted to a position (3,) in the object frame;
    a `Part`; a wrist pose with finger angles, or a wrist path of K waypoints, from a file: dicts of
    `q`, `position` and `quaternion`, object frame."""
    words: tuple[str, ...] = ()
    """Literal values accepted for any kind."""
    many: bool = False
    """Accepts several words, given as a tuple."""
    switch: bool = False
    """A flag without a value."""


class Part(NamedTuple):
    """A part of an object's surface, named by an option."""

    text: str
    """Text of the option."""
    distance: np.ndarray
    """(N,) distances from the object's surface points to the part, m."""
