"""Objects named by a user: object files, folders of them, meshes to import, names, and seeds of the
generator.

The meshes at a path are those of single objects, of decomposed ones, or of objects in part files
(`find_sources`).
"""

import dataclasses
import hashlib
import logging
import os
import pathlib
import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import distinct_names, read_file, safe_name
from congrasp.common.objects import store
from congrasp.common.objects.procedural import family_turns, generate
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.parallel import parallel_map
from congrasp.services.assets.objects.mesh_files import (
    CHECK,
    CONVERT,
    MAX_BYTES,
    SUFFIXES,
    read_mesh,
)
from congrasp.services.assets.objects.meshes import MeshFile, Source, import_source, import_sources
from congrasp.services.assets.objects.options import ImportOptions

_log = logging.getLogger(__name__)
_METRES_OR_ASK = ImportOptions()


_GRASPABLE_WORDS = ("handle", "grip", "neck", "stem", "shaft", "body")
# GraspXL marks the absence of a non-graspable part by a cube of 1 cm at this position (m).
_NO_PART = 0.346408


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
        contents = (read_file(file, MAX_BYTES, CHECK) for file in files)
        return hashlib.sha256(
            b"".join(hashlib.sha256(content).digest() for content in contents)
        ).hexdigest()


def objects_at(path: pathlib.Path) -> list[ObjectAt]:
    """Objects at a path: an object file, the object files of a folder, or else meshes (see
    `find_sources`).

    FAMILY:SEED, such as mug:7, is an object of the generator, and FAMILY:FIRST-LAST are many of
    them, unless a file has that name; the families of a group, such as all:0-999, take turns.

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
    """Loads objects in the given order; meshes are imported in parallel, and notes of imports go to
    the log.

    Args:
      found: see `objects_at`.
      options: options of the import of meshes.
      on_error: called with each object that cannot be read or imported, and the error; the object
        is skipped unless this raises.
      progress: called with the number of finished meshes.
    """
    sources = {i: one.source for i, one in enumerate(found) if one.source}
    indices, objects = list(sources), dict[int, GraspObject]()
    for done, (n, obj) in enumerate(
        import_sources(list(sources.values()), options) if sources else (), 1
    ):
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


def located(text: str, folder: str = "objects") -> pathlib.Path:
    """The path that a user means for `objects_at`: a file, a folder, FAMILY:SEED, or the file of a
    name in `folder`.

    Raises:
      CongraspError: there is no such object, or both a path here and an object of the folder have
        the name.
    """
    path, stored = pathlib.Path(text), pathlib.Path(folder) / f"{text}{store.SUFFIX}"
    is_name = path.name == text and stored.is_file()
    if is_name and (_holds_objects(path) if path.is_dir() else path.exists()):
        raise CongraspError(
            f"'{text}' is a {'folder' if path.is_dir() else 'file'} here, and an object in "
            f"{folder}.",
            f"Pass ./{text} or {stored}.",
        )
    if is_name:
        return stored
    if (
        path.suffix == store.SUFFIX
        or path.suffix.lower() in SUFFIXES
        or path.exists()
        or _generated(path)
    ):
        return path
    raise CongraspError(
        f"There is no object '{text}' in {folder}, and no file or folder of that name.",
        "Name an object of the folder, an object file, a mesh, or FAMILY:SEED such as mug:7.",
    )


def _holds_objects(folder: pathlib.Path) -> bool:
    """True if a folder holds object files or meshes, or is one of folders with meshes."""
    try:
        return bool(objects_at(folder))
    except CongraspError:
        return any(file.suffix.lower() in SUFFIXES for file in folder.iterdir())


def find_object(text: str, folder: str = "objects") -> GraspObject:
    """The one object that a user means (`located`).

    Raises:
      CongraspError: there is no such object, or several.
    """
    return one_object(located(text, folder))


def _generated(path: pathlib.Path) -> list[ObjectAt]:
    """The objects of the generator named by FAMILY:SEED or FAMILY:FIRST-LAST; empty for any other
    text.

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


