"""GLB files, prepared for trimesh: triangles alone, and numbers as floats, in bounded memory.

A glTF file with embedded buffers becomes GLB.
"""

import base64
import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from congrasp.common.errors import CongraspError

MAX_FACES = 20_000_000
"""Triangles of a mesh file, those of a GLB file counted wherever the scene shows them."""
MAX_NODES = 10_000
"""Nodes, meshes and accessors of a GLB file, each."""
_MAX_MEMORY_RATIO = 16
"""Bytes of the accessors' numbers relative to those of the file."""
_MAX_UNSHARED_BYTES = 1 << 20
"""Bytes of the accessors' numbers that any file may have."""
_HEADER_BYTES = 20
"""Bytes of a GLB file before its JSON: the file's header, and that of the first chunk."""
_CHUNK_HEADER_BYTES = 8
_FLOAT = 5126
"""glTF's code of float32."""
_COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
"""Numbers of each type of glTF."""
_NUMBERS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
"""NumPy's types by glTF's codes."""
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
_TRIANGLE_MODES = (4, 5)
"""glTF's modes of primitives: triangles and strips of them."""
_TREE = dict[str, Any]
"""JSON of a scene, or of one of its parts."""


def packed(data: bytes) -> bytes:
    """Returns the GLB file of a glTF scene in one file, whose buffers are data URIs.

    Raises:
      CongraspError: its buffers are other files; a predicate without a subject.
      ValueError: an embedded buffer is damaged.
    """
    tree = json.loads(data)
    binary = bytearray()
    starts: list[int] = []
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


def plain_glb(data: bytes, notes: list[str]) -> bytes:
    """Returns a GLB file of triangles alone, whose positions and texture coordinates are floats.

    Args:
      data: content of the file.
      notes: the number of primitives without triangles is appended.

    Raises:
      CongraspError: it needs an extension that changes geometry, such as a compression; a predicate
        without a subject.
      ValueError: its parts do not fit its size.
    """
    tree, binary = _tree_and_binary(data)
    _check_extensions(tree)
    _check_size(tree, len(binary))
    _ensure_scene(tree)
    _keep_triangles(tree, notes)
    _check_accessors(tree, len(data))
    _check_scene(tree)
    for index in sorted(_used_accessors(tree)):
        accessor = _list(tree, "accessors")[index]
        if accessor["componentType"] != _FLOAT or "sparse" in accessor:
            _replace_by_floats(tree, index, binary)
    return _glb(tree, bytes(binary))


def _glb(tree: _TREE, binary: bytes) -> bytes:
    """A GLB file of a scene and its numbers."""
    text = json.dumps(tree).encode()
    json_chunk = text + b" " * (-len(text) % 4)
    binary_chunk = binary + bytes(-len(binary) % 4)
    body = b""
    for name, chunk in ((b"JSON", json_chunk), (b"BIN\0", binary_chunk)):
        body += len(chunk).to_bytes(4, "little") + name + chunk
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(body)).to_bytes(4, "little") + body


def _tree_and_binary(data: bytes) -> tuple[_TREE, bytearray]:
    """The scene of a GLB file, and its numbers."""
    length = int.from_bytes(data[12:16], "little")
    if len(data) < _HEADER_BYTES or length > len(data):
        raise ValueError(f"it announces {length} bytes of JSON, but has {len(data)}")
    end = _HEADER_BYTES + length
    return json.loads(data[_HEADER_BYTES:end]), bytearray(data[end + _CHUNK_HEADER_BYTES :])


