"""Sources of objects at a path: single meshes, decomposed objects, objects in part files."""

import dataclasses
import os
import pathlib
from collections.abc import Sequence
from typing import Literal

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import distinct_names, safe_name
from congrasp.services.assets.objects.mesh_files import CONVERT, SUFFIXES, read_mesh

_GRASPABLE_WORDS = ("handle", "grip", "neck", "stem", "shaft", "body")
# GraspXL marks the absence of a non-graspable part by a cube of 1 cm at this position (m).
_NO_PART = 0.346408


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
        """True if the part files together are the object, so that no collision piece spans two of them."""
        return bool(self.parts) and self.visuals == self.parts

    def files(self) -> tuple[MeshFile, ...]:
        """All files, without repetition."""
        return tuple(dict.fromkeys(self.visuals + self.pieces + self.parts))


def find_sources(path: str | os.PathLike[str]) -> list[Source]:
    """Finds the objects at a path.

    * A mesh file (STL, OBJ, PLY, GLB) is one object.
    * A folder with `graspable.*` and `non_graspable.*` (or `top*` and `bottom*`) is one object of two parts.
    * A folder with `contact*` files is one object that is already cut into convex pieces. Its other meshes show it:
      `<name>.stl` the whole, `<name>_<part>.stl` its parts.
    * A folder with `<name>.*` and at least two `<name>_<part>.*` is one object with labelled parts.
    * In any other folder every mesh is an object; a folder without meshes stands for its subfolders. Names that repeat
      have numbers.

    Raises:
      CongraspError: there is nothing to import.
    """
    path = pathlib.Path(path)
    if path.is_file():
        return [_single(path)]
    if not path.is_dir():
        raise CongraspError(f"There is no file or folder {path}.", "Check the path.")
    meshes = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
    if not meshes:
        found = [source for folder in sorted(path.iterdir()) if folder.is_dir() for source in _nested(folder)]
        if not found:
            raise CongraspError(f"The folder {path} holds no STL, OBJ, PLY or GLB file.", CONVERT)
        return distinct(found)
    return distinct(_in_folder(path, meshes))


def distinct(sources: Sequence[Source]) -> list[Source]:
    """The sources with distinct names."""
    names = distinct_names(source.name for source in sources)
    return [dataclasses.replace(source, name=name) for source, name in zip(sources, names, strict=True)]


def _nested(folder: pathlib.Path) -> list[Source]:
    """The objects of the meshes directly in a folder, without those of folders below it."""
    meshes = sorted(file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES)
    return _in_folder(folder, meshes) if meshes else []


def _in_folder(folder: pathlib.Path, meshes: list[pathlib.Path]) -> list[Source]:
    """The objects of a folder with these meshes."""
    name = safe_name(folder.resolve().name)
    two = _two_parts(meshes)
    if two:
        return [Source(name, folder, two, (), two)]
    pieces = tuple(MeshFile(file, "piece") for file in meshes if file.stem.startswith("contact"))
    others = [file for file in meshes if not file.stem.startswith("contact")]
    main = next((file for file in others if all(o == file or _names_part(file, o) for o in others)), None)
    if not pieces and (main is None or len(others) == 2):
        return list(map(_single, others))
    if others and main is None:
        raise CongraspError(
            f"The folder {folder} has contact pieces, but it is not clear which mesh shows the whole object.",
            f"Name it {name}{others[0].suffix} and its parts {name}_<part>{others[0].suffix}.",
        )
    visuals = (MeshFile(main, "visual"),) if main else ()
    parts = tuple(_part(file, file.stem[len(main.stem) :].strip("_- ")) for file in others if main and file != main)
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
    """The graspable file and, if there is one, the non-graspable one; empty without a graspable file."""
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
    return tuple(MeshFile(found[key], "part", names[key], key) for key in (True, False) if key in found)
