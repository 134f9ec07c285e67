"""Objects named by a user: object files, folders of them, meshes to import, names, and seeds of the generator."""

import hashlib
import logging
import pathlib
import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

from congrasp.common.errors import CongraspError
from congrasp.common.objects import store
from congrasp.common.objects.procedural import family_turns, generate
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.parallel import parallel_map
from congrasp.services.assets.objects.mesh_files import SUFFIXES
from congrasp.services.assets.objects.meshes import import_source, import_sources
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.assets.objects.sources import Source, find_sources

_log = logging.getLogger(__name__)
_METRES_OR_ASK = ImportOptions()


class ObjectAt(NamedTuple):
    """An object at a path, read or imported on demand."""

    name: str
    path: pathlib.Path
    source: Source | None
    """Its meshes; None for an object file, and for an object of the generator."""

    def load(self, options: ImportOptions = _METRES_OR_ASK) -> GraspObject:
        """The object; the options apply to meshes alone.

        Raises:
          CongraspError: it cannot be read or imported.
        """
        if self.source:
            return import_source(self.source, options)
        if self.path.suffix == store.SUFFIX:
            return store.load(self.path)
        family, _, seed = str(self.path).partition(":")
        return generate(int(seed), family)

    def digest(self) -> str:
        """A hash of its files' content; for an object of the generator its family and seed."""
        if not self.source and not self.path.exists():
            return str(self.path)
        files = [file.path for file in self.source.files()] if self.source else [self.path]
        return hashlib.sha256(b"".join(hashlib.sha256(file.read_bytes()).digest() for file in files)).hexdigest()


def objects_at(path: pathlib.Path) -> list[ObjectAt]:
    """Objects at a path: an object file, the object files of a folder, or else meshes (see `find_sources`).

    FAMILY:SEED, such as mug:7, is an object of the generator, and FAMILY:FIRST-LAST are many of them, unless a file has
    that name; the families of a group, such as all:0-999, take turns.

    Raises:
      CongraspError: there is no object at the path.
    """
    if made := _generated(path):
        return made
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
    """Loads every object of a path; notes of imports go to the log.

    Args:
      path: see `objects_at`.
      options: options of the import of meshes.
      track: (label, total) -> function to call with the number of finished imports.

    Raises:
      CongraspError: there is no object at the path, or one cannot be read or imported.
    """
    found = objects_at(path)
    if track is None or not any(one.source for one in found):
        return load_each(found, options)
    return load_each(found, options, progress=track("Importing objects", len(found)))


def _refuse(one: ObjectAt, error: CongraspError) -> None:
    raise error


def load_each(
    found: Sequence[ObjectAt],
    options: ImportOptions = _METRES_OR_ASK,
    *,
    on_error: Callable[[ObjectAt, CongraspError], None] = _refuse,
    progress: Callable[[int], None] = lambda done: None,
) -> list[GraspObject]:
    """Loads objects in the given order; meshes are imported in parallel, and notes of imports go to the log.

    Args:
      found: see `objects_at`.
      options: options of the import of meshes.
      on_error: called with each object that cannot be read or imported, and the error; the object is skipped unless
        this raises.
      progress: called with the number of finished meshes.
    """
    sources = {i: one.source for i, one in enumerate(found) if one.source}
    indices, objects = list(sources), dict[int, GraspObject]()
    for done, (n, obj) in enumerate(import_sources(list(sources.values()), options) if sources else (), 1):
        if isinstance(obj, CongraspError):
            on_error(found[indices[n]], obj)
            continue
        for note in obj.notes:
            _log.warning("%s: %s", obj.name, note)
        objects[indices[n]] = obj
        progress(done)
    drawn = [i for i, one in enumerate(found) if not one.source and one.path.suffix != store.SUFFIX]
    objects |= zip(drawn, parallel_map(ObjectAt.load, [found[i] for i in drawn]), strict=True)
    for i in sorted(set(range(len(found))) - set(sources) - set(drawn)):
        try:
            objects[i] = found[i].load(options)
        except CongraspError as error:
            on_error(found[i], error)
    return [objects[i] for i in sorted(objects)]


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
    if path.suffix == store.SUFFIX or path.suffix.lower() in SUFFIXES or path.is_dir() or _generated(path):
        return one_object(path)
    catalogue = store.Catalogue(folder)
    if not catalogue.path(text).is_file():
        raise CongraspError(
            f"There is no object '{text}' in {folder}.",
            "Name an object of the folder, an object file, a mesh, or FAMILY:SEED such as mug:7.",
        )
    return catalogue.get(text)


def _generated(path: pathlib.Path) -> list[ObjectAt]:
    """The objects of the generator named by FAMILY:SEED or FAMILY:FIRST-LAST; empty for any other text.

    Raises:
      CongraspError: there is no such family, or the last seed comes before the first.
    """
    text = re.fullmatch(r"([^:]+):(\d{1,9})(?:-(\d{1,9}))?", str(path))
    if not text or path.exists():
        return []
    first, last = int(text[2]), int(text[3] or text[2])
    if last < first:
        raise CongraspError(f"'{path}' ends before it begins.", f"Write {text[1]}:{last}-{first}.")
    seeds = range(first, last + 1)
    families = family_turns(len(seeds), first, (text[1],))
    return [
        ObjectAt(f"{family}_{seed}", pathlib.Path(f"{family}:{seed}"), None)
        for family, seed in zip(families, seeds, strict=True)
    ]