def _check_extensions(tree: _TREE) -> None:
    """Raises a CongraspError for an extension that changes geometry.

    That is a required one, one of a buffer, or one that alone has a primitive's positions.
    """
    names = list(tree.get("extensionsRequired", []))
    for view in _list(tree, "bufferViews"):
        names += view.get("extensions", {})
    empty = set()
    for index, accessor in enumerate(_list(tree, "accessors")):
        if not {"bufferView", "sparse"} & accessor.keys():
            empty.add(index)
    for primitive in _primitives(tree):
        if "attributes" in primitive and primitive["attributes"].get("POSITION") in empty:
            names += primitive.get("extensions", {})
    for name in names:
        if name in _COMPRESSED:
            raise CongraspError(f"{_COMPRESSED[name]}.", "Export it without compression.")
        if name != "KHR_mesh_quantization" and not str(name).startswith(_LOOKS):
            raise CongraspError(
                f"needs the glTF extension '{name}'.", "Export it without that extension."
            )


def _check_size(tree: _TREE, size: int) -> None:
    """Raises a ValueError if the buffer views end beyond the binary numbers of `size` bytes."""
    end = 0
    for view in _list(tree, "bufferViews"):
        _check_counts(view, 1 << 32)  # by the format
        if not view.get("buffer", 0):
            end = max(end, view.get("byteOffset", 0) + view.get("byteLength", 0))
    is_in_file = not any("uri" in buffer for buffer in _list(tree, "buffers")[:1])
    if end > size and is_in_file:
        raise ValueError(f"it was cut: it has {size} of {end} bytes of numbers")


def _ensure_scene(tree: _TREE) -> None:
    """Adds a scene of all nodes to a file without scenes, as viewers do; the format allows it."""
    if _list(tree, "scenes"):
        return
    nodes = _list(tree, "nodes")
    roots = set(range(len(nodes)))
    for node in nodes:
        roots -= set(node.get("children", ()))
    tree["scenes"] = [{"nodes": sorted(roots)}]
    tree["scene"] = 0


def _keep_triangles(tree: _TREE, notes: list[str]) -> None:
    """Removes primitives of lines, points or nothing from the meshes."""
    removed = 0
    for mesh in _list(tree, "meshes"):
        primitives = _list(mesh, "primitives")
        mesh["primitives"] = [primitive for primitive in primitives if _has_triangles(primitive)]
        removed += len(primitives) - len(mesh["primitives"])
    if removed:
        notes.append(f"{removed} of its primitives without triangles or positions were left out")


def _has_triangles(primitive: _TREE) -> bool:
    """True for a primitive of triangles with positions."""
    if "POSITION" not in primitive.get("attributes", {}):
        return False
    return primitive.get("mode", 4) in _TRIANGLE_MODES


def _check_accessors(tree: _TREE, size: int) -> None:
    """Raises a ValueError if the accessors take far more memory than the file has bytes."""
    total = 0
    for accessor in _list(tree, "accessors"):
        _check_counts(accessor, size)
        number_bytes = int(_NUMBERS[accessor["componentType"]][2])
        total += accessor["count"] * _COLUMNS[accessor["type"]] * number_bytes
    if total > _MAX_MEMORY_RATIO * size + _MAX_UNSHARED_BYTES:
        raise ValueError(f"its accessors take {total} bytes, but it has {size}")


def _check_scene(tree: _TREE) -> None:
    """Raises a ValueError for too many triangles, and for nodes that are not a tree.

    A scene may show a mesh many times.
    """
    accessors = _list(tree, "accessors")
    mesh_triangles = []
    for mesh in _list(tree, "meshes"):
        primitives = _list(mesh, "primitives")
        mesh_triangles.append(sum(_triangles(primitive, accessors) for primitive in primitives))
    shown_triangles = 0
    children = set[int]()
    for node in _list(tree, "nodes"):
        for child in node.get("children", []):
            if child in children or not isinstance(child, int):
                raise ValueError("a node of its scene has two parents")
            children.add(child)
        if "mesh" in node:
            shown_triangles += mesh_triangles[node["mesh"]]
    if max(shown_triangles, sum(mesh_triangles)) > MAX_FACES:
        raise ValueError(f"its scene has more than {MAX_FACES} triangles")


def _used_accessors(tree: _TREE) -> set[int]:
    """Indices of the accessors of positions and of texture coordinates."""
    used = set()
    for primitive in _primitives(tree):
        for name, index in primitive["attributes"].items():
            if name == "POSITION" or name.startswith("TEXCOORD"):
                used.add(index)
    return used


