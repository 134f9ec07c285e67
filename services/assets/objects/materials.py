"""Materials of objects, and the option that names them."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError

_CALLISTER = "Callister and Rethwisch, Materials Science and Engineering, table B.1"
_CRC = "CRC Handbook of Chemistry and Physics, Density of Various Solids"
_WOOD = "USDA Forest Service, Wood Handbook, FPL-GTR-282, table 5-3"
_OTHER_PARTS = ""
"""Key of the material without a part in `--material`, which is for all parts not named there."""


class Material(NamedTuple):
    """A material of household objects. The two thicknesses are estimates for ordinary cups, bottles
    and boxes.
    """

    density: float
    """kg/m^3."""
    wall: float
    """Thickness of the wall of a hollow object, m."""
    thickest_solid: float
    """Largest mean thickness (`masses.mean_thickness`) of a solid object, m. A thicker object is
    hollow.
    """
    source: str
    """Source of the density."""


MATERIALS: Mapping[str, Material] = {
    "aluminium": Material(2700.0, 0.0015, 0.008, f"{_CALLISTER}: alloy 6061"),
    "cardboard": Material(690.0, 0.0015, 0.003, f"{_CRC}: cardboard"),
    "ceramic": Material(2400.0, 0.004, 0.008, f"{_CRC}: porcelain, 2,300 to 2,500"),
    "cork": Material(240.0, 0.01, np.inf, f"{_CRC}: cork, 220 to 260"),
    "glass": Material(2500.0, 0.003, 0.008, f"{_CALLISTER}: soda-lime glass"),
    "paper": Material(900.0, 0.001, np.inf, f"{_CRC}: paper, 700 to 1,150"),
    "plastic": Material(1050.0, 0.002, 0.006, f"{_CALLISTER}: polystyrene, 1,040 to 1,050"),
    "rubber": Material(1100.0, 0.003, 0.015, f"{_CRC}: rubber, soft commercial"),
    "steel": Material(7850.0, 0.001, 0.012, f"{_CALLISTER}: plain carbon steel"),
    "wood": Material(640.0, 0.01, np.inf, f"{_WOOD}: American beech, 12 % moisture"),
}
"""Materials by name."""


def materials_of(text: str, parts: Sequence[str]) -> tuple[Material, ...]:
    """Returns the material of each part.

    Args:
      text: a material such as "steel", or PART=NAME for parts, such as "head=steel,handle=wood"; a
        name alone is for the other parts.
      parts: names of the object's parts, in the order of the result; an empty name for an object
        without labelled parts.

    Raises:
      CongraspError: unknown material or part, or a part without material.
    """
    entries = [_entry(entry) for entry in text.split(",")]
    material_by_part = dict(entries)
    if len(material_by_part) < len(entries):
        raise CongraspError(
            f"--material assigns two materials to one part: '{text}'.",
            "Pass one material, or PART=NAME for each part.",
        )
    unknown = sorted(material_by_part.keys() - {_OTHER_PARTS, *parts})
    if unknown:
        named_parts = [part for part in parts if part]
        remedy = "Pass one material without a part: the object has no labelled parts."
        if named_parts:
            remedy = f"Its parts are: {', '.join(named_parts)}."
        raise CongraspError(
            f"--material names the part '{unknown[0]}', which the object does not have.", remedy
        )
    materials = []
    for part in parts:
        material = material_by_part.get(part) or material_by_part.get(_OTHER_PARTS)
        if material is None:
            raise CongraspError(
                f"--material has no material for the part '{part}'.", _missing_remedy(part)
            )
        materials.append(material)
    return tuple(materials)


def _missing_remedy(part: str) -> str:
    """Remedy for a part without material."""
    if part:
        return f"Add {part}=NAME."
    return "Add a material without a part: this part has no name."


def _entry(text: str) -> tuple[str, Material]:
    """Part (`_OTHER_PARTS` without one) and material of one entry of `--material`."""
    part, _, name = text.strip().rpartition("=")
    if not part:
        name = text.strip()  # the whole entry, so that '=wood' is an unknown name
    if name not in MATERIALS:
        raise CongraspError(
            f"--material is '{name}'.", f"Choose from the materials {', '.join(MATERIALS)}."
        )
    return part, MATERIALS[name]
