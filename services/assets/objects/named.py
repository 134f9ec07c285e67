"""Objects named by a user: object files and their folders, meshes, names, and generator seeds."""

import hashlib
import logging
import pathlib
import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import read_file
from congrasp.common.objects import store
from congrasp.common.objects.procedural import family_turns, generate
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.parallel import parallel_map
from congrasp.common.runtime.progress import Progress, ignore_progress
from congrasp.services.assets.objects.file_kinds import CHECK, MAX_BYTES, SUFFIXES
from congrasp.services.assets.objects.meshes import import_source, import_sources
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.assets.objects.sources import Source, find_sources

_log = logging.getLogger(__name__)
_METRES_OR_ASK = ImportOptions()
_GENERATED = re.compile(r"([^:]+):(\d{1,9})(?:-(\d{1,9}))?")
"""FAMILY:SEED or FAMILY:FIRST-LAST."""


class ObjectAt(NamedTuple):
    """An object at a path, read or imported on demand."""

    name: str
    path: pathlib.Path
    source: Source | None
    """Its meshes; None for an object file, and for an object of the generator."""

    @property
    def is_generated(self) -> bool:
        """True for an object of the generator, whose path is FAMILY:SEED."""
        return not self.source and self.path.suffix != store.SUFFIX

    def load(
        self, options: ImportOptions = _METRES_OR_ASK, progress: Progress = ignore_progress
    ) -> GraspObject:
        """Reads, imports or generates the object; the options and the progress apply to meshes
        alone.

        Raises:
          CongraspError: it cannot be read or imported.
        """
        if self.source:
            return import_source(self.source, options, progress)
        if not self.is_generated:
            return store.load(self.path)
        family, _, seed = str(self.path).partition(":")
        return generate(int(seed), family)

    def digest(self) -> str:
        """Returns a hash of its files' content; FAMILY:SEED for an object of the generator."""
        if not self.source and not self.path.exists():
            return str(self.path)
        files = [self.path]
        if self.source:
            files = [file.path for file in self.source.files()]
        total = hashlib.sha256()
        for file in files:
            total.update(hashlib.sha256(read_file(file, MAX_BYTES, CHECK)).digest())
        return total.hexdigest()


def objects_at(path: pathlib.Path) -> list[ObjectAt]:
    """Finds the objects at a path.

    They are an object file, the object files of a folder, or else meshes (see `find_sources`).
    FAMILY:SEED, such as mug:7, is an object of the generator, and FAMILY:FIRST-LAST are many of
    them, unless a file has that name; the families of a group, such as all:0-999, take turns.

    Raises:
      CongraspError: there is no object at the path.
    """
    generated = _generated_objects(path)
    if generated:
        return generated
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
    entries = objects_at(path)
    if track is None or not any(entry.source for entry in entries):
        return load_each(entries, options)
    return load_each(entries, options, progress=track("Importing objects", len(entries)))


def _raise(entry: ObjectAt, error: CongraspError) -> None:
    raise error


def load_each(
    entries: Sequence[ObjectAt],
    options: ImportOptions = _METRES_OR_ASK,
    *,
    on_error: Callable[[ObjectAt, CongraspError], None] = _raise,
    progress: Callable[[int], None] = lambda done: None,
) -> list[GraspObject]:
    """Loads objects in the given order; meshes are imported in parallel.

    Notes of imports go to the log.

    Args:
      entries: see `objects_at`.
      options: options of the import of meshes.
      on_error: called with each object that cannot be read or imported, and the error; the object
        is skipped unless this raises.
      progress: called with the number of finished meshes.
    """
    objects = _import_each(entries, options, on_error, progress)
    objects.update(_generate_each(entries))
    objects.update(_read_each(entries, on_error))
    return [objects[i] for i in sorted(objects)]


def _import_each(
    entries: Sequence[ObjectAt],
    options: ImportOptions,
    on_error: Callable[[ObjectAt, CongraspError], None],
    progress: Callable[[int], None],
) -> dict[int, GraspObject]:
    """Imports the meshes in parallel; returns the objects by their index among the entries."""
    indices = [i for i, entry in enumerate(entries) if entry.source]
    sources = [entry.source for entry in entries if entry.source]
    if not sources:
        return {}
    objects: dict[int, GraspObject] = {}
    for count, (place, result) in enumerate(import_sources(sources, options), 1):
        index = indices[place]
        if isinstance(result, CongraspError):
            on_error(entries[index], result)
            continue
        for note in result.notes:
            _log.warning("%s: %s", result.name, note)
        objects[index] = result
        progress(count)
    return objects


