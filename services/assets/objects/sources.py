"""Sources of objects: the mesh files of a folder, grouped to objects by their names."""

import dataclasses
import os
import pathlib
from collections.abc import Sequence
from typing import Literal

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import distinct_names, safe_name
from congrasp.services.assets.objects.file_kinds import CONVERT, SUFFIXES
from congrasp.services.assets.objects.mesh_files import read_mesh

_GRASPABLE_WORDS = ("handle", "grip", "neck", "stem", "shaft", "body")
_NO_PART_POSITION_M = 0.346408
"""Coordinates (m) of the 1 cm cube by which GraspXL marks the absence of a non-graspable part."""
_NO_PART_TOLERANCE = 0.01


@dataclasses.dataclass(frozen=True)
class MeshFile:
    """One mesh of an object."""

    path: pathlib.Path
    role: Literal["visual", "piece", "part"]
    part: str = ""
    """Name of the part that it shows."""
    graspable: bool = True
    """True if that part may be grasped."""


@dataclasses.dataclass(frozen=True)
class Source:
    """The files of one object."""

    name: str
    path: pathlib.Path
    visuals: tuple[MeshFile, ...]
    """The surface; the part files if they form the surface together."""
    pieces: tuple[MeshFile, ...] = ()
    """Convex pieces, if it is already decomposed."""
    parts: tuple[MeshFile, ...] = ()
    """Meshes of the parts of the surface."""

    @property
    def parts_are_pieces(self) -> bool:
        """True if the part files together are the object.

        No collision piece then spans two of them.
        """
        return bool(self.parts) and self.visuals == self.parts

    def files(self) -> tuple[MeshFile, ...]:
        """Returns all files, without repetition."""
        return tuple(dict.fromkeys(self.visuals + self.pieces + self.parts))


def find_sources(path: str | os.PathLike[str]) -> list[Source]:
    """Finds the objects at a path.

    * A mesh file (STL, OBJ, PLY, GLB) is one object.
    * A folder with `graspable.*` and `non_graspable.*` (or `top*` and `bottom*`) is one object of
      two parts.
    * A folder with `contact*` files is one object that is already cut into convex pieces. Its other
      meshes are its surface: `<name>.stl` all of it, `<name>_<part>.stl` its parts.
    * A folder with `<name>.*` and at least two `<name>_<part>.*` is one object with labelled parts.
    * In any other folder every mesh is an object; without meshes, the objects are those of its
      subfolders.

    An object has the name of its file or folder. Names that repeat get numbers.

    Raises:
      CongraspError: there is nothing to import.
    """
    return with_distinct_names(find_unnumbered_sources(path))


def find_unnumbered_sources(path: str | os.PathLike[str]) -> list[Source]:
    """Finds the objects at a path as `find_sources` does, without numbers in names that repeat.

    Raises:
      CongraspError: there is nothing to import.
    """
    path = pathlib.Path(path)
    if path.is_file():
        return [_single(path)]
    if not path.is_dir():
        raise CongraspError(f"There is no file or folder {path}.", "Check the path.")
    meshes = _meshes_in(path)
    if meshes:
        return _in_folder(path, meshes)
    sources: list[Source] = []
    for folder in sorted(path.iterdir()):
        if folder.is_dir():
            sources += _in_subfolder(folder)
    if not sources:
        raise _nothing_found(path)
    return sources


def with_distinct_names(sources: Sequence[Source]) -> list[Source]:
    """Returns the sources with distinct names: repeated ones get numbers, such as mug-2."""
    names = distinct_names(source.name for source in sources)
    return [
        dataclasses.replace(source, name=name) for source, name in zip(sources, names, strict=True)
    ]


def _nothing_found(folder: pathlib.Path) -> CongraspError:
    """The error of a folder without objects, which names a mesh that lies too deep."""
    for depth in ("*/*/*", "*/*/*/*"):
        for file in sorted(folder.glob(depth)):
            if _is_visible_mesh(file.relative_to(folder)) and file.is_file():
                fault = f"The folder {folder} has meshes only in deeper subfolders, such as {file}."
                return CongraspError(fault, "Pass the folders that contain the meshes.")
    return CongraspError(f"The folder {folder} contains no STL, OBJ, PLY or GLB file.", CONVERT)


