"""GLB files as trimesh reads them: triangles alone, positions and texture coordinates as floats, in
bounded memory.

A glTF file with embedded buffers becomes GLB.
"""

import base64
import json
from typing import Any

import numpy as np

from congrasp.common.errors import CongraspError

MAX_FACES = 20_000_000
"""Triangles of a mesh file, those of a GLB file counted wherever the scene shows them."""
MAX_NODES = 10_000
"""Nodes, meshes and accessors of a GLB file, each."""
_COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_NUMBERS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COMPRESSED = {
    "KHR_draco_mesh_compression": "is compressed with Draco",
    "EXT_meshopt_compression": "is compressed with meshopt (gltfpack -c)",
    "KHR_meshopt_compression": "is compressed with meshopt (gltfpack -c)",
}
_LOOKS = (
    "KHR_materials_",
    "KHR_texture_",
    "EXT_texture_",
    "MSFT_texture_",
    "KHR_lights_",
    "KHR_xmp",
    "KHR_animation_",
)
"""Beginnings of glTF extensions that change no geometry."""
_TRIANGLES = (4, 5)  # glTF's modes of primitives: triangles and strips of them


def packed(data: bytes) -> bytes:
    """The GLB file of a glTF scene in one file, whose buffers are embedded as data URIs.

    Raises:
      CongraspError: its buffers are other files; a predicate without a subject.
      ValueError: an embedded buffer is damaged.
    """
    tree, binary, starts = json.loads(data), bytearray(), list[int]()
    for buffer in _list(tree, "buffers"):
        head, mark, text = str(buffer.get("uri")).partition(";base64,")
        if not (mark and head.startswith("data:")):
            raise CongraspError(
                "is a glTF scene in several files.", "Export it as GLB, which is a single file."
            )
        starts.append(len(binary))
        binary += base64.b64decode(text)
        binary += bytes(-len(binary) % 4)
    for view in _list(tree, "bufferViews"):
        view["byteOffset"] = view.get("byteOffset", 0) + starts[view.get("buffer", 0)]
        view["buffer"] = 0
    return _glb({**tree, "buffers": [{"byteLength": len(binary)}]}, bytes(binary))


def _glb(tree: dict[str, Any], binary: bytes) -> bytes:
    """A GLB file of a scene and its numbers."""
    text = json.dumps(tree).encode()
    chunks = (
        (text + b" " * (-len(text) % 4), b"JSON"),
        (binary + bytes(-len(binary) % 4), b"BIN\0"),
    )
    body = b"".join(len(chunk).to_bytes(4, "little") + name + chunk for chunk, name in chunks)
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(body)).to_bytes(4, "little") + body


def plain_glb(data: bytes, notes: list[str]) -> bytes:
    """A GLB file of triangles alone, whose positions and texture coordinates are floats.

    Raises:
      CongraspError: it needs an extension that changes geometry, such as a compression; a predicate
        without a subject.
      ValueError: its parts do not fit its size.
    """
    length = int.from_bytes(data[12:16], "little")
    if len(data) < 20 or length > len(data):
        raise ValueError(f"it announces {length} bytes of JSON, but has {len(data)}")
    tree, binary = json.loads(data[20 : 20 + length]), bytearray(data[28 + length :])
    _check_extensions(tree)
    for part in (views := _list(tree, "bufferViews")):
        _check_counts(part, 1 << 32)  # by the format
    ends = [
        x.get("byteOffset", 0) + x.get("byteLength", 0) for x in views if not x.get("buffer", 0)
    ]
    if max(ends, default=0) > len(binary) and not any(
        "uri" in buffer for buffer in _list(tree, "buffers")[:1]
    ):
        raise ValueError(f"it was cut: it has {len(binary)} of {max(ends)} bytes of numbers")
    if not _list(tree, "scenes"):  # which the format allows; viewers show every node then
        inner = {child for node in _list(tree, "nodes") for child in node.get("children", ())}
        tree["scenes"] = [{"nodes": sorted(set(range(len(_list(tree, "nodes")))) - inner)}]
        tree["scene"] = 0
    _keep_triangles(tree, notes)
    _check_scene(tree, len(data))
    accessors = _list(tree, "accessors")
    used = {
        index
        for mesh in _list(tree, "meshes")
        for piece in _list(mesh, "primitives")
        for name, index in piece["attributes"].items()
        if name == "POSITION" or name.startswith("TEXCOORD")
    }
    for index in sorted(used):
        part = accessors[index]
        if part["componentType"] == 5126 and "sparse" not in part:
            continue
        values = _floats(tree, part, binary)
        binary += bytes(-len(binary) % 4)
        tree["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(binary), "byteLength": values.nbytes}
        )
        binary += values.tobytes()
        view = len(tree["bufferViews"]) - 1
        accessors[index] = {
            "bufferView": view,
            "componentType": 5126,
            "count": len(values),
            "type": part["type"],
        }
    return _glb(tree, bytes(binary))


