"""Lengths and sizes as text."""

from collections.abc import Sequence

import numpy as np

_SCALES = ((0.01, 1000.0, "mm"), (1.0, 100.0, "cm"), (1000.0, 1.0, "m"))
"""Upper end of the lengths (m) in a unit, number of these units in a metre, and the unit."""
_KILOMETRES = (1e-3, "km")
_COMMON_OBJECTS = (
    (0.015, "a pea"),
    (0.03, "a grape"),
    (0.05, "a walnut"),
    (0.075, "an egg"),
    (0.12, "a mug"),
    (0.17, "a phone"),
    (0.22, "a banana"),
    (0.35, "a wine bottle"),
    (0.6, "a keyboard"),
)
"""Upper end of the lengths (m) like a common object, and the object."""


def lengths(sides: Sequence[float]) -> str:
    """Formats sides, in m, with the unit that suits the longest."""
    longest = max(sides)
    factor, unit = _KILOMETRES
    for limit, units_in_metre, name in _SCALES:
        if longest < limit:
            factor = units_in_metre
            unit = name
            break
    numbers = [f"{side * factor:.3g}" for side in sides]
    return f"{' x '.join(numbers)} {unit}"


def length(metres: float) -> str:
    """Formats a length, in m, with a suitable unit."""
    return lengths([metres])


def size_in_words(sides: Sequence[float] | np.ndarray) -> str:
    """Formats three sides, in m, as cm, with a common object of similar length."""
    longest = max(sides)
    similar = "an arm"
    for limit, name in _COMMON_OBJECTS:
        if longest < limit:
            similar = name
            break
    numbers = [f"{100 * side:.1f}" for side in sides]
    return f"{' x '.join(numbers)} cm, about as long as {similar}"