def _meshes_in(folder: pathlib.Path) -> list[pathlib.Path]:
    """The meshes directly in a folder, without hidden files, such as those that macOS adds."""
    return sorted(file for file in folder.iterdir() if _is_visible_mesh(file.relative_to(folder)))


def _is_visible_mesh(path: pathlib.Path) -> bool:
    """True for a mesh's path without hidden parts."""
    if path.suffix.lower() not in SUFFIXES:
        return False
    return not any(part.startswith((".", "__MACOSX")) for part in path.parts)


def _in_subfolder(folder: pathlib.Path) -> list[Source]:
    """The objects of the meshes directly in a folder, without those of folders below it."""
    meshes = _meshes_in(folder)
    return _in_folder(folder, meshes) if meshes else []


def _in_folder(folder: pathlib.Path, meshes: list[pathlib.Path]) -> list[Source]:
    """The objects of a folder with these meshes."""
    name = safe_name(folder.resolve().name)
    two_parts = _two_parts(meshes)
    if two_parts:
        return [Source(name, folder, visuals=two_parts, parts=two_parts)]
    pieces = tuple(MeshFile(file, "piece") for file in meshes if file.stem.startswith("contact"))
    others = [file for file in meshes if not file.stem.startswith("contact")]
    main = _main_mesh(others)
    if not pieces and (main is None or len(others) == 2):
        return [_single(file) for file in others]
    if main is None:
        if others:
            raise _no_main_mesh(folder, name, others[0].suffix)
        return [Source(name, folder, visuals=(), pieces=pieces)]
    parts = tuple(_part(main, file) for file in others if file != main)
    if len(parts) < 2:
        parts = ()
    return [Source(name, folder, (MeshFile(main, "visual"),), pieces, parts)]


def _single(file: pathlib.Path) -> Source:
    """The object of one mesh file."""
    return Source(safe_name(file.stem), file, (MeshFile(file, "visual"),))


def _main_mesh(files: list[pathlib.Path]) -> pathlib.Path | None:
    """The file whose parts all other files are; None if there is none."""
    for candidate in files:
        others = [file for file in files if file != candidate]
        if all(_is_named_part(candidate, file) for file in others):
            return candidate
    return None


def _is_named_part(main: pathlib.Path, file: pathlib.Path) -> bool:
    """True if a file is named as a part of the object in the main file."""
    return file.stem.startswith(tuple(main.stem + mark for mark in "_- "))


def _no_main_mesh(folder: pathlib.Path, name: str, suffix: str) -> CongraspError:
    """The error of a folder of convex pieces and of several other meshes."""
    return CongraspError(
        f"The folder {folder} has contact pieces, but it is not clear which mesh is the "
        f"whole object.",
        f"Name the file of the whole object {name}{suffix}, and those of its parts "
        f"{name}_<part>{suffix}.",
    )


def _part(main: pathlib.Path, file: pathlib.Path) -> MeshFile:
    """The file of a part, which is graspable if its name is that of a handle."""
    part = file.stem[len(main.stem) :].strip("_- ")
    graspable = any(word in part.lower() for word in _GRASPABLE_WORDS)
    return MeshFile(file, "part", part, graspable)


def _two_parts(meshes: list[pathlib.Path]) -> tuple[MeshFile, ...]:
    """The graspable file and, if there is one, the non-graspable one.

    Empty without a graspable file.
    """
    graspable: pathlib.Path | None = None
    other: pathlib.Path | None = None
    for file in meshes:
        stem = file.stem.lower()
        if stem == "graspable" or stem.startswith("top"):
            graspable = graspable or file
        elif stem == "non_graspable" or stem.startswith("bottom"):
            other = other or file
    if graspable is None:
        return ()
    graspable_part = MeshFile(graspable, "part", "graspable", graspable=True)
    if other is None or _marks_absence(other):
        return (graspable_part,)
    return graspable_part, MeshFile(other, "part", "non-graspable", graspable=False)


def _marks_absence(file: pathlib.Path) -> bool:
    """True for the cube of GraspXL that replaces a part."""
    middle = read_mesh(file).bounds.mean(0)
    return np.allclose(middle, _NO_PART_POSITION_M, atol=_NO_PART_TOLERANCE)
