"""Messages as bytes: the safetensors format, with the message's JSON and a checksum in its metadata.

Written and read here because one join and `numpy.frombuffer` are several times faster than the library, and because
everything that arrives is checked: sizes, offsets, types, full coverage and the CRC-32 of the data.
"""

import dataclasses
import json
import math
import struct
import zlib
from typing import Any

import numpy as np

from common.errors import CongraspError

MAX_HEADER = 1 << 20
MAX_MESSAGE = 256 << 20
_DTYPES = {
    "BOOL": "?",
    "U8": "u1",
    "I8": "i1",
    "U16": "<u2",
    "I16": "<i2",
    "F16": "<f2",
    "U32": "<u4",
    "I32": "<i4",
    "F32": "<f4",
    "U64": "<u8",
    "I64": "<i8",
    "F64": "<f8",
}
_NAMES = {np.dtype(code): name for name, code in _DTYPES.items()}


@dataclasses.dataclass(frozen=True)
class Message:
    """Named arrays and a JSON object. In one process the arrays may stay on the device."""

    arrays: dict[str, Any]
    meta: dict[str, Any]


def encode(message: Message) -> bytes:
    """The message as bytes; a file with them is a valid `.safetensors` file."""
    header: dict[str, Any] = {}
    parts: list[Any] = []
    offset = 0
    for name, value in message.arrays.items():
        array = np.asarray(value)
        array = np.ascontiguousarray(array.astype(array.dtype.newbyteorder("<"), copy=False)).reshape(array.shape)
        if array.dtype not in _NAMES:
            raise CongraspError(f"The array '{name}' has type {array.dtype}, which messages cannot carry.")
        header[name] = {
            "dtype": _NAMES[array.dtype],
            "shape": list(array.shape),
            "data_offsets": [offset, offset + array.nbytes],
        }
        offset += array.nbytes
        parts.append(array.reshape(-1).view(np.uint8).data if array.nbytes else b"")
    checksum = 0
    for part in parts:
        checksum = zlib.crc32(part, checksum)
    header["__metadata__"] = {"meta": json.dumps(message.meta), "crc32": str(checksum)}
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    if len(text) > MAX_HEADER:
        raise CongraspError(f"The message's header takes {len(text)} bytes, more than {MAX_HEADER}.")
    return b"".join([struct.pack("<Q", len(text)), text, *parts])


def decode(data: bytes, *, max_bytes: int = MAX_MESSAGE) -> Message:
    """The inverse of `encode`; arrays are read-only views of `data`. Anything damaged is a `CongraspError`."""
    if len(data) > max_bytes:
        raise CongraspError(f"The message has {len(data)} bytes, more than the {max_bytes} allowed.")
    if len(data) < 8:
        raise CongraspError("The message is cut off: it has no header.")
    (size,) = struct.unpack_from("<Q", data)
    if size > MAX_HEADER or 8 + size > len(data):
        raise CongraspError(f"The message's header claims {size} bytes: it is damaged or not a message.")
    try:
        header = json.loads(data[8 : 8 + size], object_pairs_hook=_unique)
        metadata = header.pop("__metadata__")
        meta = json.loads(metadata["meta"])
        checksum = int(metadata["crc32"])
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise CongraspError(f"The message's header cannot be read ({error}).") from None
    if not isinstance(meta, dict):
        raise CongraspError("The message's metadata is not a JSON object.")
    body = memoryview(data)[8 + size :]
    arrays, end = {}, 0
    for name, entry in header.items():
        arrays[name], end = _array(name, entry, body, end)
    if end != len(body):
        raise CongraspError(f"The message has {len(body) - end} bytes that belong to no array.")
    if zlib.crc32(body) != checksum:
        raise CongraspError("The message's checksum is wrong: it was damaged on its way.")
    return Message(arrays, meta)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len({key for key, _ in pairs}) != len(pairs):
        raise ValueError("a name stands twice")
    return dict(pairs)


def _array(name: str, entry: Any, body: memoryview, start: int) -> tuple[np.ndarray, int]:
    try:
        dtype = np.dtype(_DTYPES[entry["dtype"]])
        shape = tuple(entry["shape"])
        first, last = entry["data_offsets"]
    except (KeyError, TypeError, ValueError):
        raise CongraspError(f"The message's entry '{name}' is malformed.") from None
    whole = all(type(n) is int and n >= 0 for n in (*shape, first, last))
    if not whole or first != start or last > len(body) or last - first != math.prod(shape) * dtype.itemsize:
        raise CongraspError(f"The message's array '{name}' does not lie where its header says.")
    return np.frombuffer(body[first:last], dtype).reshape(shape), last
