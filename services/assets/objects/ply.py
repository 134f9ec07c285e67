"""PLY files: their headers are checked before trimesh reads them, and their polygons become triangles.

trimesh reads no binary files whose faces differ in their number of corners, which Blender and others write.
"""

import itertools
import re
import struct
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from congrasp.services.assets.objects.polygons import cut_dented

_HEADER = 1 << 16  # bytes
_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_TYPES |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_TYPES |= {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
_FACES = re.compile(rb"element[ ]+face[^\n]*\n(?:(?:property|comment)[^\n]*\n)*")
_LINE = re.compile(rb"[^\r\n]*[^\s][^\r\n]*\r?\n?")


def _size(kind: str) -> int:
    """Bytes of a number of this type."""
    return np.dtype(_TYPES[kind]).itemsize


class _Element(NamedTuple):
    """An element of a header, with the words of its properties."""

    name: str
    rows: int
    properties: list[list[str]]

    def least(self, is_text: bool) -> int:
        """Least bytes of a row: a list has those of its length, a number of text two."""
        types = (row[1] if row[0] == "list" else row[0] for row in self.properties)
        return sum(2 if is_text else _size(kind) for kind in types)


def plain_ply(data: bytes, notes: list[str]) -> bytes:
    """The file with triangles alone, if each element has at least the bytes of its rows; raises a ValueError.

    Args:
      data: content of the file.
      notes: the number of polygons that could not be cut is appended.
    """
    header, end, _ = data[:_HEADER].partition(b"end_header")
    if not end:
        raise ValueError(f"its header does not end within {_HEADER} bytes")
    is_text, elements = b"ascii" in header, list[_Element]()
    for line in header.decode("latin-1").splitlines():
        match line.split():
            case ["element", "tristrips", count] if int(count):
                raise ValueError("its triangles are strips, which MeshLab opens and exports as faces")
            case ["element", name, count]:
                elements.append(_Element(name, int(count), []))
            case ["property", *words]:
                elements[-1].properties.append(words)
    for element in elements:
        if element.rows < 0 or (element.rows and not element.properties):
            raise ValueError(f"it announces an element of {element.rows} rows without values")
    if sum(element.rows * element.least(is_text) for element in elements) > len(data):
        raise ValueError(f"it announces {max(x.rows for x in elements)} rows, but has {len(data)} bytes")
    if [element.name for element in elements[:2]] != ["vertex", "face"]:
        return data
    vertex, face = elements[:2]
    lists = [row[0] == "list" for row in face.properties]
    if sum(lists) != 1 or any(row[0] == "list" for row in vertex.properties):
        return data
    start = data.index(b"\n", len(header)) + 1
    read = (_text_rows if is_text else _binary_rows)(data, start, vertex, face, lists.index(True))
    if read is None or max(itertools.chain(*read.polygons)) >= len(read.points):  # the latter is an error of its own
        return data
    large = [i for i, polygon in enumerate(read.polygons) if len(polygon) > 3]
    cut = cut_dented(read.points, [read.polygons[i] for i in large], notes)
    ears = dict(zip(large, map(cut.get, range(len(large))), strict=True))
    triangles = list[list[int]]()
    for i, polygon in enumerate(read.polygons):
        fan = [[0, k, k + 1] for k in range(1, len(polygon) - 1)]
        triangles += [[polygon[k] for k in triangle] for triangle in ears.get(i) or fan]
    rows = b"".join(b"3 %d %d %d\n" % tuple(row) for row in triangles)
    if not is_text:
        rows = _packed(triangles, _order(header))
    faces = f"element face {len(triangles)}\nproperty list uchar int vertex_indices\n".encode()
    return _FACES.sub(faces, data[:start], count=1) + data[start : read.first] + rows + data[read.end :]


def _order(header: bytes) -> str:
    return ">" if b"big_endian" in header else "<"


def _packed(triangles: list[list[int]], order: str) -> bytes:
    """Rows of a binary file."""
    rows = np.empty(len(triangles), [("count", "u1"), ("corners", f"{order}i4", 3)])
    rows["count"], rows["corners"] = 3, triangles
    return rows.tobytes()


class _Rows(NamedTuple):
    """The faces of a file that has other polygons than triangles."""

    polygons: Sequence[Sequence[int]]
    points: np.ndarray
    """(V, 3)."""
    first: int
    """Place of the first face in the file."""
    end: int


def _text_rows(data: bytes, start: int, vertex: _Element, face: _Element, place: int) -> _Rows | None:
    """The faces of a text file, with their list at a place in the row; None if they are triangles."""
    simple = data[start:].split(b"\n")[vertex.rows : vertex.rows + face.rows]
    if place == 0 and all(row.startswith(b"3 ") for row in simple):
        return None
    lines = list(itertools.islice(_LINE.finditer(data, start), vertex.rows + face.rows))
    words = [row[0].split() for row in lines[vertex.rows :]]
    columns = [[row[-1] for row in vertex.properties].index(axis) for axis in "xyz"]
    corners = (row[0].split() for row in lines[: vertex.rows])
    points = np.array([[float(row[k]) for k in columns] for row in corners])
    polygons = [[*map(int, row[place + 1 : place + 1 + int(row[place])])] for row in words]
    return _Rows(polygons, points, lines[vertex.rows].start(), lines[-1].end())


def _binary_rows(data: bytes, start: int, vertex: _Element, face: _Element, place: int) -> _Rows | None:
    """Those of a binary file."""
    order = _order(data[:start])
    row = np.dtype([(words[-1], order + _TYPES[words[0]]) for words in vertex.properties])
    count, index = (np.dtype(order + _TYPES[word]) for word in face.properties[place][1:3])
    before, after = (
        sum(_size(words[0]) for words in some) for some in (face.properties[:place], face.properties[place + 1 :])
    )
    first = at = start + vertex.rows * row.itemsize
    width = before + count.itemsize + 3 * index.itemsize + after
    if first + face.rows * width <= len(data):
        counts = np.ndarray(face.rows, count, data, first + before, (width,))
        if (counts == 3).all():
            return None
    corners = np.frombuffer(data, row, vertex.rows, start)
    polygons = list[Sequence[int]]()
    for _ in range(face.rows):
        (corners_of,) = struct.unpack_from(order + count.char, data, at + before)
        at += before + count.itemsize
        polygons.append(struct.unpack_from(f"{order}{corners_of}{index.char}", data, at))
        at += corners_of * index.itemsize + after
    return _Rows(polygons, np.stack([corners[axis] for axis in "xyz"], -1).astype(float), first, at)
