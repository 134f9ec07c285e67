"""Objects that a user points to: object files, folders of them, meshes to import, names, and seeds of the generator."""

import logging
import pathlib
from collections.abc import Callable
from typing import NamedTuple

from common.errors import CongraspError
from common.objects import store
from common.objects.procedural import generate
from common.objects.spec import GraspObject
from services.assets.objects.meshes import import_source, import_sources
from services.assets.objects.options import ImportOptions
from services.assets.objects.sources import SUFFIXES, Source, find_sources

_log = logging.getLogger(__name__)
_METRES_OR_ASK = ImportOptions()


class ObjectAt(NamedTuple):
    """An object that a path holds, read or imported only when it is wanted."""

    name: str
    path: pathlib.Path
    source: Source | None
    """Its meshes; None for an object file, and for an object of the generator."""

    def load(self, options: ImportOptions = _METRES_OR_ASK) -> GraspObject:
        """The object; an object file is taken as it is.

        Raises:
          CongraspError: it cannot be read or imported.
        """
        if self.source:
            return import_source(self.source, options)
        return _generated(self.path) or store.load(self.path)


def objects_at(path: pathlib.Path) -> list[ObjectAt]:
    """What a path holds: an object file, the object files of a folder, or else meshes (see `find_sources`).

    FAMILY:SEED, such as mug:7, is an object of the generator, where no file has that name.

    Raises:
      CongraspError: there is nothing of the kind.
    """
    if made := _generated(path):
        return [ObjectAt(made.name, path, None)]
    files = [path] if path.suffix == store.SUFFIX else sorted(path.glob(f"*{store.SUFFIX}"))
    if files:
        return [ObjectAt(file.stem, file, None) for file in files]
    return [ObjectAt(source.name, source.path, source) for source in find_sources(path)]


def objects_of(
    path: pathlib.Path,
    options: ImportOptions = _METRES_OR_ASK,
    *,
    track: Callable[[str, int | None], Callable[[int], None]] | None = None,
) -> list[GraspObject]:
    """Every object of a path; what an import has to say goes to the log.

    Args:
      path: see `objects_at`.
      options: how meshes become objects.
      track: (what is done, how much) -> what is told how much is done; import may take long.

    Raises:
      CongraspError: there is nothing of the kind, or it cannot be read or imported.
    """
    found = objects_at(path)
    sources = [one.source for one in found if one.source]
    if not sources:
        return [one.load(options) for one in found]
    advance = track("Importing objects", len(found)) if track else lambda done: None
    objects: dict[int, GraspObject] = {}
    for i, obj in import_sources(sources, options):
        if isinstance(obj, CongraspError):
            raise obj
        for note in obj.notes:
            _log.warning("%s: %s", obj.name, note)
        objects[i] = obj
        advance(len(objects))
    return [objects[i] for i in range(len(objects))]


def one_object(path: pathlib.Path, options: ImportOptions = _METRES_OR_ASK) -> GraspObject:
    """The one object of a path; see `objects_at`.

    Raises:
      CongraspError: there is none or there are several, or it cannot be imported.
    """
    found = objects_at(path)
    if len(found) > 1:
        raise CongraspError(f"{path} holds {len(found)} objects.", "Name one of them.")
    return found[0].load(options)


def find_object(text: str, folder: str = "objects") -> GraspObject:
    """The object that a user means: an object file, a mesh, FAMILY:SEED, or a name in a folder.

    Raises:
      CongraspError: there is no such object.
    """
    path = pathlib.Path(text)
    if path.suffix == store.SUFFIX or path.suffix.lower() in SUFFIXES or path.is_dir():
        return one_object(path)
    if made := _generated(path):
        return made
    catalogue = store.Catalogue(folder)
    if not catalogue.path(text).is_file():
        raise CongraspError(
            f"There is no object '{text}' in {folder}.",
            "Name an object of the folder, an object file, a mesh, or FAMILY:SEED such as mug:7.",
        )
    return catalogue.get(text)


def _generated(path: pathlib.Path) -> GraspObject | None:
    """The object of the generator that FAMILY:SEED means; None for any other text."""
    family, colon, seed = str(path).partition(":")
    return generate(int(seed), family) if colon and seed.isdigit() and not path.exists() else None