def _generate_each(entries: Sequence[ObjectAt]) -> dict[int, GraspObject]:
    """Generates objects in parallel; returns them by their index among the entries."""
    indices = [i for i, entry in enumerate(entries) if entry.is_generated]
    objects = parallel_map(ObjectAt.load, [entries[i] for i in indices])
    return dict(zip(indices, objects, strict=True))


def _read_each(
    entries: Sequence[ObjectAt], on_error: Callable[[ObjectAt, CongraspError], None]
) -> dict[int, GraspObject]:
    """Reads the object files; returns the objects by their index among the entries."""
    objects: dict[int, GraspObject] = {}
    for i, entry in enumerate(entries):
        if entry.source or entry.is_generated:
            continue
        try:
            objects[i] = entry.load()
        except CongraspError as error:
            on_error(entry, error)
    return objects


def one_object(path: pathlib.Path, options: ImportOptions = _METRES_OR_ASK) -> GraspObject:
    """Loads the one object of a path; see `objects_at`.

    Raises:
      CongraspError: there is none or there are several, or it cannot be imported.
    """
    entries = objects_at(path)
    if len(entries) > 1:
        raise CongraspError(f"{path} contains {len(entries)} objects.", "Pass one of them.")
    return entries[0].load(options)


def find_object(text: str, folder: str = "objects") -> GraspObject:
    """Loads the one object that a user means (`located`).

    Raises:
      CongraspError: there is no such object, or several.
    """
    return one_object(located(text, folder))


def located(text: str, folder: str = "objects") -> pathlib.Path:
    """Returns the path that a user means, as `objects_at` takes it.

    Args:
      text: a file, a folder, FAMILY:SEED, or the name of an object in `folder`.
      folder: folder of object files.

    Raises:
      CongraspError: there is no such object, or both a path here and an object of the folder have
        the name.
    """
    path = pathlib.Path(text)
    stored = pathlib.Path(folder) / f"{text}{store.SUFFIX}"
    if path.name == text and stored.is_file():
        _check_unambiguous(path, stored, folder)
        return stored
    is_object_file = path.suffix == store.SUFFIX
    is_mesh = path.suffix.lower() in SUFFIXES
    if is_object_file or is_mesh or path.exists() or _generated_objects(path):
        return path
    raise CongraspError(
        f"There is no object '{text}' in {folder}, and no file or folder of that name.",
        "Pass an object of the folder, an object file, a mesh, or FAMILY:SEED such as mug:7.",
    )


def _check_unambiguous(path: pathlib.Path, stored: pathlib.Path, folder: str) -> None:
    """Raises a CongraspError if a path of objects has the name of a stored object."""
    if path.is_dir():
        kind = "folder"
        has_objects = _holds_objects(path)
    else:
        kind = "file"
        has_objects = path.exists()
    if has_objects:
        raise CongraspError(
            f"'{path}' is ambiguous: it is a {kind}, and the name of an object in {folder}.",
            f"Pass ./{path} or {stored}.",
        )


def _holds_objects(folder: pathlib.Path) -> bool:
    """True if a folder holds object files or meshes, or is one of folders with meshes."""
    try:
        return bool(objects_at(folder))
    except CongraspError:
        return any(file.suffix.lower() in SUFFIXES for file in folder.iterdir())


def _generated_objects(path: pathlib.Path) -> list[ObjectAt]:
    """The objects that FAMILY:SEED or FAMILY:FIRST-LAST names; empty for any other text.

    Raises:
      CongraspError: there is no such family, or the last seed comes before the first.
    """
    match = _GENERATED.fullmatch(str(path))
    if not match or path.exists():
        return []
    family_or_group = match[1]
    first = int(match[2])
    last = int(match[3] or match[2])
    if last < first:
        raise CongraspError(
            f"The last seed of '{path}' is below the first.",
            f"Write {family_or_group}:{last}-{first}.",
        )
    seeds = range(first, last + 1)
    families = family_turns(len(seeds), first, (family_or_group,))
    return [
        ObjectAt(f"{family}_{seed}", pathlib.Path(f"{family}:{seed}"), None)
        for family, seed in zip(families, seeds, strict=True)
    ]
