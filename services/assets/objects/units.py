"""Units of meshes, and sizes at which a hand can grasp an object."""

from typing import Literal, NamedTuple

from congrasp.common.errors import CongraspError
from congrasp.services.assets.objects.sizes import length, lengths

Unit = Literal["auto", "guess", "m", "cm", "mm", "in"]
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
UNIT_NAMES = {"m": "metres", "cm": "centimetres", "mm": "millimetres", "in": "inches"}
MAX_LENGTH_M = 1.0
"""Longest side that a unit of the user may give, m."""
_MIN_THICKNESS_M = 2e-4
"""Thickness of an object that is not flat, m."""
_MAX_SIZE_FOR_SCALE_M = 0.1
"""Longest side for which --scale is proposed, m."""


class _Lengths(NamedTuple):
    """Range of the longest side of an object, m."""

    low: float
    high: float

    def contains(self, length: float) -> bool:
        """True for a length (m) in the range."""
        return self.low <= length <= self.high


_SIZES_IN_METRES = _Lengths(0.01, 0.6)
"""Sizes for which numbers are taken as metres."""
_POSSIBLE_SIZES = _Lengths(0.005, MAX_LENGTH_M)
"""Sizes that the user's unit may give."""
_LIKELY_SIZES = _Lengths(0.02, 0.4)
"""Sizes for which a unit is proposed."""


def metres_per_unit(
    path: object, sides: tuple[float, ...], unit: Unit, scale: float, notes: list[str]
) -> float:
    """Returns metres per unit of a file, with the scale.

    Args:
      path: the file, for messages.
      sides: the three sides of its mesh, in the file's unit.
      unit: unit of its numbers; see `ImportOptions.unit`.
      scale: factor on the size, after the unit.
      notes: a guess of the unit is appended.

    Raises:
      CongraspError: no hand can grasp an object of that size; the remedy is the unit that would
        fit.
    """
    longest = max(sides) * scale
    if not longest:
        raise CongraspError(
            f"{path} is a point: all of its vertices coincide.", "Check the scales of its nodes."
        )
    is_open = unit in ("auto", "guess")
    assumed: str = "m" if is_open else unit
    allowed = _SIZES_IN_METRES if is_open else _POSSIBLE_SIZES
    if not allowed.contains(longest * METRES[assumed]):
        fitting = _likely_units(longest, assumed)
        if unit != "guess" or len(fitting) != 1:
            too_large = longest * METRES[assumed] > allowed.high
            raise _wrong_size(path, sides, scale, assumed, too_large)
        size = length(longest * METRES[assumed])
        assumed = fitting[0]
        notes.append(
            f"it would be {size} long in metres, so its numbers are taken as "
            f"{UNIT_NAMES[assumed]}: {length(longest * METRES[assumed])} (if that is wrong, add "
            f"--unit or --scale)"
        )
    factor = METRES[assumed] * scale
    thickness = min(sides) * factor
    if thickness < _MIN_THICKNESS_M:
        raise CongraspError(
            f"{path} is flat: it is {length(thickness)} thick.",
            "Give it a thickness in a modelling program.",
        )
    return factor


def guessed_unit(path: object, sides: tuple[float, float, float]) -> str:
    """Returns the unit in which a mesh with these sides is an object for a hand.

    Returns:
      The unit; empty unless exactly one is likely.

    Raises:
      CongraspError: there is no such unit.
    """
    longest = max(sides)
    if _SIZES_IN_METRES.contains(longest):
        return "m"
    fitting = [unit for unit, metres in METRES.items() if _LIKELY_SIZES.contains(longest * metres)]
    if len(fitting) == 1:
        return fitting[0]
    is_possible = any(_POSSIBLE_SIZES.contains(longest * metres) for metres in METRES.values())
    if not fitting and not is_possible:
        raise CongraspError(
            f"{path} is {longest:.4g} units long, which is not a size for a hand in any of the "
            f"units {', '.join(METRES)}.",
            "Scale it in a modelling program.",
        )
    return ""


def sizes_by_unit(sides: tuple[float, float, float]) -> dict[str, tuple[str, bool]]:
    """Returns the size of a mesh with these sides in each unit.

    Returns:
      By unit: the size as text, and True if a hand could grasp it.
    """
    sizes = {}
    for unit, metres in METRES.items():
        text = lengths([side * metres for side in sides])
        sizes[unit] = (text, _POSSIBLE_SIZES.contains(max(sides) * metres))
    return sizes


def _likely_units(longest: float, assumed: str) -> list[str]:
    """Units other than the assumed one in which a longest side is that of an object."""
    units = [unit for unit in ("mm", "cm", "in", "m") if unit != assumed]
    return [unit for unit in units if _LIKELY_SIZES.contains(longest * METRES[unit])]


def _wrong_size(
    path: object, sides: tuple[float, ...], scale: float, unit: str, too_large: bool
) -> CongraspError:
    """The error of a file that is too large or too small in a unit; proposes others, or a scale.

    Args:
      path: the file.
      sides: the three sides of its mesh, in the file's unit.
      scale: factor on the size, after the unit.
      unit: the unit.
      too_large: True for an object that is too large.
    """
    longest = max(sides) * scale
    proposals = []
    for other in _likely_units(longest, unit):
        size = length(longest * METRES[other])
        proposals.append(f"{UNIT_NAMES[other]}, add '--unit {other}' ({size})")
    proposed_scale = _MAX_SIZE_FOR_SCALE_M / (max(sides) * METRES[unit])
    remedy = f"Set '--scale {proposed_scale:.3g}' for an object of 10 cm."
    if proposals:
        where = "options of 'objects import' and 'grasp'"
        remedy = f"If they are {'; if '.join(proposals)}; or set --scale ({where})."
    elif too_large:
        remedy = f"If the file also contains a table or other things, delete these. {remedy}"
    fault = "large" if too_large else "small"
    size = length(longest * METRES[unit])
    return CongraspError(
        f"{path} is {size} long if its numbers are {UNIT_NAMES[unit]}: too {fault} for a hand.",
        remedy,
    )
