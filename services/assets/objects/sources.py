"""Sources of objects at a path: single meshes, decomposed objects, objects in part files; and a mesh reader."""

import dataclasses
import os
import pathlib
from typing import Any, Literal

import numpy as np
import trimesh

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import LONGEST_NAME
from congrasp.services.assets.objects import repair
from congrasp.services.assets.objects.headers import MAX_FACES, check_header
from congrasp.services.assets.objects.kinds import CONVERT, SUFFIXES, kind_of

_GRASPABLE_WORDS = ("handle", "grip", "neck", "stem", "shaft", "body")
# GraspXL marks the absence of a non-graspable part by a cube of 1 cm at this position (m).
_NO_PART = 0.346408
_FARTHEST = 1e12  # largest coordinate in the file's unit, so that squares and products are finite


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
    * A folder with `<name>.*` and `<name>_<part>.*` is one object with labelled parts.
    * In any other folder every mesh is an object; a folder without meshes stands for its subfolders.

    Raises:
      CongraspError: there is nothing to import.
    """
    path = pathlib.Path(path)
    if path.is_file():
        return [Source(safe_name(path.stem), path, (MeshFile(path, "visual"),))]
    if not path.is_dir():
        raise CongraspError(f"There is no file or folder {path}.", "Check the path.")
    meshes = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
    if not meshes:
        found = [source for folder in sorted(path.iterdir()) if folder.is_dir() for source in _nested(folder)]
        if not found:
            raise CongraspError(f"The folder {path} holds no STL, OBJ, PLY or GLB file.", CONVERT)
        return found
    return _in_folder(path, meshes)


def read_mesh(path: pathlib.Path, notes: list[str] | None = None) -> trimesh.Trimesh:
    """Reads one mesh, in the file's own unit, with merged vertices and without degenerate triangles.

    Args:
      path: the file; its content determines the kind, not its name.
      notes: repairs are appended.

    Raises:
      CongraspError: not a mesh, empty, or not finite.
    """
    said = [] if notes is None else notes
    suffix = kind_of(path)
    kind = suffix[1:].upper()
    if suffix != path.suffix.lower():
        said.append(f"its content is {kind}, whatever its name says, and was read as that")
    check_header(path, suffix, "Export it again, or convert it.")
    try:
        mesh = trimesh.load_scene(path, file_type=suffix[1:], process=False, skip_materials=True).to_mesh()
    except Exception as error:  # the readers raise whatever they stumble over
        reason = (str(error) or type(error).__name__).splitlines()[0].rstrip(" .!")
        raise CongraspError(f"{path} cannot be read as {kind}: {reason}.", "Export it again, or convert it.") from None
    if len(mesh.faces) == 0:
        points = f"only {len(mesh.vertices)} points" if len(mesh.vertices) else "nothing that can be read as a mesh"
        raise CongraspError(f"{path} has no triangles: it holds {points}.", f"Export it as a triangle mesh ({kind}).")
    if mesh.vertices.shape[1:] != (3,) or mesh.faces.shape[1:] != (3,):
        raise CongraspError(f"{path} has points that are not of three numbers.", "Export it again, or convert it.")
    if len(mesh.faces) > MAX_FACES or mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise CongraspError(f"{path} has triangles without vertices, or too many.", "Export it again, or convert it.")
    finite = repair.without_gaps(np.asarray(mesh.vertices), np.asarray(mesh.faces), said)
    if finite is None:
        bad = int((~np.isfinite(mesh.vertices)).any(-1).sum())
        raise CongraspError(f"{path} has {bad} vertices that are not finite numbers.", "Repair or export it again.")
    if (farthest := np.abs(finite[0]).max(initial=0.0)) > _FARTHEST:
        raise CongraspError(f"{path} has a coordinate of {farthest:.3g}.", f"{_FARTHEST:g} is the most, in any unit.")
    mesh = trimesh.Trimesh(*repair.reduced(*finite, said), process=False)
    mesh.merge_vertices()
    if len(mesh.faces):
        mesh.update_faces(mesh.nondegenerate_faces())
        mesh.remove_unreferenced_vertices()
    if len(mesh.faces) < 4:
        raise CongraspError(f"{path} has no volume: only {len(mesh.faces)} proper triangles.", "Export a closed mesh.")
    return mesh


def load_geometry(path: pathlib.Path, remedy: str, **options: Any) -> Any:
    """Loads a file with trimesh, as a mesh or a point cloud, unchanged.

    Raises:
      CongraspError: it cannot be read; the line ends with the remedy.
    """
    check_header(path, path.suffix.lower(), remedy)
    try:
        return trimesh.load(path, process=False, **options)
    except Exception as error:  # the readers raise whatever they stumble over
        reason = (str(error) or type(error).__name__).splitlines()[0].rstrip(" .!")
        raise CongraspError(f"{path} cannot be read: {reason}.", remedy) from None


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
    main = next((file for file in others if all(o.stem.startswith(file.stem) for o in others)), None)
    if others and main is None:
        if not pieces:
            return [Source(safe_name(file.stem), file, (MeshFile(file, "visual"),)) for file in others]
        raise CongraspError(
            f"The folder {folder} has contact pieces, but it is not clear which mesh shows the whole object.",
            f"Name it {name}{others[0].suffix} and its parts {name}_<part>{others[0].suffix}.",
        )
    visuals = (MeshFile(main, "visual"),) if main else ()
    parts = tuple(_part(file, file.stem[len(main.stem) :].strip("_- ")) for file in others if main and file != main)
    return [Source(name, folder, visuals, pieces, parts if len(parts) > 1 else ())]


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


def safe_name(text: str) -> str:
    """A text as the name of an object, which is valid as a file name."""
    safe = "".join(c if c.isascii() and (c.isalnum() or c in "._-") else "_" for c in text).lstrip("._-")
    return safe[:LONGEST_NAME] or "object"
