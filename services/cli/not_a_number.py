"""Refusal of options that are not a number (`nan`), which pass checks such as `value < 0`."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from congrasp.common.errors import CongraspError


def check_numbers(parameters: Mapping[str, Any]) -> None:
    """Raises a CongraspError for the first option of a nested configuration, such as
    `--ppo.clip`, that is NaN; commands check the range of their other options themselves.

    Args:
      parameters: parameters of a command; a group of options is a dataclass.
    """
    for value in parameters.values():
        if _is_record(value):
            _check(_fields(value), "")


def _check(options: Mapping[str, Any], prefix: str) -> None:
    """Raises a CongraspError for the first option, or field of one, that is NaN.

    Args:
      options: values by name.
      prefix: names of the records around them, each with a dot; empty for the outermost ones, which
        are not checked themselves.
    """
    for name, value in options.items():
        option = f"{prefix}{name.replace('_', '-')}"
        if _is_record(value):
            _check(_fields(value), f"{option}.")
            continue
        numbers = value if isinstance(value, tuple) else (value,)
        if prefix and any(isinstance(number, float) and math.isnan(number) for number in numbers):
            raise CongraspError(f"--{option} is nan, which is not a number.", "Give a number.")


def _is_record(value: Any) -> bool:
    """True for an instance of a dataclass."""
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def _fields(value: Any) -> dict[str, Any]:
    """Fields of a dataclass by name."""
    return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
