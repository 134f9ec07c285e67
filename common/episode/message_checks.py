"""Validation of episodes from untrusted peers and files."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands import known_hand
from congrasp.common.objects.object_checks import MAX_COORDINATE
from congrasp.common.wire.codec import Message
from congrasp.common.wire.messages import EPISODE, validate

_MOST_OF_SYMBOL = {"T": 2000, "V": 200_000, "Fc": 400_000, "N": 4096, "n": 64, "P": 100_000}
"""Largest sizes by the symbols of `EPISODE`."""
_MOST_GOAL_VALUES = 10_000
"""Most numbers of a goal array."""
_OPEN_FOLDERS = ("reward/", "error/", "goal/", "active/")
"""Folders with any number of arrays."""
_MOST_OPEN_ARRAYS = 128
_POSITIONS = ("visual_vertices", "colour_points")
_LONGEST_STEP_S = 1.0


def check_message(message: Message) -> None:
    """Validates the message of an episode.

    Raises:
      CongraspError: the message is invalid; the text names the array or the entry, and the violated
        rule.
    """
    hand = known_hand(message.meta.get("hand"))
    sizes = validate(message, EPISODE, L=len(hand.links), F=len(hand.joints))
    for symbol, most in _MOST_OF_SYMBOL.items():
        if not 1 <= sizes.get(symbol, 1) <= most:
            raise CongraspError(f"The episode's {symbol} is {sizes[symbol]}, not 1 to {most}.")
    if not 0.0 < message.meta["control_dt"] <= _LONGEST_STEP_S:
        raise CongraspError("The episode's control_dt is not above 0 and at most 1 s.")
    _check_object(message.arrays, sizes["V"])
    _check_open_arrays(message.arrays)


def _check_object(arrays: Mapping[str, np.ndarray], vertices: int) -> None:
    """Raises a CongraspError for an invalid mesh with `vertices`, or invalid colours."""
    faces = arrays["visual_faces"]
    if faces.min() < 0 or faces.max() >= vertices:
        raise CongraspError("The episode's visual_faces name vertices that do not exist.")
    if ("colour_points" in arrays) != ("colour_values" in arrays):
        raise CongraspError("The episode has colour_points without colour_values, or the reverse.")
    for name in _POSITIONS:
        if name in arrays and np.abs(arrays[name]).max() > MAX_COORDINATE:
            raise CongraspError(
                f"The episode's {name} are more than {MAX_COORDINATE:g} m from the object's centre."
            )


def _check_open_arrays(arrays: Mapping[str, np.ndarray]) -> None:
    """Raises a CongraspError for too many arrays, or a too large goal array."""
    count = 0
    for name, array in arrays.items():
        if name.startswith(_OPEN_FOLDERS):
            count += 1
        if name.startswith("goal/") and array.size > _MOST_GOAL_VALUES:
            raise CongraspError(
                f"The episode has a goal array of more than {_MOST_GOAL_VALUES} values."
            )
    if count > _MOST_OPEN_ARRAYS:
        raise CongraspError(
            f"The episode has more than {_MOST_OPEN_ARRAYS} rewards, errors and goal arrays."
        )


def metrics_of_message(message: Message) -> dict[str, float]:
    """Metrics of an episode by name.

    Raises:
      CongraspError: one is not a number.
    """
    metrics = {}
    for name, value in message.meta["metrics"].items():
        if not isinstance(value, int | float):
            raise CongraspError(f"The episode's metric {ascii(name)[:60]} is not a number.")
        metrics[name] = float(value)
    return metrics


def numbers_of_entry(meta: Mapping[str, Any], name: str, default: np.ndarray) -> np.ndarray:
    """Float64 numbers of an entry of the metadata, with the shape of its default.

    Raises:
      CongraspError: they are not finite numbers of this shape.
    """
    try:
        numbers = np.asarray(meta.get(name, default), np.float64)
    except (TypeError, ValueError):
        numbers = np.full(default.shape, np.nan)
    if numbers.shape != default.shape or not np.isfinite(numbers).all():
        raise CongraspError(f"The episode's meta entry '{name}' is not valid.")
    return numbers
