"""How meshes become objects: what a user may set, apart from what does it, so that the command line starts at once."""

import dataclasses

from congrasp.common.errors import CongraspError
from congrasp.common.objects.spec import MAX_MESH_PIECES
from congrasp.services.assets.objects.sizes import Unit


@dataclasses.dataclass(frozen=True)
class ImportOptions:
    """How meshes become objects; the string under a field is its help on the command line."""

    unit: Unit = "auto"
    """Unit of the files' numbers; auto takes metres if that makes an object of 1 to 60 cm, and asks otherwise; guess
    then takes the unit that fits, if only one does."""
    scale: float = 1.0
    """Factor on the size, after the unit."""
    density: float = 500.0
    """kg/m^3, for the mass where none is given; that mass is kept between 0.05 and 0.5 kg."""
    mass: float | None = None
    """Mass in kg."""
    time_limit: float = 60.0
    """Seconds for the convex decomposition (CoACD) of one mesh; V-HACD takes over after it."""
    max_pieces: int = MAX_MESH_PIECES
    """Most convex pieces of an object; more are merged."""
    cache_dir: str = ""
    """Folder that remembers finished imports; empty means the user's cache folder."""


def check_options(options: ImportOptions) -> None:
    """Raises a CongraspError for numbers that are not positive."""
    for name in ("scale", "density", "time_limit", "max_pieces"):
        if not getattr(options, name) > 0:
            raise CongraspError(f"--{name.replace('_', '-')} is {getattr(options, name)}.", "It must be positive.")
    if options.mass is not None and not options.mass > 0:
        raise CongraspError(f"--mass is {options.mass}.", "It must be positive, in kilograms.")
