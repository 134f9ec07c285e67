"""Dataclasses of JSON values: a missing value, an unknown key and a value of another type are
errors that name the field.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import dacite

R = TypeVar("R")

_NAMES = {
    float: "a number",
    int: "a whole number",
    bool: "true or false",
    str: "a text",
    pathlib.Path: "a path",
}
"""Types in words."""
_LONGEST_VALUE = 60  # characters of a value in an error


def record_of(cls: type[R], fields: Mapping[str, Any]) -> R:
    """Returns a dataclass of the values of a JSON object.

    Lists become tuples, whole numbers floats and texts paths, where the dataclass has these. Texts
    and booleans are not numbers, and texts are not lists.

    Raises:
      ValueError: a value is missing or has another type, or a key is unknown; the message is a
        phrase that names the field and its value.
    """
    if not isinstance(fields, Mapping):
        raise ValueError("it is not an object")
    conversions = _conversions(cls)  # type: ignore[arg-type]  # a type is hashable
    rules = dacite.Config(strict=True, type_hooks=dict(conversions))
    try:
        return dacite.from_dict(cls, fields, rules)
    except dacite.WrongTypeError as error:
        expected = _in_words(error.field_type)
        raise ValueError(
            f"'{error.field_path}' must be {expected}, not {_shortened(error.value)}"
        ) from None
    except dacite.MissingValueError as error:
        raise ValueError(f"'{error.field_path}' is missing") from None
    except dacite.UnexpectedDataError as error:
        key = min(error.keys, key=str)
        raise ValueError(f"it has an unknown field {_shortened(key)}") from None
    except dacite.DaciteError as error:
        raise ValueError(str(error)) from None


def _in_words(hint: Any) -> str:
    """Name of a field's type in an error."""
    if dataclasses.is_dataclass(hint):
        return "an object"
    if get_origin(hint) is Literal:
        return f"one of {', '.join(map(repr, get_args(hint)))}"
    if get_origin(hint) is tuple:
        types = get_args(hint)
        return f"a list of {len(types)} values" if _has_length(types) else "a list"
    return _NAMES.get(hint, str(hint))


def _shortened(value: object) -> str:
    """The beginning of a value, in printable characters."""
    text = ascii(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}…"


@functools.cache
def _conversions(cls: type) -> Mapping[Any, Callable[[Any], Any]]:
    """Conversions of JSON values to the types of a dataclass's fields, and of those of the
    dataclasses in it.
    """
    conversions: dict[Any, Callable[[Any], Any]] = {
        float: _number,
        int: _whole_number,
        pathlib.Path: _path,
    }
    hints: list[Any] = [cls]
    seen = set[Any]()
    while hints:
        hint = hints.pop()
        if hint in seen:
            continue
        seen.add(hint)
        if dataclasses.is_dataclass(hint):
            hints += get_type_hints(hint).values()
            continue
        if get_origin(hint) is tuple:
            conversions[hint] = functools.partial(_tuple, hint)
        if get_origin(hint) is not Literal:
            hints += get_args(hint)
    return conversions


def _number(value: object) -> float:
    """A number as a float."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise dacite.WrongTypeError(float, value)
    try:
        return float(value)
    except OverflowError:
        raise dacite.WrongTypeError(float, value) from None


def _whole_number(value: object) -> int:
    """A whole number."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise dacite.WrongTypeError(int, value)
    return value


def _path(value: object) -> pathlib.Path:
    """A text as a path."""
    if not isinstance(value, (str, pathlib.Path)):
        raise dacite.WrongTypeError(pathlib.Path, value)
    return pathlib.Path(value)


def _tuple(hint: Any, value: object) -> tuple[Any, ...]:
    """A list as a tuple of the length of the type `hint`."""
    if not isinstance(value, (list, tuple)):
        raise dacite.WrongTypeError(hint, value)
    types = get_args(hint)
    if _has_length(types) and len(value) != len(types):
        raise dacite.WrongTypeError(hint, value)
    return tuple(value)


def _has_length(types: Sequence[Any]) -> bool:
    """True if these arguments of a tuple's type give it a length."""
    return types[1:] != (Ellipsis,)