def find_sources(path: str | os.PathLike[str]) -> list[Source]:
    """Finds the objects at a path.

    * A mesh file (STL, OBJ, PLY, GLB) is one object.
    * A folder with `graspable.*` and `non_graspable.*` (or `top*` and `bottom*`) is one object of
      two parts.
    * A folder with `contact*` files is one object that is already cut into convex pieces. Its other
      meshes show it: `<name>.stl` the whole, `<name>_<part>.stl` its parts.
    * A folder with `<name>.*` and at least two `<name>_<part>.*` is one object with labelled parts.
    * In any other folder every mesh is an object; a folder without meshes stands for its
      subfolders. Names that repeat have numbers.

    Raises:
      CongraspError: there is nothing to import.
    """
    path = pathlib.Path(path)
    if path.is_file():
        return [_single(path)]
    if not path.is_dir():
        raise CongraspError(f"There is no file or folder {path}.", "Check the path.")
    meshes = _meshes_in(path)
    if not meshes:
        found = [
            source
            for folder in sorted(path.iterdir())
            if folder.is_dir()
            for source in _nested(folder)
        ]
        if not found:
            files = (file for depth in ("*/*/*", "*/*/*/*") for file in sorted(path.glob(depth)))
            if deeper := next(
                (file for file in files if _shows(file.relative_to(path)) and file.is_file()), None
            ):
                fault = f"The folder {path} holds meshes deeper inside alone, such as {deeper}."
                raise CongraspError(fault, "Name the folders in which they are.")
            raise CongraspError(f"The folder {path} holds no STL, OBJ, PLY or GLB file.", CONVERT)
        return distinct(found)
    return distinct(_in_folder(path, meshes))


def distinct(sources: Sequence[Source]) -> list[Source]:
    """The sources with distinct names."""
    names = distinct_names(source.name for source in sources)
    return [
        dataclasses.replace(source, name=name) for source, name in zip(sources, names, strict=True)
    ]


def _meshes_in(folder: pathlib.Path) -> list[pathlib.Path]:
    """The meshes directly in a folder, without hidden files, such as those that macOS adds."""
    return sorted(file for file in folder.iterdir() if _shows(file.relative_to(folder)))


def _shows(path: pathlib.Path) -> bool:
    """True for a mesh's path without hidden parts."""
    return path.suffix.lower() in SUFFIXES and not any(
        part.startswith((".", "__MACOSX")) for part in path.parts
    )


def _nested(folder: pathlib.Path) -> list[Source]:
    """The objects of the meshes directly in a folder, without those of folders below it."""
    meshes = _meshes_in(folder)
    return _in_folder(folder, meshes) if meshes else []


def _in_folder(folder: pathlib.Path, meshes: list[pathlib.Path]) -> list[Source]:
    """The objects of a folder with these meshes."""
    name = safe_name(folder.resolve().name)
    two = _two_parts(meshes)
    if two:
        return [Source(name, folder, two, (), two)]
    pieces = tuple(MeshFile(file, "piece") for file in meshes if file.stem.startswith("contact"))
    others = [file for file in meshes if not file.stem.startswith("contact")]
    main = next(
        (file for file in others if all(o == file or _names_part(file, o) for o in others)), None
    )
    if not pieces and (main is None or len(others) == 2):
        return list(map(_single, others))
    if others and main is None:
        raise CongraspError(
            f"The folder {folder} has contact pieces, but it is not clear which mesh shows the "
            f"whole object.",
            f"Name it {name}{others[0].suffix} and its parts {name}_<part>{others[0].suffix}.",
        )
    visuals = (MeshFile(main, "visual"),) if main else ()
    parts = tuple(
        _part(file, file.stem[len(main.stem) :].strip("_- "))
        for file in others
        if main and file != main
    )
    return [Source(name, folder, visuals, pieces, parts if len(parts) > 1 else ())]


def _single(file: pathlib.Path) -> Source:
    """The object of one mesh file."""
    return Source(safe_name(file.stem), file, (MeshFile(file, "visual"),))


def _names_part(whole: pathlib.Path, file: pathlib.Path) -> bool:
    """True if a file is named as a part of the object in another one."""
    return file.stem.startswith(tuple(whole.stem + mark for mark in "_- "))


def _part(file: pathlib.Path, part: str) -> MeshFile:
    """The file of a part, which is graspable if its name is that of a handle."""
    return MeshFile(file, "part", part, any(word in part.lower() for word in _GRASPABLE_WORDS))


def _two_parts(meshes: list[pathlib.Path]) -> tuple[MeshFile, ...]:
    """The graspable file and, if there is one, the non-graspable one; empty without a graspable
    file.
    """
    found: dict[bool, pathlib.Path] = {}
    for file in meshes:
        stem = file.stem.lower()
        if stem == "graspable" or stem.startswith("top"):
            found.setdefault(True, file)
        elif stem == "non_graspable" or stem.startswith("bottom"):
            found.setdefault(False, file)
    if True not in found:
        return ()
    if False in found and np.allclose(read_mesh(found[False]).bounds.mean(0), _NO_PART, atol=0.01):
        del found[False]
    names = {True: "graspable", False: "non-graspable"}
    return tuple(
        MeshFile(found[key], "part", names[key], key) for key in (True, False) if key in found
    )
