"""STL files of text or of binary records.

trimesh decides by the first word between the two, and trusts the number of triangles in the header.
Both are wrong in files that some programs write, so the content and the size decide here.
"""

import array
import codecs
import re

import numpy as np
import trimesh

from congrasp.services.assets.objects.text_number import parse_number

_HEADER_BYTES = 84
_TRIANGLE_BYTES = 50
_START_BYTES = 4096
"""Beginning of a file in which the first facet of text is searched for."""
_MIN_RECORDS = 4
"""Whole records from which a file with a wrong header is recognised."""
_UNIT_TOLERANCE = 1e-3
"""Largest deviation of a normal's length from 1."""
_MIN_PROPER_SHARE = 0.5
"""Bytes are triangles if more than this share of their records has an area."""
_MAX_SIZE_RATIO = 100
"""Largest coordinate of additional records, relative to that of the announced ones."""
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
_VERTEX = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)


def is_stl(start: bytes, size: int) -> bool:
    """Returns True for an STL file.

    Args:
      start: its beginning, at least 4096 bytes or all of it.
      size: bytes of the file.
    """
    return _has_announced_size(start, size) or _is_text(start) or _holds_records(start)


def read_stl(data: bytes, notes: list[str]) -> trimesh.Trimesh:
    """Returns the triangles of an STL file, which share no vertices.

    Args:
      data: content of the file.
      notes: a wrong number of triangles in the header, and bytes after the triangles, are appended.

    Raises:
      ValueError: it has no triangles, or is damaged.
    """
    if _is_text(data) and not _has_announced_size(data, len(data)):
        corners = _text_corners(data)
    else:
        corners = _binary_corners(data, notes)
    if not len(corners):
        raise ValueError("it has no triangles")
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    return trimesh.Trimesh(corners.reshape(-1, 3), faces, process=False)


def _announced_triangles(start: bytes) -> int:
    """Number of triangles in the header of a binary file."""
    return int.from_bytes(start[_HEADER_BYTES - 4 : _HEADER_BYTES], "little")


def _has_announced_size(start: bytes, size: int) -> bool:
    """True for a binary file of exactly the announced triangles, also if it begins like text."""
    expected = _HEADER_BYTES + _TRIANGLE_BYTES * _announced_triangles(start)
    return len(start) >= _HEADER_BYTES and size == expected


def _is_text(start: bytes) -> bool:
    """True for text; some writers use capitals, or begin with a byte order mark."""
    text = start[:_START_BYTES].removeprefix(codecs.BOM_UTF8).lstrip().lower()
    return text.startswith(b"solid") and re.search(rb"\bfacet\s", text) is not None


@np.errstate(all="ignore")
def _holds_records(start: bytes) -> bool:
    """True if binary records with unit normals follow the header, whatever count it announces."""
    count = _whole_records(start)
    if count < _MIN_RECORDS or start.isascii():
        return False
    records = np.frombuffer(start, _RECORD, count, _HEADER_BYTES)
    lengths = np.linalg.norm(records["normal"].astype(float), axis=-1)
    if not (np.abs(lengths - 1) < _UNIT_TOLERANCE).all():
        return False
    return _are_plausible(records, records)  # no count is known, so no other record is sound


def _whole_records(data: bytes) -> int:
    """Number of whole records after the header."""
    return max(len(data) - _HEADER_BYTES, 0) // _TRIANGLE_BYTES


def _text_corners(data: bytes) -> np.ndarray:
    """Corners (F, 3, 3) of text."""
    numbers = array.array("d")  # 8 bytes a number, where a list takes 32
    for row in _VERTEX.finditer(data):
        numbers.extend(map(parse_number, row.groups()))
    if len(numbers) % 9:
        raise ValueError("it ends within a triangle, or its facets are not triangles")
    return np.frombuffer(numbers).reshape(-1, 3, 3)


def _binary_corners(data: bytes, notes: list[str]) -> np.ndarray:
    """Corners (F, 3, 3) of the announced records.

    If the header's count is wrong, they are those of all whole records, provided that those beyond
    it are plausible.
    """
    announced = _announced_triangles(data)
    count = _whole_records(data)
    if not count:
        raise ValueError(
            "it has no triangles: neither text with 'facet' in it, nor whole binary records"
        )
    records = np.frombuffer(data, _RECORD, count, _HEADER_BYTES)
    sound = records[:announced] if announced else records
    if announced < count and not _are_plausible(records[announced:], sound):
        count = announced
    surplus_bytes = len(data) - _HEADER_BYTES - _TRIANGLE_BYTES * count
    if count != announced:
        notes.append(
            f"its header announces {announced} triangles, but it holds {count}, which were read"
        )
    elif surplus_bytes > 0:
        notes.append(f"{surplus_bytes} bytes after its triangles were ignored")
    return records["corners"][:count].astype(float)


@np.errstate(all="ignore")
def _are_plausible(records: np.ndarray, sound: np.ndarray) -> bool:
    """True if records are finite triangles with areas, and of similar size as sound records."""
    corners = records["corners"].astype(float)
    sound_corners = sound["corners"].astype(float)
    if not (np.isfinite(corners).all() and np.isfinite(sound_corners).all()):
        return False
    first_side = corners[:, 1] - corners[:, 0]
    second_side = corners[:, 2] - corners[:, 0]
    areas = np.linalg.norm(np.cross(first_side, second_side), axis=-1)
    if (areas > 0).mean() <= _MIN_PROPER_SHARE:
        return False
    return bool(np.abs(corners).max() < _MAX_SIZE_RATIO * np.abs(sound_corners).max())
