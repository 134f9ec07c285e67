"""Options for converting meshes to objects, units and sizes, apart from their use: the command line
starts fast.
"""

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Literal

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import can_cache
from congrasp.common.objects.spec import MAX_MESH_PIECES

Unit = Literal["auto", "guess", "m", "cm", "mm", "in"]
Up = Literal["auto", "y", "z"]
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
UNIT_NAMES = {"m": "metres", "cm": "centimetres", "mm": "millimetres", "in": "inches"}
_PLAUSIBLE = (0.01, 0.6)  # m, longest side for which metres are assumed
LONGEST = 1.0
"""Longest side that a unit of the user may give, m."""
_POSSIBLE = (0.005, LONGEST)  # m
_LIKELY = (0.02, 0.4)  # m, longest side for which a unit is proposed
_THINNEST = 2e-4  # m
_MOST = {"scale": "1e9", "density": "25000 kg/m^3", "mass": "50 kg. Give kilograms"}
_MOST |= {"time_limit": "1e6 s", "max_pieces": "1e19"}
_SCALES = ((0.01, 1000.0, "mm"), (1.0, 100.0, "cm"), (1000.0, 1.0, "m"))
"""Upper end of the lengths (m) shown in a unit, number of these units in a metre, and the unit."""
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


@dataclasses.dataclass(frozen=True)
class ImportOptions:
    """Options for converting meshes to objects; the string under a field is its help on the command
    line.
    """

    unit: Unit = "auto"
    """Unit of the files' numbers; auto takes metres if that makes an object of 1 to 60 cm, and asks
    otherwise; guess then takes the unit that fits, if only one does."""
    scale: float = 1.0
    """Factor on the size, after the unit."""
    material: str = ""
    """Material for the mass: aluminium, cardboard, ceramic, cork, glass, paper, plastic, rubber,
    steel or wood; or PART=NAME for parts, such as head=steel,handle=wood. Objects too thick for
    their material are hollow."""
    density: float | None = None
    """Density in kg/m^3, instead of a material. Without both, the mass is 4 kg per m^2 of surface,
    within 500 to 2500 kg/m^3, and at most 0.5 kg."""
    mass: float | None = None
    """Mass in kg; a material or a density then only distributes it."""
    time_limit: float = 60.0
    """Seconds for the convex decomposition (CoACD) of one mesh; V-HACD takes over after it."""
    max_pieces: int = MAX_MESH_PIECES
    """Largest number of convex pieces of an object; more are merged."""
    # And so not in the seed of surface points
    up: Up = dataclasses.field(default="auto", repr=False)
    """Axis that points up in the files, which becomes z: auto takes y for GLB, as glTF prescribes,
    and z for others.
    """
    cache_dir: str = ""
    """Folder that caches finished imports; the user's cache folder if empty."""


def check_options(options: ImportOptions) -> None:
    """Raises a CongraspError for numbers that are not positive or too large, and for both a
    material and a density.

    A cache that cannot be written is logged.
    """
    for name, most in _MOST.items():
        value = getattr(options, name)
        if value is not None and not 0 < value <= float(most.partition(" ")[0]):
            raise CongraspError(
                f"--{name.replace('_', '-')} is {value}.",
                f"It must be positive, and at most {most}.",
            )
    if options.material and options.density is not None:
        raise CongraspError(
            "--material and --density both say how dense it is.", "Leave one of them out."
        )
    if options.cache_dir:
        can_cache(pathlib.Path(options.cache_dir), "--cache-dir")


def metres_per_unit(
    path: object, sides: tuple[float, ...], unit: Unit, scale: float, notes: list[str]
) -> float:
    """Metres per unit of a file, with the scale.

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
    taken: str = "m" if unit in ("auto", "guess") else unit
    longest = max(sides) * scale
    if not longest:
        raise CongraspError(
            f"{path} is a point: all of its corners coincide.", "Check the scales of its nodes."
        )
    low, high = _PLAUSIBLE if unit in ("auto", "guess") else _POSSIBLE
    if not low <= longest * METRES[taken] <= high:
        others = [other for other in ("mm", "cm", "in", "m") if other != taken]
        fitting = [other for other in others if _LIKELY[0] <= longest * METRES[other] <= _LIKELY[1]]
        size = length(longest * METRES[taken])
        if unit != "guess" or len(fitting) != 1:
            options = [
                f"{UNIT_NAMES[u]}, add '--unit {u}' ({length(longest * METRES[u])})"
                for u in fitting
            ]
            fault = "large" if longest * METRES[taken] > high else "small"
            remedy = (
                f"Set '--scale {0.1 / (max(sides) * METRES[taken]):.3g}' for an object of 10 cm."
            )
            if options:
                where = "options of 'objects import' and 'grasp'"
                remedy = f"If they are {'; if '.join(options)}; or set --scale ({where})."
            elif fault == "large":
                remedy = (
                    f"If the file also shows a table or other things, delete them there. {remedy}"
                )
            raise CongraspError(
                f"{path} is {size} long if its numbers are {UNIT_NAMES[taken]}: too {fault} for a "
                f"hand.",
                remedy,
            )
        taken = fitting[0]
        notes.append(
            f"it would be {size} long in metres, so its numbers are taken as {UNIT_NAMES[taken]}: "
            f"{length(longest * METRES[taken])} (if that is wrong, add --unit or --scale)"
        )
    factor = METRES[taken] * scale
    if min(sides) * factor < _THINNEST:
        raise CongraspError(
            f"{path} is flat: it is {length(min(sides) * factor)} thick.",
            "Give it a thickness in a modelling program.",
        )
    return factor


def guessed_unit(path: object, sides: tuple[float, float, float]) -> str:
    """The unit in which a mesh with these sides is an object for a hand; empty unless exactly one
    is likely.

    Raises:
      CongraspError: there is no such unit.
    """
    longest = max(sides)
    if _PLAUSIBLE[0] <= longest <= _PLAUSIBLE[1]:
        return "m"
    fitting = [
        unit for unit, factor in METRES.items() if _LIKELY[0] <= longest * factor <= _LIKELY[1]
    ]
    if not fitting and not any(possible for _, possible in sizes_by_unit(sides).values()):
        raise CongraspError(
            f"{path} is {longest:.4g} units long: in none of {', '.join(METRES)} is that an object "
            f"for a hand.",
            "Scale it in a modelling program.",
        )
    return fitting[0] if len(fitting) == 1 else ""


def sizes_by_unit(sides: tuple[float, float, float]) -> dict[str, tuple[str, bool]]:
    """For each possible unit of a mesh with these sides: its size as text, and True if a hand could
    grasp it.
    """
    return {
        unit: (
            _size([side * factor for side in sides]),
            _POSSIBLE[0] <= max(sides) * factor <= _POSSIBLE[1],
        )
        for unit, factor in METRES.items()
    }


def _size(sides: Sequence[float]) -> str:
    """Formats sides, in m, with the unit that suits the longest."""
    longest = max(sides)
    factor, unit = next(((f, u) for limit, f, u in _SCALES if longest < limit), (1e-3, "km"))
    return f"{' x '.join(f'{side * factor:.3g}' for side in sides)} {unit}"


def length(metres: float) -> str:
    """Formats a length, in m, with a suitable unit."""
    return _size([metres])


def size_in_words(sides: Sequence[float] | np.ndarray) -> str:
    """Formats three sides, in m, as cm, with a common object of similar length."""
    longest = max(sides)
    like = next((name for limit, name in _COMMON if longest < limit), "an arm")
    return f"{' x '.join(f'{100 * side:.1f}' for side in sides)} cm, about as long as {like}"
