"""PLY files: headers are checked before trimesh reads them, and polygons become triangles.

trimesh reads no binary files whose faces differ in their number of corners, which Blender and
others write.
"""

import re
import struct
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from congrasp.services.assets.objects.polygons import alike, cut_dented

_MAX_HEADER_BYTES = 1 << 16
_MAX_TRIANGLE_BYTES = 1 << 29
"""Bytes of the triangles that replace polygons."""
_CORNERS = "vertex_indices"
"""Name of the corners of a face, which trimesh requires."""
_CORNER_NAMES = {_CORNERS, "vertex_index"}
"""Names of the corners of a face that trimesh accepts."""
_COUNT = f"number of {_CORNERS}"
_TYPE_CODES = {
    "char": "b",
    "uchar": "B",
    "short": "h",
    "ushort": "H",
    "int": "i",
    "uint": "I",
    "float": "f",
    "double": "d",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "float32": "f",
    "float64": "d",
}
"""Codes of the types in a header, as `struct` and NumPy know them."""


class _Element(NamedTuple):
    """An element of a header."""

    name: str
    rows: int
    properties: list[list[str]]
    """Words of each property: a type and a name; or "list", two types and a name."""

    def row_type(self, order: str, corners: int = 0) -> np.dtype:
        """Type of a row of a binary file.

        Args:
          order: byte order, "<" or ">".
          corners: number of values of each list; "number of <list>" precedes them.
        """
        fields: list[tuple] = []
        for *words, name in self.properties:
            types = [order + _TYPE_CODES[word] for word in words if word != "list"]
            if len(types) == 1:
                fields.append((name, types[0]))
            else:
                fields.append((f"number of {name}", types[0]))
                fields.append((name, types[1], (corners,)))
        return np.dtype(fields)

    def binary_row(self, line: bytes) -> bytes:
        """A row of text as one of a little-endian binary file."""
        words = line.split()
        codes = ""
        for place, (kind, *types) in enumerate(self.properties):
            if kind == "list":
                corners = min(max(int(float(words[place])), 0), len(words))
                codes += _TYPE_CODES[types[0]] + corners * _TYPE_CODES[types[1]]
            else:
                codes += _TYPE_CODES[kind]
        values = [_value(code, word) for code, word in zip(codes, words, strict=False)]
        return struct.pack(f"<{codes}", *values)

    def lists(self) -> list[int]:
        """Places of the properties that are lists."""
        return [place for place, words in enumerate(self.properties) if words[0] == "list"]

    def header(self) -> list[str]:
        """Lines of the header."""
        properties = [" ".join(["property", *words]) for words in self.properties]
        return [f"element {self.name} {self.rows}", *properties]


class _Header(NamedTuple):
    """The header of a file."""

    text: bytes
    """All before "end_header"."""
    kind: str
    """"ascii", "binary_little_endian" or "binary_big_endian"."""
    comments: list[str]
    elements: list[_Element]

    def least_bytes(self) -> int:
        """Bytes of a file whose lists are empty; a value and a blank of text take two."""
        total = 0
        for element in self.elements:
            if self.kind == "ascii":
                row_bytes = 2 * len(element.properties)
            else:
                row_bytes = element.row_type("<").itemsize
            total += element.rows * row_bytes
        return total


class _Body(NamedTuple):
    """The rows of the vertices and of the faces of a binary file."""

    kind: str
    content: bytes
    vertex: _Element
    face: _Element

    @property
    def order(self) -> str:
        """Byte order, "<" or ">"."""
        return ">" if self.kind == "binary_big_endian" else "<"

    def vertices(self) -> np.ndarray:
        """Rows (V,) of the vertices."""
        return np.ndarray(self.vertex.rows, self.vertex.row_type(self.order), self.content)


