"""Options for converting meshes to objects.

They are apart from their use, so that the command line starts fast.
"""

import dataclasses
import pathlib
from typing import Literal

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import can_cache
from congrasp.common.objects.spec import MAX_MESH_PIECES
from congrasp.services.assets.objects.units import Unit

Up = Literal["auto", "y", "z"]
_LIMITS = {
    "scale": "1e9",
    "density": "25000 kg/m^3",
    "mass": "50 kg. Give kilograms",
    "max_pieces": "1e19",
}
"""Largest value of each option, and its unit for the message."""


@dataclasses.dataclass(frozen=True)
class ImportOptions:
    """Options for converting meshes to objects.

    The string under a field is its help on the command line.
    """

    unit: Unit = "auto"
    """Unit of the files' coordinates. auto: metres if the object is then 1 to 60 cm long, else an
    error that proposes a unit. guess: as auto, but if exactly one unit gives a likely size, that
    unit."""
    scale: float = 1.0
    """Factor on the size, in addition to the unit."""
    material: str = ""
    """Material for the mass: aluminium, cardboard, ceramic, cork, glass, paper, plastic, rubber,
    steel or wood; or PART=NAME for parts, such as head=steel,handle=wood. A body thicker than is
    usual for its material is taken as hollow."""
    density: float | None = None
    """Density in kg/m^3, instead of a material. Without density and material, the mass is 4 kg per
    m^2 of surface, limited to 500 to 2500 kg/m^3 and to 0.5 kg."""
    mass: float | None = None
    """Mass in kg. A material or a density then only determines its distribution."""
    max_pieces: int = MAX_MESH_PIECES
    """Maximum number of convex pieces of an object; further pieces are merged."""
    # And so not in the seed of surface points
    up: Up = dataclasses.field(default="auto", repr=False)
    """Axis that points up in the files, which becomes z: auto takes y for GLB, as glTF prescribes,
    and z for others.
    """
    cache_dir: str = ""
    """Folder that caches finished imports; the user's cache folder if empty."""


def check_options(options: ImportOptions) -> None:
    """Checks the numbers of an import, and that its cache can be written.

    A cache that cannot be written is logged.

    Raises:
      CongraspError: a number is not positive or too large, or there are both a material and a
        density.
    """
    for name, limit in _LIMITS.items():
        value = getattr(options, name)
        number = float(limit.partition(" ")[0])
        if value is not None and not 0 < value <= number:
            option = name.replace("_", "-")
            raise CongraspError(
                f"--{option} is {value}.", f"It must be positive, and at most {limit}."
            )
    if options.material and options.density is not None:
        raise CongraspError(
            "--material and --density are mutually exclusive.", "Leave one of them out."
        )
    if options.cache_dir:
        can_cache(pathlib.Path(options.cache_dir), "--cache-dir")
