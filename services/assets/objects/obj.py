"""Text of OBJ files, prepared for trimesh.

trimesh reads no negative indices, which count back from the points so far, and cuts every polygon
by a fan from its first corner, which fills dents.
"""

import codecs
import itertools
import re

import numpy as np

from congrasp.services.assets.objects.polygons import alike, cut_dented
from congrasp.services.assets.objects.text_number import parse_number

NO_POINT = "a face refers to a point that is not in the file"
_INDENT = re.compile(rb"(?m)^[ \t]+")
_CONTINUED_LINE = re.compile(rb"\\\r?\n")
_RELATIVE_INDEX = re.compile(rb"(?m)^[ \t]*f[^\n]*[ \t/]-\d")
_INDEX_ZERO = re.compile(rb"(?m)^[ \t]*f[^\n]*[ \t]0+(?=[/\s]|$)")
_POINT = re.compile(rb"(?m)^[ \t]*v[ \t]+([^\n#]*)")
_POLYGON = re.compile(rb"(?m)^[ \t]*f((?:[ \t]+\d[\d/]*){4,})[ \t\r]*$")
_FACE_COMMENT = re.compile(rb"(?m)^([ \t]*f[^\n#]*)#[^\n]*")
_FACE = re.compile(rb"(?m)^[ \t]*f[ \t][^\n#]*")
_INDEX = re.compile(rb"[ \t](\d{1,18})")
_LINE = re.compile(rb"(?m)^l +\S+ +([^\n#]*)")


def plain_obj(data: bytes, notes: list[str]) -> bytes:
    """Returns the text with absolute indices and without dented polygons.

    Args:
      data: content of the file.
      notes: the numbers of edges, and of polygons that could not be cut, are appended.

    Raises:
      ValueError: a face has the index 0, or counts back to before the first point.
    """
    text = data.removeprefix(codecs.BOM_UTF8)
    if b"\n" not in text:
        text = text.replace(b"\r", b"\n")
    text = _INDENT.sub(b"", text).replace(b"\t", b" ")
    if _INDEX_ZERO.search(text):
        raise ValueError("a face has the index 0, but OBJ counts from 1")
    text = _CONTINUED_LINE.sub(b" ", text)
    text = _FACE_COMMENT.sub(rb"\1", text)
    edges = sum(len(ends.split()) for ends in _LINE.findall(text))
    if edges:
        notes.append(f"edges left out: {edges}")
    if _RELATIVE_INDEX.search(text):
        text = _with_absolute_indices(text)
    if _POLYGON.search(text):
        text = _cut_polygons(text, notes)
    return text


def lacks_points(data: bytes) -> bool:
    """Returns True if a face of an OBJ file refers to a point beyond the last one."""
    text = data.replace(b"\r", b"\n")
    points = len(_POINT.findall(text))
    for face in _FACE.findall(text):
        if any(int(index) > points for index in _INDEX.findall(face)):
            return True
    return False


def _with_absolute_indices(text: bytes) -> bytes:
    """The text with its negative indices replaced."""
    counts = {b"v": 0, b"vt": 0, b"vn": 0}
    lines = []
    for line in text.splitlines():
        words = line.split()
        keyword = words[0] if words else b""
        if keyword in counts:
            counts[keyword] += 1
        elif keyword == b"f":
            corners = [_absolute_corner(word, counts) for word in words[1:]]
            line = b" ".join([b"f", *corners])
        lines.append(line)
    return b"\n".join(lines)


def _absolute_corner(word: bytes, counts: dict[bytes, int]) -> bytes:
    """A corner such as 5/2/9, for one with negative indices.

    Args:
      word: the corner: a point, a texture coordinate and a normal, or the first of them.
      counts: number of each so far, in this order.

    Raises:
      ValueError: it counts back to before the first point.
    """
    indices = [
        _absolute_index(index, count)
        for index, count in zip(word.split(b"/"), counts.values(), strict=False)
    ]
    if not indices[0]:
        raise ValueError(NO_POINT)
    return b"/".join(indices)


def _absolute_index(index: bytes, count: int) -> bytes:
    """The absolute index for one such as -1 after `count` items; empty if there is none."""
    if not index.startswith(b"-"):
        return index
    if int(index) < -count:
        return b""
    return b"%d" % (int(index) + 1 + count)


def _cut_polygons(text: bytes, notes: list[str]) -> bytes:
    """The text with dented polygons cut into triangles inside of them."""
    points = _points(text)
    corners = [row.split() for row in _POLYGON.findall(text)]
    polygons = [_point_indices(words) for words in corners]
    if max(map(max, polygons)) >= len(points):
        return text  # trimesh's reader raises an IndexError, which `lacks_points` explains
    corner_counts = np.array([len(polygon) for polygon in polygons])
    rows_by_count = [rows for _, rows in alike(corner_counts)]
    groups = []
    for rows in rows_by_count:
        groups.append(np.array([polygons[row] for row in rows]))
    triangles_by_row: dict[int, bytes] = {}
    for rows, cuts in zip(rows_by_count, cut_dented(points, groups, notes), strict=True):
        for place, triangles in cuts.items():
            row = rows[place]
            triangles_by_row[row] = _faces(corners[row], triangles)
    row_numbers = itertools.count()
    return _POLYGON.sub(lambda match: triangles_by_row.get(next(row_numbers), match[0]), text)


def _points(text: bytes) -> np.ndarray:
    """(V, 3) the points of an OBJ text.

    Raises:
      ValueError: a point has fewer than three numbers, or other words.
    """
    rows = [row.split()[:3] for row in _POINT.findall(text)]
    if any(len(row) < 3 for row in rows):
        raise ValueError("a point has fewer than three numbers")
    numbers = [parse_number(word) for word in itertools.chain.from_iterable(rows)]
    return np.array(numbers).reshape(-1, 3)


def _point_indices(corners: list[bytes]) -> list[int]:
    """Index of the point of each corner, counted from 0."""
    return [int(corner.partition(b"/")[0]) - 1 for corner in corners]


def _faces(corners: list[bytes], triangles: list[list[int]]) -> bytes:
    """Lines of the triangles that replace a polygon with these corners."""
    lines = []
    for triangle in triangles:
        words = [corners[place] for place in triangle]
        lines.append(b"f " + b" ".join(words))
    return b"\n".join(lines)
