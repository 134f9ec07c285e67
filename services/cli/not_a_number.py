"""Refusal of options that are not a number (`nan`), which every comparison lets pass."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from congrasp.common.errors import CongraspError


def check_numbers(parameters: Mapping[str, Any]) -> None:
    """Raises a CongraspError for the first option of a configuration (with a dot) that is NaN;
    commands check the range of their other options themselves.

    Args:
      parameters: parameters of a command; a group of options is a dataclass.
    """
    for value in parameters.values():
        if _is_record(value):
            _check(_fields(value), "")


def _check(options: Mapping[str, Any], prefix: str) -> None:
    """Raises a CongraspError for the first option, or field of one, that is NaN."""
    for name, value in options.items():
        option = f"{prefix}{name.replace('_', '-')}"
        if _is_record(value):
            _check(_fields(value), f"{option}.")
            continue
        values = value if isinstance(value, tuple) else (value,)
        if prefix and any(isinstance(one, float) and math.isnan(one) for one in values):
            raise CongraspError(f"--{option} is nan, which is not a number.", "Give a number.")


def _is_record(value: Any) -> bool:
    """True for an instance of a dataclass."""
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def _fields(value: Any) -> dict[str, Any]:
    """Fields of a dataclass by name."""
    return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