def plain_ply(data: bytes, notes: list[str]) -> bytes:
    """Returns the file with triangles alone.

    Args:
      data: content of the file.
      notes: the numbers of edges, and of polygons that could not be cut, are appended.

    Raises:
      ValueError: an element has fewer bytes than its rows take, or lacks values.
    """
    header = _read_header(data)
    for element in header.elements:
        _check_element(element)
        if element.name == "edge" and element.rows:
            notes.append(f"edges left out: {element.rows}")
        new_name = _renamed_corners(element)
        if new_name is not None:
            data = new_name.sub(rb"\1" + _CORNERS.encode(), data, count=1)
            header_text = new_name.sub(rb"\1" + _CORNERS.encode(), header.text, count=1)
            header = header._replace(text=header_text)
    if header.least_bytes() > len(data):
        rows = max(element.rows for element in header.elements)
        raise ValueError(f"it announces {rows} rows, but has {len(data)} bytes")
    try:
        return _with_triangles(data, header, notes) or data
    except struct.error:
        raise ValueError("a row lacks values that its header announces, or has others") from None


def _value(code: str, word: bytes) -> float:
    """The number of a word, as `struct` takes it for a type."""
    return float(word) if code in "fd" else int(float(word))


def _read_header(data: bytes) -> _Header:
    """The header of a file.

    Raises:
      ValueError: it has no end, or its triangles are strips.
    """
    text, end, _ = data[:_MAX_HEADER_BYTES].partition(b"end_header")
    if not end:
        raise ValueError(f"its header does not end within {_MAX_HEADER_BYTES} bytes")
    lines = [line.decode("latin-1") for line in text.splitlines()]
    kind = ""
    elements: list[_Element] = []
    for line in lines:
        match line.split():
            case ["format", kind, *_]:
                pass
            case ["element", "tristrips", count] if int(count):
                raise ValueError(
                    "its triangles are strips, which MeshLab opens and exports as faces"
                )
            case ["element", name, count]:
                elements.append(_Element(name, int(count), []))
            case ["property", *words]:
                elements[-1].properties.append(words)
    comments = [line for line in lines if line.startswith("comment")]
    return _Header(text, kind, comments, elements)


def _check_element(element: _Element) -> None:
    """Raises a ValueError for a negative number of rows, and for missing properties."""
    if element.rows < 0 or (element.rows and not element.properties):
        raise ValueError(f"it announces an element of {element.rows} rows without values")
    names = {words[-1] for words in element.properties}
    if element.name == "vertex" and not names >= set("xyz"):
        raise ValueError("its vertices lack x, y or z")


def _renamed_corners(element: _Element) -> re.Pattern[bytes] | None:
    """A pattern of the property that trimesh knows by another name; None if there is none.

    Its first group is what precedes the name.

    Raises:
      ValueError: the faces have no list, or several of unknown names.
    """
    if element.name != "face" or not element.rows:
        return None
    if _CORNER_NAMES & {words[-1] for words in element.properties}:
        return None
    lists = [element.properties[place] for place in element.lists()]
    if len(lists) != 1 or _TYPE_CODES[lists[0][2]] in "fd":
        raise ValueError(f"its faces lack {_CORNERS}")
    name = lists[0][3].encode("latin-1")
    return re.compile(rb"(\n\s*property\s+list(?:\s+\w+){2}\s+)" + re.escape(name))


def _with_triangles(data: bytes, header: _Header, notes: list[str]) -> bytes | None:
    """The file with triangles for its polygons; None if trimesh reads it unchanged.

    That is a file of triangles alone, or of several lists; or one of an index out of range, which
    the caller reports.
    """
    match header.elements:
        case [_Element("vertex") as vertex, _Element("face") as face, *_] if face.rows:
            pass
        case _:
            return None
    if len(face.lists()) != 1 or vertex.lists():
        return None
    content = data[data.index(b"\n", len(header.text)) + 1 :]
    if header.kind == "ascii":
        body = _binary_body(content, vertex, face)
    else:
        body = _Body(header.kind, content, vertex, face)
    if body is None:
        return None
    (list_place,) = face.lists()
    face.properties[list_place][3] = _CORNERS
    vertices = body.vertices()
    tables = _face_tables(body, vertices.nbytes)
    corners = [table[_CORNERS].astype(int) for table in tables]
    if all(polygons.shape[1] == 3 for polygons in corners):
        return None
    if any(polygons.min() < 0 or polygons.max() >= vertex.rows for polygons in corners):
        return None
    triangle_count = sum(len(polygons) * (polygons.shape[1] - 2) for polygons in corners)
    triangle_type = face.row_type(body.order, 3)
    if triangle_count * triangle_type.itemsize > _MAX_TRIANGLE_BYTES:
        limit = _MAX_TRIANGLE_BYTES >> 20
        raise ValueError(f"the triangles of its polygons take more than {limit} MB")
    points = np.stack([vertices[axis] for axis in "xyz"], -1).astype(float)
    cuts = cut_dented(points, corners, notes)
    lines = [f"ply\nformat {body.kind} 1.0", *header.comments]
    lines += vertex.header()
    lines += face._replace(rows=triangle_count).header()
    lines.append("end_header\n")
    chunks = ["\n".join(lines).encode("latin-1"), body.content[: vertices.nbytes]]
    for table, polygons, dented in zip(tables, corners, cuts, strict=True):
        triangles = _triangle_rows(table, polygons, dented, triangle_type)
        chunks.append(triangles.tobytes())
    return b"".join(chunks)


