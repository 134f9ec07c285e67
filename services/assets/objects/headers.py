"""Checks the announced sizes in a mesh file's header against its length, before it is read."""

import json
import pathlib
import stat
from typing import Any

from congrasp.common.errors import CongraspError

MAX_BYTES = 512 << 20
"""Bytes of a mesh file."""
MAX_FACES = 20_000_000
"""Triangles of a mesh file, those of a GLB file counted wherever the scene shows them."""
MAX_NODES = 10_000
"""Nodes, meshes and accessors of a GLB file, each."""
_HEADER = 1 << 16  # bytes of a PLY header
_SIZES = {"char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2}
_SIZES |= {"int": 4, "uint": 4, "int32": 4, "uint32": 4, "float": 4, "float32": 4, "double": 8, "float64": 8}
_COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}


def check_header(path: pathlib.Path, kind: str, remedy: str) -> None:
    """Checks that a mesh file of a kind (".stl", ".obj", ".ply", ".glb") can be read in bounded memory and time.

    Raises:
      CongraspError: it is too large, or announces more than it holds.
    """
    try:
        about = path.stat()
        if not stat.S_ISREG(about.st_mode):
            raise ValueError("it is no regular file")
        if about.st_size > MAX_BYTES:
            raise ValueError(f"it has more than {MAX_BYTES >> 20} MB")
        check = {".ply": _ply, ".glb": _glb}.get(kind)  # trimesh compares an STL's count with its size; OBJ has none
        if check:
            check(path, about.st_size)
    except OSError as error:
        raise CongraspError(f"{path} cannot be read: {error.strerror}.", remedy) from None
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise CongraspError(f"{path} cannot be read as {kind[1:].upper()}: {str(error)[:200]}.", remedy) from None


def _ply(path: pathlib.Path, size: int) -> None:
    """Every element has at least the bytes of its numbers, a list at least those of its length; in text a character."""
    with path.open("rb") as file:
        header, end, _ = file.read(_HEADER).partition(b"end_header")
    if not end:
        raise ValueError(f"its header does not end within {_HEADER} bytes")
    is_text, elements = b"ascii" in header, list[tuple[int, int]]()
    for line in header.decode("latin-1").splitlines():
        match line.split():
            case ["element", _, count]:
                elements.append((int(count), 0))
            case ["property", *words]:
                least = 2 if is_text else _SIZES[words[1] if words[0] == "list" else words[0]]
                elements[-1] = elements[-1][0], elements[-1][1] + least
    for rows, width in elements:
        if rows < 0 or (rows and not width):
            raise ValueError(f"it announces an element of {rows} rows without values")
    if sum(rows * width for rows, width in elements) > size:
        raise ValueError(f"it announces {max(elements)[0]} rows, but has {size} bytes")


def _glb(path: pathlib.Path, size: int) -> None:
    """Accessors lie in the file, and the scene, which may show a mesh many times, has a bounded number of triangles."""
    with path.open("rb") as file:
        start = file.read(20)
        length = int.from_bytes(start[12:16], "little")
        if len(start) < 20 or length > size:
            raise ValueError(f"it announces {length} bytes of JSON, but has {size}")
        tree = json.loads(file.read(length))
    accessors, meshes, nodes = (_list(tree, name) for name in ("accessors", "meshes", "nodes"))
    for name in ("accessors", "bufferViews"):
        for part in _list(tree, name):
            _check_counts(part, size)
    taken = sum(part["count"] * _COLUMNS[part["type"]] * _BYTES[part["componentType"]] for part in accessors)
    if taken > 16 * size + (1 << 20):
        raise ValueError(f"its accessors take {taken} bytes, but it has {size}")
    faces = [sum(_triangles(piece, accessors) for piece in _list(mesh, "primitives")) for mesh in meshes]
    shown, parents = 0, set[int]()
    for node in nodes:
        for child in node.get("children", []):
            if child in parents or not isinstance(child, int):
                raise ValueError("a node of its scene has two parents")
            parents.add(child)
        if "mesh" in node:
            shown += faces[node["mesh"]]
    if max(shown, sum(faces)) > MAX_FACES:
        raise ValueError(f"its scene has more than {MAX_FACES} triangles")


def _list(tree: dict[str, Any], name: str) -> list[dict[str, Any]]:
    found = tree.get(name, [])
    if len(found) > MAX_NODES:
        raise ValueError(f"it has more than {MAX_NODES} {name}")
    return found


def _check_counts(part: dict[str, Any], size: int) -> None:
    for name in ("count", "byteLength", "byteOffset", "byteStride"):
        value = part.get(name, 0)
        if type(value) is not int or not 0 <= value <= size:
            raise ValueError(f"it has a {name} of {value!r:.30}, but {size} bytes")


def _triangles(piece: dict[str, Any], accessors: list[dict[str, Any]]) -> int:
    index = piece.get("indices", piece["attributes"]["POSITION"])
    return int(accessors[index]["count"])
