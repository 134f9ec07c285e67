"""PLY files: their headers are checked before trimesh reads them, and their polygons become
triangles.

trimesh reads no binary files whose faces differ in their number of corners, which Blender and
others write.
"""

import re
import struct
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from congrasp.services.assets.objects.polygons import alike, cut_dented

_HEADER, _MOST = 1 << 16, 1 << 29  # bytes of a header, and of the triangles of polygons
_COUNT, _INDEX = "number of vertex_indices", "vertex_indices"  # the latter as trimesh names it
_TYPES = {
    "char": "b",
    "uchar": "B",
    "short": "h",
    "ushort": "H",
    "int": "i",
    "uint": "I",
    "float": "f",
    "double": "d",
}
_TYPES |= {"int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I"}
_TYPES |= {"float32": "f", "float64": "d"}


class _Element(NamedTuple):
    """An element of a header, with the words of its properties."""

    name: str
    rows: int
    properties: list[list[str]]

    def row(self, order: str, corners: int = 0) -> np.dtype:
        """A row of a binary file whose lists have so many values, with "number of" each before
        it.
        """
        fields = list[tuple]()
        for *words, name in self.properties:
            types = [order + _TYPES[word] for word in words if word != "list"]
            fields += (
                [(f"number of {name}", types[0]), (name, types[1], (corners,))]
                if types[1:]
                else [(name, types[0])]
            )
        return np.dtype(fields)

    def packed(self, line: bytes) -> bytes:
        """A row of text as one of a little-endian file."""
        words, types = line.split(), ""
        for i, (kind, *more) in enumerate(self.properties):
            corners = min(max(int(float(words[i])), 0), len(words)) if kind == "list" else 0
            types += _TYPES[more[0]] + corners * _TYPES[more[1]] if kind == "list" else _TYPES[kind]
        values = (
            float(word) if kind in "fd" else int(float(word))
            for kind, word in zip(types, words, strict=False)
        )
        return struct.pack(f"<{types}", *values)


def plain_ply(data: bytes, notes: list[str]) -> bytes:  # noqa: C901
    """The file with triangles alone, if each element has at least the bytes of its rows; raises a
    ValueError.

    Args:
      data: content of the file.
      notes: the numbers of edges, and of polygons that could not be cut, are appended.
    """
    header, end, _ = data[:_HEADER].partition(b"end_header")
    if not end:
        raise ValueError(f"its header does not end within {_HEADER} bytes")
    lines, kind, elements = (
        [line.decode("latin-1") for line in header.splitlines()],
        "",
        list[_Element](),
    )
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
    least = 0
    for element in elements:
        if element.rows < 0 or (element.rows and not element.properties):
            raise ValueError(f"it announces an element of {element.rows} rows without values")
        names = {words[-1] for words in element.properties}
        if element.name == "vertex" and not names >= set("xyz"):
            raise ValueError("its vertices lack x, y or z")
        if element.name == "face" and element.rows and not names & {_INDEX, "vertex_index"}:
            lists = [words for words in element.properties if words[0] == "list"]
            if len(lists) != 1 or _TYPES[lists[0][2]] in "fd":
                raise ValueError(f"its faces lack {_INDEX}")
            named = re.compile(
                rb"(\n\s*property\s+list(?:\s+\w+){2}\s+)"
                + re.escape(lists[0][3].encode("latin-1"))
            )
            data, header = (
                named.sub(rb"\1" + _INDEX.encode(), text, count=1) for text in (data, header)
            )
        if element.name == "edge" and element.rows:
            notes.append(f"edges left out: {element.rows}")
        least += element.rows * (
            2 * len(element.properties) if kind == "ascii" else element.row("<").itemsize
        )
    if least > len(data):
        raise ValueError(
            f"it announces {max(x.rows for x in elements)} rows, but has {len(data)} bytes"
        )
    body = data[data.index(b"\n", len(header)) + 1 :]
    match elements:
        case [_Element("vertex") as vertex, _Element("face") as face, *_] if face.rows:
            try:
                return (
                    _plain(
                        body,
                        kind,
                        [x for x in lines if x.startswith("comment")],
                        vertex,
                        face,
                        notes,
                    )
                    or data
                )
            except struct.error:
                raise ValueError(
                    "a row lacks values that its header announces, or has others"
                ) from None
    return data