def _replace_by_floats(tree: _TREE, index: int, binary: bytearray) -> None:
    """Appends the numbers of an accessor to the binary ones as floats, and replaces it."""
    accessor = _list(tree, "accessors")[index]
    values = _float_values(tree, accessor, binary)
    binary += bytes(-len(binary) % 4)
    view = {"buffer": 0, "byteOffset": len(binary), "byteLength": values.nbytes}
    binary += values.tobytes()
    tree["bufferViews"].append(view)
    tree["accessors"][index] = {
        "bufferView": len(tree["bufferViews"]) - 1,
        "componentType": _FLOAT,
        "count": len(values),
        "type": accessor["type"],
    }


def _float_values(tree: _TREE, accessor: _TREE, binary: bytearray) -> np.ndarray:
    """The float32 values (count, columns) of an accessor.

    Normalised integers are divided by their largest value.
    """
    number_type = _NUMBERS[accessor["componentType"]]
    columns = _COLUMNS[accessor["type"]]
    count = accessor["count"]
    if "bufferView" in accessor:
        stored = _view_values(tree, accessor, binary, number_type, (count, columns))
        values = stored.astype(np.float32)
    else:
        values = np.zeros((count, columns), np.float32)
    sparse = accessor.get("sparse")
    if sparse:
        replaced = sparse["count"]
        indices = sparse["indices"]
        index_type = _NUMBERS[indices["componentType"]]
        rows = _view_values(tree, indices, binary, index_type, (replaced, 1))[:, 0]
        values[rows] = _view_values(
            tree, sparse["values"], binary, number_type, (replaced, columns)
        )
    if accessor.get("normalized") and np.dtype(number_type).kind != "f":
        largest = np.iinfo(number_type).max
        values = np.maximum(values / largest, -1.0).astype(np.float32)
    return values


def _view_values(
    tree: _TREE, part: _TREE, binary: bytearray, number_type: str, shape: tuple[int, int]
) -> np.ndarray:
    """Values of a buffer view, as an array of this shape.

    Args:
      tree: the scene.
      part: has the index of the view, and the offset in it.
      binary: the numbers of the file.
      number_type: NumPy's type.
      shape: rows and columns.
    """
    view = tree["bufferViews"][part["bufferView"]]
    rows, columns = shape
    if view.get("buffer", 0) or rows * columns == 0:
        raise ValueError("its numbers are in another file")
    start = view.get("byteOffset", 0) + part.get("byteOffset", 0)
    number_bytes = np.dtype(number_type).itemsize
    strides = (view.get("byteStride", number_bytes * columns), number_bytes)
    return np.ndarray(shape, number_type, bytes(binary), start, strides)


def _primitives(tree: _TREE) -> Iterator[_TREE]:
    """Yields the primitives of all meshes."""
    for mesh in _list(tree, "meshes"):
        yield from _list(mesh, "primitives")


def _triangles(primitive: _TREE, accessors: list[_TREE]) -> int:
    """Number of indices of a primitive, which its triangles do not exceed."""
    index = primitive.get("indices", primitive["attributes"]["POSITION"])
    return int(accessors[index]["count"])


def _list(tree: _TREE, name: str) -> list[_TREE]:
    """The parts of a scene or a mesh by name, such as its nodes.

    Raises:
      ValueError: they are too many.
    """
    parts = tree.get(name, [])
    if len(parts) > MAX_NODES:
        raise ValueError(f"it has more than {MAX_NODES} {name}")
    return parts


def _check_counts(part: _TREE, largest: int) -> None:
    """Raises a ValueError unless the counts of a part are whole numbers up to the largest."""
    for name in ("count", "byteLength", "byteOffset", "byteStride"):
        value = part.get(name, 0)
        if type(value) is not int or not 0 <= value <= largest:
            raise ValueError(
                f"it has a {name} of {value!r:.30}, not a whole number up to {largest}"
            )
