"""Kinds of mesh files, by their content: names are wrong too often.

A file of another format is an error that describes how to get a mesh from it.
"""

import codecs
import io
import pathlib
import re
import tomllib
import zipfile
from typing import Any

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import read_file
from congrasp.services.assets.objects.stl import is_stl

SUFFIXES = (".stl", ".obj", ".ply", ".glb")
CONVERT = "Convert it to STL, OBJ, PLY or GLB."
MAX_BYTES = 512 << 20
"""Bytes of a mesh file."""
CHECK = f"Check the path and its permissions, or export it with less than {MAX_BYTES >> 20} MB."
RECONSTRUCT = (
    "Make a surface of it (in MeshLab: Filters, Remeshing, Screened Poisson) and export that."
)
"""Remedy for points without triangles."""
START_BYTES = 4096
"""Beginning of a file that tells text from binary data."""
_UNPACK = "Unpack it and name the mesh inside."
_ZIP = b"PK\3\4"
_SIGNATURES = pathlib.Path(__file__).with_name("foreign.toml")
_MIN_OBJ_POINTS = 3
"""Points at the beginning of a text, from which it is taken for an OBJ."""
_MIN_NUMBER_LINES = 3
"""Lines of numbers from which a text is taken for a point cloud."""
_NAMED_MESHES = 3
"""Meshes in an archive that a message names."""


def read_with_kind(path: pathlib.Path) -> tuple[str, bytes]:
    """Returns the kind of a mesh file (stl, obj, ply, glb or gltf), and its content.

    The name determines the kind only if the content is ambiguous.

    Raises:
      CongraspError: it cannot be read, is empty, or is not a mesh; the remedy describes how to get
        one.
    """
    data = read_file(path, MAX_BYTES, CHECK)
    if not data:
        raise CongraspError(f"{path} is empty (0 bytes).", "Export or download it again.")
    start = data[:START_BYTES]
    kind = _supported_kind(start, len(data))
    if kind:
        return kind, data
    text = start.removeprefix(codecs.BOM_UTF8).lstrip()
    if text.startswith(b"{") and b'"asset"' in data:
        return "gltf", data
    foreign = _foreign_kind(text, data)
    if foreign:
        description, remedy = foreign
        raise CongraspError(f"{path} is {description}.", remedy)
    suffix = path.suffix.lower()
    if suffix in SUFFIXES:
        return suffix[1:], data
    if _holds_rows_of_numbers(text):
        raise CongraspError(f"{path} contains rows of numbers, such as a point cloud.", RECONSTRUCT)
    raise CongraspError(f"{path} is not an STL, OBJ, PLY or GLB file.", CONVERT)


def _supported_kind(start: bytes, size: int) -> str:
    """The kind of a mesh file by its beginning and its size in bytes; empty for other files."""
    if start.startswith(b"glTF"):
        return "glb"
    if start.startswith((b"ply\n", b"ply\r", b"ply ")):
        return "ply"
    if is_stl(start, size):
        return "stl"
    if start.startswith(_ZIP):
        return ""
    points = 0
    for line in start.splitlines():
        words = line.split()
        points += len(words) >= 4 and words[0] == b"v"
    return "obj" if points >= _MIN_OBJ_POINTS else ""


def _foreign_kind(text: bytes, data: bytes) -> tuple[str, str] | None:
    """Description and remedy of a file that is not a mesh; None if it is unknown.

    Args:
      text: its beginning, without blanks.
      data: its content.
    """
    archived: list[str] = []
    is_zip = text.startswith(_ZIP)
    searched = text.lower()
    if is_zip:
        try:
            archived = zipfile.ZipFile(io.BytesIO(data)).namelist()
        except (OSError, zipfile.BadZipFile):
            return "a zip archive that is damaged", "Download it again."
        searched = "".join(f"{name}\n" for name in archived).lower().encode()
    for group in tomllib.loads(_SIGNATURES.read_text(encoding="utf-8"))["group"]:
        for signature in group["files"]:
            if _matches(signature, text, searched):
                return signature["what"], group["remedy"]
    if is_zip:
        return _archive(archived)
    return None


def _matches(signature: dict[str, Any], text: bytes, searched: bytes) -> bool:
    """True if a file has a signature.

    Args:
      signature: a row of `foreign.toml`.
      text: beginning of the file.
      searched: the same in lower case, or the names in an archive.
    """
    beginnings = tuple(beginning.encode("latin-1") for beginning in signature["begins"])
    if not (text.startswith(beginnings) or text.lower().startswith(beginnings)):
        return False
    if "holds" not in signature:
        return True
    return any(words.encode() in searched for words in signature["holds"])


def _archive(names: list[str]) -> tuple[str, str]:
    """Description and remedy of a zip archive of these files."""
    meshes = [name for name in names if name.lower().endswith(SUFFIXES)]
    if not meshes:
        return "a zip archive without a mesh in it", CONVERT
    listed = ", ".join(meshes[:_NAMED_MESHES])
    if len(meshes) > _NAMED_MESHES:
        listed += " …"
    return f"a zip archive with {listed} in it", _UNPACK


def _holds_rows_of_numbers(text: bytes) -> bool:
    """True if the first lines hold three or more numbers each."""
    lines = [line for line in text.splitlines()[:10] if line.strip()]
    if len(lines) < _MIN_NUMBER_LINES:
        return False
    complete = lines[:-1]
    return all(re.fullmatch(rb"\s*([-+.\deE]+[\s,;]*){3,}", line) for line in complete)
