"""Sizes: what the numbers of a mesh file mean in metres, and how long that is compared with common things."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from common.errors import CongraspError

Unit = Literal["auto", "guess", "m", "cm", "mm", "in"]
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
_UNIT_NAMES = {"m": "metres", "cm": "centimetres", "mm": "millimetres", "in": "inches"}
_PLAUSIBLE = (0.01, 0.6)  # m, longest side of what is taken as metres without asking
_POSSIBLE = (0.005, 1.0)  # m, of what a unit that was named may lead to
_LIKELY = (0.02, 0.4)  # m, of what makes a unit worth proposing
_THINNEST = 2e-4  # m
_COMMON = (
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


def metres_per_unit(path: object, sides: tuple[float, ...], unit: Unit, scale: float, notes: list[str]) -> float:
    """Metres per unit of a file, with the scale.

    Args:
      path: the file, for what is said.
      sides: the three sides of its mesh, in its own unit.
      unit: what its numbers are; see `ImportOptions.unit`.
      scale: factor on the size, after the unit.
      notes: what the user should know is added to it.

    Raises:
      CongraspError: no hand can grasp an object of that size; the remedy is the unit that would fit.
    """
    taken: str = "m" if unit in ("auto", "guess") else unit
    longest = max(sides) * scale
    low, high = _PLAUSIBLE if unit in ("auto", "guess") else _POSSIBLE
    if not low <= longest * METRES[taken] <= high:
        others = [other for other in ("mm", "cm", "in", "m") if other != taken]
        fitting = [other for other in others if _LIKELY[0] <= longest * METRES[other] <= _LIKELY[1]]
        size = length(longest * METRES[taken])
        if unit != "guess" or len(fitting) != 1:
            options = [f"{_UNIT_NAMES[u]}, add '--unit {u}' ({length(longest * METRES[u])})" for u in fitting]
            remedy = f"Set '--scale {0.1 / (max(sides) * METRES[taken]):.3g}' for an object of 10 cm."
            if options:
                remedy = f"If they are {'; if '.join(options)}; or set --scale."
            fault = "large" if longest * METRES[taken] > high else "small"
            raise CongraspError(
                f"{path} is {size} long if its numbers are {_UNIT_NAMES[taken]}: too {fault} for a hand.", remedy
            )
        taken = fitting[0]
        notes.append(
            f"it would be {size} long in metres, so its numbers are taken as {_UNIT_NAMES[taken]}: "
            f"{length(longest * METRES[taken])} (if that is wrong, add --unit or --scale)"
        )
    factor = METRES[taken] * scale
    if min(sides) * factor < _THINNEST:
        raise CongraspError(
            f"{path} is flat: it is {length(min(sides) * factor)} thick.",
            "Give it a thickness in a modelling program.",
        )
    return factor


def length(metres: float) -> str:
    """A length with a unit that suits it."""
    for limit, unit, factor in ((0.01, "mm", 1000.0), (1.0, "cm", 100.0), (1000.0, "m", 1.0)):
        if metres < limit:
            return f"{metres * factor:.3g} {unit}"
    return f"{metres / 1000:.3g} km"


def size_in_words(sides: Sequence[float] | np.ndarray) -> str:
    """Three sides, given in metres, in cm, and something about as long."""
    longest = max(sides)
    like = next((name for limit, name in _COMMON if longest < limit), "an arm")
    return f"{' x '.join(f'{100 * side:.1f}' for side in sides)} cm, about as long as {like}"
