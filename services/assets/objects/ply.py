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


class _FaceLayout(NamedTuple):
    """Layout of the faces in a binary file."""

    start: int
    """First byte of the first face."""
    empty_bytes: int
    """Bytes of a face without corners."""
    corner_bytes: int
    count_offset: int
    """Bytes of a face before its number of corners."""
    count_form: struct.Struct
    """Type of the number of corners."""

    def corner_count(self, content: bytes, start: int) -> int:
        """Number of corners of the face that starts at a byte."""
        (corners,) = self.count_form.unpack_from(content, start + self.count_offset)
        return corners

    def face_bytes(self, corners: int) -> int:
        """Bytes of a face."""
        return self.empty_bytes + corners * self.corner_bytes


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

    def points(self) -> np.ndarray:
        """Positions (V, 3) of the vertices."""
        vertices = self.vertices()
        return np.stack([vertices[axis] for axis in "xyz"], -1).astype(float)

    def face_layout(self) -> _FaceLayout:
        """Layout of the faces, which follow the vertices."""
        empty_row = self.face.row_type(self.order)
        one_corner_row = self.face.row_type(self.order, 1)
        count_type, count_offset = dict(empty_row.fields or {})[_COUNT][:2]
        return _FaceLayout(
            start=self.vertices().nbytes,
            empty_bytes=empty_row.itemsize,
            corner_bytes=one_corner_row.itemsize - empty_row.itemsize,
            count_offset=count_offset,
            count_form=struct.Struct(self.order + count_type.char),
        )


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
        return _with_triangles(data, header, notes)
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


def _with_triangles(data: bytes, header: _Header, notes: list[str]) -> bytes:
    """The file with triangles for its polygons.

    The file is returned unchanged if trimesh reads its faces (`_has_polygons`), if all of them are
    triangles, and if a corner is out of range, which the caller reports.
    """
    if not _has_polygons(header.elements):
        return data
    body = _read_body(data, header)
    if body is None:
        return data
    tables = _face_tables(body)
    polygons = [table[_CORNERS].astype(int) for table in tables]
    if all(corners.shape[1] == 3 for corners in polygons):
        return data
    if any(corners.min() < 0 or corners.max() >= body.vertex.rows for corners in polygons):
        return data
    triangle_count = sum(len(corners) * (corners.shape[1] - 2) for corners in polygons)
    triangle_type = body.face.row_type(body.order, 3)
    if triangle_count * triangle_type.itemsize > _MAX_TRIANGLE_BYTES:
        limit = _MAX_TRIANGLE_BYTES >> 20
        raise ValueError(f"the triangles of its polygons take more than {limit} MB")
    cuts = cut_dented(body.points(), polygons, notes)
    triangles = [
        _triangle_rows(table, corners, dented, triangle_type)
        for table, corners, dented in zip(tables, polygons, cuts, strict=True)
    ]
    return _triangle_file(body, header.comments, triangles)


def _has_polygons(elements: list[_Element]) -> bool:
    """True for a file of vertices and then faces, with the faces' corners as its only list."""
    if [element.name for element in elements[:2]] != ["vertex", "face"]:
        return False
    vertex, face = elements[:2]
    return face.rows > 0 and len(face.lists()) == 1 and not vertex.lists()


def _read_body(data: bytes, header: _Header) -> _Body | None:
    """The rows of a file's vertices and polygons; None for a text of triangles alone.

    Args:
      data: content of a file with polygons (`_has_polygons`).
      header: its header.
    """
    vertex, face = header.elements[:2]
    content = data[data.index(b"\n", len(header.text)) + 1 :]
    if header.kind == "ascii":
        return _binary_body(content, vertex, face)
    (list_place,) = face.lists()
    _, count_type, corner_type, _ = face.properties[list_place]
    return _Body(header.kind, content, vertex, _with_corners(face, count_type, corner_type))


def _with_corners(face: _Element, count_type: str, corner_type: str) -> _Element:
    """The element of the faces with types for its list, which gets the name of corners."""
    (list_place,) = face.lists()
    properties = face.properties.copy()
    properties[list_place] = ["list", count_type, corner_type, _CORNERS]
    return face._replace(properties=properties)


def _binary_body(content: bytes, vertex: _Element, face: _Element) -> _Body | None:
    """The rows of a text as those of a binary file, with integers in the faces' list.

    None if all faces are triangles.
    """
    lines = [line for line in content.splitlines() if line.strip()][: vertex.rows + face.rows]
    vertex_lines = lines[: vertex.rows]
    face_lines = lines[vertex.rows :]
    (list_place,) = face.lists()
    if all(float(line.split()[list_place]) == 3 for line in face_lines):
        return None
    face = _with_corners(face, "int", "int")
    rows = [vertex.binary_row(line) for line in vertex_lines]
    rows += [face.binary_row(line) for line in face_lines]
    return _Body("binary_little_endian", b"".join(rows), vertex, face)


def _triangle_file(body: _Body, comments: list[str], triangles: list[np.ndarray]) -> bytes:
    """A binary file of the body's vertices with triangles as its faces.

    Args:
      body: the vertices, and the element of the faces.
      comments: lines of comments in the header.
      triangles: (m, t) rows of the faces.
    """
    triangle_count = sum(rows.size for rows in triangles)
    lines = [f"ply\nformat {body.kind} 1.0", *comments]
    lines += body.vertex.header()
    lines += body.face._replace(rows=triangle_count).header()
    lines.append("end_header\n")
    header = "\n".join(lines).encode("latin-1")
    vertices = body.content[: body.vertices().nbytes]
    return b"".join([header, vertices, *(rows.tobytes() for rows in triangles)])


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


def _face_tables(body: _Body) -> list[np.ndarray]:
    """Rows (m,) of the faces with three corners, of those with four, and so on.

    Raises:
      ValueError: the file ends within a face, or one has a negative number of corners.
    """
    layout = body.face_layout()
    table = _equal_faces(body, layout)
    if table is not None:
        return [table]
    starts, counts = _find_faces(body, layout)
    tables = []
    for corners, rows in alike(counts):
        row_type = body.face.row_type(body.order, corners)
        windows = sliding_window_view(np.frombuffer(body.content, "u1"), row_type.itemsize)
        tables.append(windows[starts[rows]].view(row_type)[:, 0])
    return tables


def _equal_faces(body: _Body, layout: _FaceLayout) -> np.ndarray | None:
    """Rows (F,) of faces that all have as many corners; None if their numbers differ."""
    face = body.face
    corners = layout.corner_count(body.content, layout.start)
    end = layout.start + face.rows * layout.face_bytes(corners)
    if corners < 3 or end > len(body.content):
        return None
    row_type = face.row_type(body.order, corners)
    table = np.ndarray(face.rows, row_type, body.content, layout.start)
    if (table[_COUNT] != corners).any():
        return None
    return table


def _find_faces(body: _Body, layout: _FaceLayout) -> tuple[np.ndarray, np.ndarray]:
    """First bytes (F,) of the faces, and their numbers (F,) of corners.

    Raises:
      ValueError: see `_face_tables`.
    """
    face_count = body.face.rows
    starts = np.empty(face_count, int)
    counts = np.empty(face_count, int)
    start = layout.start
    for row in range(face_count):
        corners = layout.corner_count(body.content, start)
        starts[row] = start
        counts[row] = corners
        start += layout.face_bytes(corners)
    if counts.min() < 0 or start > len(body.content):
        raise ValueError("it ends within a face, or one has a negative number of corners")
    return starts, counts
