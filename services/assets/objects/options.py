"""Options for converting meshes to objects, separate from their use, so that the command line starts quickly."""

import dataclasses
import pathlib

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import can_cache
from congrasp.common.objects.spec import MAX_MESH_PIECES
from congrasp.services.assets.objects.sizes import Unit, Up


@dataclasses.dataclass(frozen=True)
class ImportOptions:
    """Options for converting meshes to objects; the string under a field is its help on the command line."""

    unit: Unit = "auto"
    """Unit of the files' numbers; auto takes metres if that makes an object of 1 to 60 cm, and asks otherwise; guess
    then takes the unit that fits, if only one does."""
    scale: float = 1.0
    """Factor on the size, after the unit."""
    material: str = ""
    """Material for the mass: aluminium, cardboard, ceramic, cork, glass, paper, plastic, rubber, steel or wood; or
    PART=NAME for parts, such as head=steel,handle=wood. Objects too thick for their material are hollow."""
    density: float | None = None
    """Density in kg/m^3, instead of a material. Without both, the mass is 4 kg per m^2 of surface, within 500 to 2500
    kg/m^3, and at most 0.5 kg."""
    mass: float | None = None
    """Mass in kg; a material or a density then only distributes it."""
    time_limit: float = 60.0
    """Seconds for the convex decomposition (CoACD) of one mesh; V-HACD takes over after it."""
    max_pieces: int = MAX_MESH_PIECES
    """Largest number of convex pieces of an object; more are merged."""
    up: Up = dataclasses.field(default="auto", repr=False)  # and so not in the seed of surface points
    """Axis that points up in the files, which becomes z: auto takes y for GLB, as glTF prescribes, and z for others."""
    cache_dir: str = ""
    """Folder that caches finished imports; the user's cache folder if empty."""


def check_options(options: ImportOptions) -> None:
    """Raises a CongraspError for numbers that are not positive, and for both a material and a density.

    A cache that cannot be written is logged.
    """
    for name in ("scale", "density", "time_limit", "max_pieces"):
        value = getattr(options, name)
        if value is not None and not value > 0:
            raise CongraspError(f"--{name.replace('_', '-')} is {value}.", "It must be positive.")
    if options.mass is not None and not options.mass > 0:
        raise CongraspError(f"--mass is {options.mass}.", "It must be positive, in kilograms.")
    if options.material and options.density is not None:
        raise CongraspError("--material and --density both say how dense it is.", "Leave one of them out.")
    if options.cache_dir:
        can_cache(pathlib.Path(options.cache_dir), "--cache-dir")