def _binary_body(content: bytes, vertex: _Element, face: _Element) -> _Body | None:
    """The body of a text as that of a binary file; None if its faces are triangles alone.

    The types of the face's list become integers.
    """
    lines = [line for line in content.splitlines() if line.strip()][: vertex.rows + face.rows]
    vertex_lines = lines[: vertex.rows]
    face_lines = lines[vertex.rows :]
    (list_place,) = face.lists()
    if all(float(line.split()[list_place]) == 3 for line in face_lines):
        return None
    face.properties[list_place][1:3] = ["int", "int"]
    rows = [vertex.binary_row(line) for line in vertex_lines]
    rows += [face.binary_row(line) for line in face_lines]
    return _Body("binary_little_endian", b"".join(rows), vertex, face)


def _triangle_rows(
    table: np.ndarray,
    polygons: np.ndarray,
    dented: dict[int, list[list[int]]],
    triangle_type: np.dtype,
) -> np.ndarray:
    """Rows (m, n - 2) of the triangles that replace polygons of n corners.

    Args:
      table: (m,) rows of the polygons.
      polygons: (m, n) their corners.
      dented: triangles of the dented polygons by row; the others become fans.
      triangle_type: type of the rows.
    """
    corner_count = polygons.shape[1]
    fan = [[0, k, k + 1] for k in range(1, corner_count - 1)]
    places = np.tile(fan, (len(polygons), 1, 1))
    for row, triangles in dented.items():
        places[row] = triangles
    rows = np.empty(places.shape[:2], triangle_type)
    for name in table.dtype.names or ():
        if name == _CORNERS:
            rows[name] = np.take_along_axis(polygons[:, None], places, 2)
        else:
            rows[name] = table[name][:, None]
    rows[_COUNT] = 3
    return rows


def _face_tables(body: _Body, start: int) -> list[np.ndarray]:
    """Rows (m,) of the faces with three corners, of those with four, and so on.

    Args:
      body: the rows of the file.
      start: byte at which the faces start.

    Raises:
      ValueError: the file ends within a face, or one has a negative number of corners.
    """
    face = body.face
    content = body.content
    empty_row = face.row_type(body.order)
    corner_bytes = face.row_type(body.order, 1).itemsize - empty_row.itemsize
    count_type, count_offset = dict(empty_row.fields or {})[_COUNT][:2]
    read_count = struct.Struct(body.order + count_type.char).unpack_from
    (corners,) = read_count(content, start + count_offset)
    end = start + face.rows * (empty_row.itemsize + corners * corner_bytes)
    if corners > 2 and end <= len(content):
        table = np.ndarray(face.rows, face.row_type(body.order, corners), content, start)
        if (table[_COUNT] == corners).all():
            return [table]
    starts = np.empty(face.rows, int)
    counts = np.empty(face.rows, int)
    for row in range(face.rows):
        (corners,) = read_count(content, start + count_offset)
        starts[row] = start
        counts[row] = corners
        start += empty_row.itemsize + corners * corner_bytes
    if counts.min() < 0 or start > len(content):
        raise ValueError("it ends within a face, or one has a negative number of corners")
    tables = []
    for corners, rows in alike(counts):
        row_type = face.row_type(body.order, corners)
        windows = sliding_window_view(np.frombuffer(content, "u1"), row_type.itemsize)
        tables.append(windows[starts[rows]].view(row_type)[:, 0])
    return tables
