"""Objects that a studio offers, including uploaded meshes, and pictures of their resting poses."""

import dataclasses
import functools
import pathlib
import tempfile
import threading
from collections.abc import Callable, Mapping
from typing import Any, cast

from congrasp.common.errors import CongraspError
from congrasp.common.objects import procedural
from congrasp.common.objects.pool import HELD_OUT_SEED
from congrasp.common.objects.spec import GraspObject
from congrasp.services.assets.objects.mesh_files import read_mesh
from congrasp.services.assets.objects.named import objects_at, one_object
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.assets.objects.units import UNIT_NAMES, Unit, guessed_unit, sizes_by_unit
from congrasp.services.studio.routes import BadRequest, Picture
from congrasp.services.viz.object_sheet import rest_picture
from congrasp.services.viz.sheets import png_of

_FIRST = "mug"  # family of the initial object, unless the user names objects
_MAX_NAME_BYTES = 255  # of Linux
_THUMBNAIL_PIXELS = (150, 112)


class Importer:
    """Makes objects from meshes, as `congrasp objects import` does."""

    def sides(self, path: pathlib.Path) -> tuple[float, float, float]:
        """The sides of a mesh in its own unit; a CongraspError if it cannot be read."""
        x, y, z = read_mesh(path).extents.tolist()
        return x, y, z

    def load(self, path: pathlib.Path, unit: str) -> tuple[GraspObject, list[str]]:
        """The object of a mesh in one of the units m, cm, mm and in, with notes for the user."""
        obj = one_object(path, ImportOptions(unit=cast(Unit, unit)))
        return obj, list(obj.notes)


class Catalogue:
    """Objects to choose from, by name; each is made or imported when it is chosen."""

    def __init__(self, makers: Mapping[str, Callable[[], GraspObject]]):
        """Takes the makers of the objects by name; a studio begins with the first."""
        self._makers = dict(makers)
        self._objects: dict[str, GraspObject] = {}

    @property
    def names(self) -> list[str]:
        """Names of the available objects."""
        return list(self._makers)

    def add(self, name: str, maker: Callable[[], GraspObject]) -> str:
        """Adds an object; returns its name, which has a number if `name` is taken."""
        free_name = name
        number = 2
        while free_name in self._makers:
            free_name = f"{name} ({number})"
            number += 1
        self._makers[free_name] = maker
        return free_name

    def drop(self, name: str) -> None:
        """Removes an object, if there is one of this name."""
        self._makers.pop(name, None)
        self._objects.pop(name, None)

    def get(self, name: str) -> GraspObject:
        """The object; a CongraspError if there is none or it cannot be imported."""
        if name not in self._makers:
            raise CongraspError(
                f"There is no object '{name[:60]}'.", "Choose an object from the list."
            )
        if name not in self._objects:
            self._objects[name] = self._makers[name]()
        return self._objects[name]


def open_catalogue(folder: pathlib.Path | None) -> Catalogue:
    """The user's objects, then one of each procedural family; none is made or imported yet.

    Raises:
      CongraspError: there is nothing at the path.
    """
    makers: dict[str, Callable[[], GraspObject]] = {}
    if folder is not None:
        options = ImportOptions(unit="guess")
        for source in objects_at(folder):
            makers[source.name] = functools.partial(source.load, options)
    for name in sorted(procedural.FAMILIES, key=lambda family: family != _FIRST):
        makers[name] = functools.partial(procedural.generate, HELD_OUT_SEED, name)
    return Catalogue(makers)


@dataclasses.dataclass(frozen=True)
class Upload:
    """An uploaded mesh."""

    path: pathlib.Path
    sides: tuple[float, float, float]
    """In the file's own unit."""
    unit: str = ""
    """Its unit: the user's choice, else the guessed one; empty unless exactly one is likely."""
    notes: tuple[str, ...] = ()
    """Notes of its import for the user."""

    def view(self) -> dict[str, Any]:
        """For the page: the file, its unit, and the size that each unit makes of it."""
        units = [
            {"unit": unit, "name": UNIT_NAMES[unit], "size": size, "possible": possible}
            for unit, (size, possible) in sizes_by_unit(self.sides).items()
        ]
        return {"file": self.path.name, "unit": self.unit, "units": units}


class Uploads:
    """Uploaded meshes by the names of their objects in a catalogue.

    Attributes:
      pending: the upload that waits for its unit, or None.
    """

    def __init__(self, folder: pathlib.Path, catalogue: Catalogue, importer: Importer):
        """Begins without uploads; each file gets a separate folder in the given one."""
        self._folder = folder
        self._catalogue = catalogue
        self._importer = importer
        self._uploads: dict[str, Upload] = {}
        self.pending: Upload | None = None

    def of(self, name: str) -> Upload | None:
        """The upload that waits for its unit, else that of an object, else None."""
        return self.pending or self._uploads.get(name)

    def take(self, name: str, body: bytes) -> Upload:
        """Stores the file of a mesh and guesses its unit.

        Raises:
          BadRequest: `name` is no file name.
          CongraspError: the file is empty or cannot be read, or a hand could grasp the mesh in no
            unit.
        """
        name = pathlib.PurePosixPath(name.replace("\\", "/")).name or "mesh"
        if name == ".." or not name.isprintable() or len(name.encode()) > _MAX_NAME_BYTES:
            raise BadRequest(f"{ascii(name)[:60]} is not a file name.")
        if not body:
            raise CongraspError(f"{name} is empty (0 bytes).", "Export or download it again.")
        path = pathlib.Path(tempfile.mkdtemp(dir=self._folder)) / name
        path.write_bytes(body)
        try:
            sides = self._importer.sides(path)
            return Upload(path, sides, guessed_unit(name, sides))
        except CongraspError as error:
            raise self._without_path(error, path) from None

    def load(self, upload: Upload, unit: str, replaces: str = "") -> str:
        """Imports a mesh in a unit; returns the name of its object.

        Args:
          upload: the mesh.
          unit: m, cm, mm or in.
          replaces: name of the object that an earlier import made of it.

        Raises:
          CongraspError: the mesh cannot be imported, or is too large or too small for a hand.
        """
        try:
            obj, notes = self._importer.load(upload.path, unit)
        except CongraspError as error:
            raise self._without_path(error, upload.path) from None
        if replaces in self._uploads:
            self._catalogue.drop(replaces)
            del self._uploads[replaces]
        name = self._catalogue.add(obj.name, lambda: obj)
        self._uploads[name] = dataclasses.replace(upload, unit=unit, notes=tuple(notes))
        self.pending = None
        return name

    def _without_path(self, error: CongraspError, path: pathlib.Path) -> CongraspError:
        """The error with the file's name in place of its path on the server."""
        return CongraspError(str(error).replace(str(path), path.name))


class Thumbnails:
    """Pictures of the resting poses of one object at a time."""

    def __init__(self) -> None:
        """Renders nothing yet."""
        self._lock = threading.Lock()
        self._object: GraspObject | None = None
        self._drawn: dict[int, Picture] = {}

    def picture(self, obj: GraspObject, rest: int) -> Picture:
        """An object in one of its resting poses, from 0; raises a CongraspError if there is none of
        this number.
        """
        if not 0 <= rest < len(obj.rest_poses):
            raise CongraspError(
                f"The object '{obj.name}' has no resting pose {rest + 1}.",
                "Choose one of its resting poses.",
            )
        with self._lock:
            if self._object is not obj:
                self._object = obj
                self._drawn = {}
            if rest not in self._drawn:
                self._drawn[rest] = Picture(png_of(rest_picture(obj, rest, _THUMBNAIL_PIXELS)))
            return self._drawn[rest]