def _check_extensions(tree: dict[str, Any]) -> None:
    """Raises a CongraspError for a required extension that changes geometry, and for positions that
    only one has.
    """
    views = [name for view in _list(tree, "bufferViews") for name in view.get("extensions", {})]
    pieces = [
        piece
        for mesh in _list(tree, "meshes")
        for piece in _list(mesh, "primitives")
        if "attributes" in piece
    ]
    empty = {
        i
        for i, part in enumerate(_list(tree, "accessors"))
        if not {"bufferView", "sparse"} & part.keys()
    }
    unread = [piece for piece in pieces if piece["attributes"].get("POSITION") in empty]
    bare = [name for piece in unread for name in piece.get("extensions", {})]
    for name in (*tree.get("extensionsRequired", []), *views, *bare):
        if name in _COMPRESSED:
            raise CongraspError(f"{_COMPRESSED[name]}.", "Export it without compression.")
        if name != "KHR_mesh_quantization" and not str(name).startswith(_LOOKS):
            raise CongraspError(
                f"needs the glTF extension '{name}'.", "Export it without that extension."
            )


def _keep_triangles(tree: dict[str, Any], notes: list[str]) -> None:
    """Removes primitives of lines, points or nothing from the meshes."""
    left_out = 0
    for mesh in _list(tree, "meshes"):
        pieces = _list(mesh, "primitives")
        mesh["primitives"] = [
            piece
            for piece in pieces
            if "POSITION" in piece.get("attributes", {}) and piece.get("mode", 4) in _TRIANGLES
        ]
        left_out += len(pieces) - len(mesh["primitives"])
    if left_out:
        notes.append(f"{left_out} of its primitives without triangles or positions were left out")


def _floats(tree: dict[str, Any], part: dict[str, Any], binary: bytearray) -> np.ndarray:
    """The float32 values (count, columns) of an accessor; normalised integers are divided by their
    largest value.
    """

    def values(view: int, offset: int, kind: str, rows: int, columns: int) -> np.ndarray:
        """Values of a buffer view."""
        about = tree["bufferViews"][view]
        start, size = about.get("byteOffset", 0) + offset, np.dtype(kind).itemsize
        if about.get("buffer", 0) or rows * columns == 0:
            raise ValueError("its numbers are in another file")
        steps = about.get("byteStride", size * columns), size
        return np.ndarray((rows, columns), kind, bytes(binary), start, steps)

    kind, columns, count = _NUMBERS[part["componentType"]], _COLUMNS[part["type"]], part["count"]
    if "bufferView" in part:
        found = values(part["bufferView"], part.get("byteOffset", 0), kind, count, columns).astype(
            np.float32
        )
    else:
        found = np.zeros((count, columns), np.float32)
    if some := part.get("sparse"):
        at, new = some["indices"], some["values"]
        rows = values(
            at["bufferView"],
            at.get("byteOffset", 0),
            _NUMBERS[at["componentType"]],
            some["count"],
            1,
        )
        found[rows[:, 0]] = values(
            new["bufferView"], new.get("byteOffset", 0), kind, some["count"], columns
        )
    if part.get("normalized") and np.dtype(kind).kind != "f":
        found = np.maximum(found / np.iinfo(kind).max, -1.0).astype(np.float32)
    return found


def _check_scene(tree: dict[str, Any], size: int) -> None:
    """Accessors lie in the file, and the scene, which may show a mesh many times, has a bounded
    number of triangles.
    """
    accessors, meshes, nodes = (_list(tree, name) for name in ("accessors", "meshes", "nodes"))
    for part in accessors:
        _check_counts(part, size)
    taken = sum(
        part["count"] * _COLUMNS[part["type"]] * int(_NUMBERS[part["componentType"]][2])
        for part in accessors
    )
    if taken > 16 * size + (1 << 20):
        raise ValueError(f"its accessors take {taken} bytes, but it has {size}")
    faces = [
        sum(_triangles(piece, accessors) for piece in _list(mesh, "primitives")) for mesh in meshes
    ]
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


def _check_counts(part: dict[str, Any], most: int) -> None:
    for name in ("count", "byteLength", "byteOffset", "byteStride"):
        value = part.get(name, 0)
        if type(value) is not int or not 0 <= value <= most:
            raise ValueError(f"it has a {name} of {value!r:.30}, not a whole number up to {most}")


def _triangles(piece: dict[str, Any], accessors: list[dict[str, Any]]) -> int:
    index = piece.get("indices", piece["attributes"]["POSITION"])
    return int(accessors[index]["count"])
