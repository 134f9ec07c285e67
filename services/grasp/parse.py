"""Constraints from text and files, for one object: a direction, a part, a reference pose, a wrist
path.

Files give positions in metres in the axes and with the origin of the object's own file. Grasp
motions and constraint sets, which are in the object frame, are used unchanged.
"""

import os
import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.io.arrays import numbers_in
from congrasp.common.objects.spec import GraspObject
from congrasp.common.request import GraspRequest
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.constraints.heading import ABOVE
from congrasp.common.task.constraints.specs import Option, Part
from congrasp.services.assets.objects.affordance import from_part
from congrasp.services.assets.objects.mesh_files import upright
from congrasp.services.grasp.reference_files import read_path, read_pose
from congrasp.services.grasp.target import Target, unit_vector


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
    options: dict[str, Option] = {}
    for constraint in CONSTRAINTS:
        options |= {option.name: option for option in constraint.options}
    unknown = sorted(set(texts) - set(options))
    if unknown:
        raise CongraspError(
            f"There is no constraint option '{unknown[0]}'.",
            f"Choose from: {', '.join(options)}.",
        )
    words = {name: _plain(option, texts.get(name)) for name, option in options.items()}
    values = {
        name: _read(option, words[name], Target(f"--{name}", obj, hand, waypoints))
        for name, option in options.items()
    }
    constraints: dict[str, dict[str, np.ndarray]] = {}
    for constraint in CONSTRAINTS:
        arrays = constraint.parse(values, hand, obj)
        if arrays is not None:
            constraints[constraint.name] = arrays
    avoid = None
    for constraint in CONSTRAINTS:
        if constraint.name not in constraints:
            continue
        region = constraint.avoid_region(values, obj)
        if avoid is None:
            avoid = region
    above = words["heading"] == ABOVE
    return GraspRequest({"heading": {}, **constraints}, avoid, above=above)


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
    """Returns the text of an option, or the words of an option that takes several.

    A flag is "yes" if it is on, and empty if it is off.
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
    if isinstance(value, str) or not np.iterable(value):
        return [str(value)]
    words = []
    for part in value:
        words += _words(part)
    return words


def _place(text: str, target: Target) -> np.ndarray:
    """(3,) m, object frame, of a place in the coordinates of the object's file."""
    position = target.placed(_numbers(text, target.name))
    target.check_near(position, target.name)
    return position


def _direction(text: str, target: Target) -> np.ndarray:
    """(3,) unit vector."""
    return unit_vector(upright(_numbers(text, target.name), target.obj.file_up), target.name)


def _numbers(text: str, name: str) -> np.ndarray:
    """(3,) finite numbers."""
    values = numbers_in(text)
    if len(values) != 3:
        example = f'{name} "0 0 -1"' + (f" or {name} {ABOVE}" if name == "--heading" else "")
        raise CongraspError(f"{name} is '{text}', not 3 numbers.", f"Write for example {example}.")
    return values


def _part(text: str, target: Target) -> Part:
    """A part of the object: a mesh file in the coordinates of its file, or names of its parts."""
    path = pathlib.Path(text)
    obj = target.obj
    names = [word.strip() for word in text.split(",")]
    if path.exists() and set(names) <= set(obj.part_names):
        raise CongraspError(
            f"'{text}' is ambiguous: it is a file and a part of '{obj.name}'.",
            f"Pass ./{text} for the file.",
        )
    if not path.suffix and not path.exists():
        unknown = [part for part in names if part not in obj.part_names]
        if unknown:
            remedy = (
                f"Its parts are: {', '.join(obj.part_names)}. A mesh file of the part works, too."
            )
            raise CongraspError(f"'{obj.name}' has no part '{unknown[0]}'.", remedy)
        inside = np.isin(obj.labels, [obj.part_names.index(part) for part in names])
        return Part(text, np.where(inside, 0.0, 1.0))
    if not path.is_file():
        raise CongraspError(f"there is no file {path}.", "Check the path.")
    return Part(text, from_part(obj, path))


_READERS: dict[str, Callable[[str, Target], Any]] = {
    "direction": _direction,
    "place": _place,
    "part": _part,
    "pose": read_pose,
    "path": read_path,
}
"""Readers of an option's text by its kind (`Option.kind`); their arguments are the text and the
option's target.
"""