def _plain(
    body: bytes, kind: str, comments: list[str], vertex: _Element, face: _Element, notes: list[str]
) -> bytes | None:
    """The file with triangles for the polygons of its body; None if it has only triangles, or
    several lists.

    Also for a corner without a point, which is an error of its own.
    """
    lists = [i for i, words in enumerate(face.properties) if words[0] == "list"]
    if len(lists) != 1 or any(words[0] == "list" for words in vertex.properties):
        return None
    if kind == "ascii":
        lines = [line for line in body.splitlines() if line.strip()][: vertex.rows + face.rows]
        if all(float(line.split()[lists[0]]) == 3 for line in lines[vertex.rows :]):
            return None
        kind, face.properties[lists[0]][1:3] = "binary_little_endian", ["int", "int"]
        body = b"".join(
            (vertex if i < vertex.rows else face).packed(line) for i, line in enumerate(lines)
        )
    order, face.properties[lists[0]][3:] = ">" if kind == "binary_big_endian" else "<", [_INDEX]
    values = np.ndarray(vertex.rows, vertex.row(order), body)
    tables = _tables(body, values.nbytes, face, order)
    corners = [table[_INDEX].astype(int) for table in tables]
    if all(some.shape[1] == 3 for some in corners) or any(
        x.min() < 0 or x.max() >= vertex.rows for x in corners
    ):
        return None
    count = sum(len(some) * (some.shape[1] - 2) for some in corners)
    if count * face.row(order, 3).itemsize > _MOST:
        raise ValueError(f"the triangles of its polygons take more than {_MOST >> 20} MB")
    cut = cut_dented(np.stack([values[axis] for axis in "xyz"], -1).astype(float), corners, notes)
    header = [f"ply\nformat {kind} 1.0", *comments]
    for element in (vertex, face._replace(rows=count)):
        header += [
            f"element {element.name} {element.rows}",
            *(" ".join(["property", *x]) for x in element.properties),
        ]
    parts = ["\n".join([*header, "end_header\n"]).encode("latin-1"), body[: values.nbytes]]
    for table, some, dented in zip(tables, corners, cut, strict=True):
        places = np.tile([[0, k, k + 1] for k in range(1, some.shape[1] - 1)], (len(some), 1, 1))
        for i, triangles in dented.items():
            places[i] = triangles
        rows = np.empty(places.shape[:2], face.row(order, 3))
        for name in table.dtype.names or ():
            rows[name] = (
                table[name][:, None]
                if name != _INDEX
                else np.take_along_axis(some[:, None], places, 2)
            )
        rows[_COUNT] = 3
        parts.append(rows.tobytes())
    return b"".join(parts)


def _tables(body: bytes, start: int, face: _Element, order: str) -> list[np.ndarray]:
    """Rows (m,) of the faces with three corners, with four and so on."""
    least, step = face.row(order), face.row(order, 1).itemsize - face.row(order).itemsize
    count, before = dict(least.fields or {})[_COUNT][:2]
    read = struct.Struct(order + count.char).unpack_from
    (n,) = read(body, start + before)
    if n > 2 and start + face.rows * (least.itemsize + n * step) <= len(body):
        table = np.ndarray(face.rows, face.row(order, n), body, start)
        if (table[_COUNT] == n).all():
            return [table]
    starts, counts = np.empty(face.rows, int), np.empty(face.rows, int)
    for i in range(face.rows):
        (n,) = read(body, start + before)
        starts[i], counts[i] = start, n
        start += least.itemsize + n * step
    if counts.min() < 0 or start > len(body):
        raise ValueError("it ends within a face, or one has a negative number of corners")
    return [
        sliding_window_view(np.frombuffer(body, "u1"), least.itemsize + n * step)[
            starts[some]
        ].view(face.row(order, n))[:, 0]
        for n, some in alike(counts)
    ]
