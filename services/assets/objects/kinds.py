"""Determines the kind of a mesh file by its content; other files are refused with a remedy."""

import pathlib
import zipfile

from congrasp.common.errors import CongraspError

SUFFIXES = (".stl", ".obj", ".ply", ".glb")
CONVERT = "Convert it to STL, OBJ, PLY or GLB."
_BLENDER = "Open it in Blender and export it as GLB or OBJ."
_FOREIGN = (
    (b"Kaydara FBX", "an FBX file", _BLENDER),
    (b"BLENDER", "a Blender file", _BLENDER),
    (b"ISO-10303-21", "a STEP file (surfaces, no triangles)", "Open it in FreeCAD and export it as STL."),
    (b"#VRML", "a VRML file", _BLENDER),
    (b"\x1f\x8b", "a gzip archive", "Unpack it and name the mesh inside."),
    (b"\x28\xb5\x2f\xfd", "a zstd archive", "Unpack it and name the mesh inside."),
    (b"7z\xbc\xaf", "a 7z archive", "Unpack it and name the mesh inside."),
    (b"Rar!", "a RAR archive", "Unpack it and name the mesh inside."),
    (b"\x89PNG", "a picture", "Name the mesh."),
    (b"\xff\xd8\xff", "a picture", "Name the mesh."),
    (b"%PDF", "a PDF document", "Name the mesh."),
    (b"version https://git-lfs", "a Git LFS pointer, not the mesh itself", "Fetch it with 'git lfs pull'."),
)
_STL_HEADER, _STL_TRIANGLE = 84, 50  # bytes
_START = 4096


def kind_of(path: pathlib.Path) -> str:
    """Returns the suffix for a file's content, or that of its name if the content is ambiguous.

    Raises:
      CongraspError: it cannot be read, is empty, or is not a mesh; the remedy describes how to get one.
    """
    try:
        with path.open("rb") as file:
            start = file.read(_START)
        size = path.stat().st_size
    except OSError as error:
        raise CongraspError(
            f"{path} cannot be read: {error.strerror}.", "Check the path and its permissions."
        ) from None
    if not start:
        raise CongraspError(f"{path} is empty (0 bytes).", "Export or download it again.")
    if start.startswith(b"PK\x03\x04"):
        raise CongraspError(f"{path} is a zip archive{_inside(path)}.", "Unpack it and name the mesh inside.")
    for magic, what, remedy in _FOREIGN:
        if magic in start[:64]:
            raise CongraspError(f"{path} is {what}.", remedy)
    text = start.lstrip().lower()
    if text.startswith((b"<!doctype html", b"<html")):
        raise CongraspError(f"{path} is a web page, not a mesh.", "Download the file itself again.")
    if text.startswith(b"<?xml"):
        raise CongraspError(f"{path} is an XML file such as COLLADA (.dae) or a robot description.", _BLENDER)
    suffix = path.suffix.lower()
    found = _supported(start, size)
    if found is None and suffix not in SUFFIXES:
        raise CongraspError(f"{path} is not an STL, OBJ, PLY or GLB file.", CONVERT)
    return found or suffix


def _supported(start: bytes, size: int) -> str | None:
    """The suffix of a mesh file with this beginning and size in bytes, if it is one."""
    if start.startswith(b"glTF"):
        return ".glb"
    if start.startswith(b"ply"):
        return ".ply"
    if len(start) >= _STL_HEADER:
        count = int.from_bytes(start[_STL_HEADER - 4 : _STL_HEADER], "little")
        if size == _STL_HEADER + _STL_TRIANGLE * count:
            return ".stl"
    if start.lstrip().lower().startswith(b"solid") and b"facet" in start:
        return ".stl"
    lines = [line.split() for line in start.splitlines()]
    points = sum(len(words) >= 4 and words[0] == b"v" for words in lines)
    return ".obj" if points >= 3 else None


def _inside(path: pathlib.Path) -> str:
    """Content of a zip archive, for an error message."""
    try:
        names = [name for name in zipfile.ZipFile(path).namelist() if name.lower().endswith(SUFFIXES)]
    except (OSError, zipfile.BadZipFile):
        return " that is damaged"
    return f" with {', '.join(names[:3])}{' …' if len(names) > 3 else ''} in it" if names else " without a mesh in it"
