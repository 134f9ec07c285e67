"""Encodes messages as bytes: named arrays and metadata in the safetensors format, checked strictly
on arrival.

The layout is that of https://github.com/huggingface/safetensors: eight bytes with the header's
length, a JSON header that gives each array's dtype, shape and byte range, then the arrays. Encoding
copies each array once; decoding copies nothing, its arrays are read-only views of the message. The
header's `__metadata__` holds the CRC-32 of the data section and the header with zeros in its place
(`checksum`), and the message's metadata as JSON text (`meta`).
"""

import dataclasses
import functools
import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from congrasp.common.errors import CongraspError

try:  # the same checksum, seven times as fast if installed
    from isal.isal_zlib import crc32
except ImportError:
    from zlib import crc32

MAX_MESSAGE = 256 << 20
"""Default limit of a message's length in bytes."""
MAX_HEADER = 1 << 20
"""Limit of a header's length in bytes."""
_BEGIN, _DIGITS = b'{"__metadata__":{"checksum":"', 8
_MAX_DIMENSIONS = 8
_MAX_ITEMS = 1 << 40
_DTYPES = {
    name: np.dtype(code)
    for name, code in {
        "F64": "<f8",
        "F32": "<f4",
        "F16": "<f2",
        "I64": "<i8",
        "I32": "<i4",
        "I16": "<i2",
        "I8": "|i1",
        "U64": "<u8",
        "U32": "<u4",
        "U16": "<u2",
        "U8": "|u1",
        "BOOL": "|b1",
    }.items()
}
_NAMES = {dtype: name for name, dtype in _DTYPES.items()}


@dataclasses.dataclass(frozen=True, eq=False)
class Message:
    """Message between processes; immutable."""

    arrays: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """NumPy arrays by name, or device arrays inside one process."""
    meta: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Metadata, as JSON values."""


class SharedMessage(Message):
    """A message that is sent more than once; its bytes are encoded on first use and kept."""

    @functools.cached_property
    def encoded(self) -> bytes:
        """The encoded message."""
        return _encode(self)


def encode(message: Message) -> bytes:
    """Encodes a message as safetensors bytes.

    Raises:
      CongraspError: an array's dtype or name, or the metadata, cannot be represented.
    """
    return message.encoded if isinstance(message, SharedMessage) else _encode(message)


def _encode(message: Message) -> bytes:
    try:
        meta = json.dumps(dict(message.meta), allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise CongraspError(f"A message's metadata cannot be written as JSON: {error}.") from None
    arrays = {name: _portable(name, array) for name, array in message.arrays.items()}
    # Wide dtypes first, so that every array starts at a multiple of its item's size.
    order = sorted(arrays, key=lambda name: (-arrays[name].itemsize, name))
    header: dict[str, Any] = {"__metadata__": {"checksum": "0" * _DIGITS, "meta": meta}}
    parts, offset, crc = [], 0, 0
    for name in order:
        array = arrays[name]
        end = offset + array.nbytes
        header[name] = {
            "dtype": _NAMES[array.dtype],
            "shape": array.shape,
            "data_offsets": [offset, end],
        }
        parts.append(array.reshape(-1).view(np.uint8).data)
        crc = crc32(parts[-1], crc)
        offset = end
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    if len(text) > MAX_HEADER:
        raise CongraspError(
            f"A message's header has {len(text)} bytes.",
            f"The limit is {MAX_HEADER}: send less metadata.",
        )
    text = b"%s%08x%s" % (_BEGIN, crc32(text, crc), text[len(_BEGIN) + _DIGITS :])
    return b"".join([len(text).to_bytes(8, "little"), text, *parts])


def decode(data: bytes, *, max_bytes: int = MAX_MESSAGE) -> Message:
    """Decodes bytes from an untrusted peer; the inverse of `encode`.

    Args:
      data: the bytes; the arrays of the result are views of them, and `encode` of the result
        returns the same bytes.
      max_bytes: limit of the message's length.

    Raises:
      CongraspError: the bytes are not an intact message; the message names the fault.
    """
    if len(data) > max_bytes:
        raise CongraspError(f"The message has {len(data)} bytes; the limit is {max_bytes}.")
    if len(data) < 8:
        raise CongraspError(f"The message is cut: it has only {len(data)} bytes.")
    length = int.from_bytes(data[:8], "little")
    if length > MAX_HEADER:
        raise CongraspError(
            f"The message's header claims {length} bytes; the limit is {MAX_HEADER}."
        )
    if 8 + length > len(data):
        raise CongraspError(
            f"The message is cut inside its header: {len(data)} bytes of {8 + length} or more."
        )
    text, section = data[8 : 8 + length], memoryview(data)[8 + length :]
    if not text.startswith(_BEGIN):
        raise CongraspError("The message does not begin with its checksum.")
    digits = slice(len(_BEGIN), len(_BEGIN) + _DIGITS)
    crc = crc32(text[: digits.start] + b"0" * _DIGITS + text[digits.stop :], crc32(section))
    if text[digits] != b"%08x" % crc:
        raise CongraspError("The message does not match its checksum.")
    header = _header(text)
    meta = _metadata(header.pop("__metadata__"))
    message = SharedMessage(_arrays(header, section), meta)
    vars(message)["encoded"] = data
    return message


def finite(value: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a JSON object without numbers that are NaN or infinite, at any depth, since metadata
    cannot hold them.
    """
    result: dict[str, Any] = {}
    for name, item in value.items():
        if isinstance(item, Mapping):
            result[name] = finite(item)
        elif not isinstance(item, float) or math.isfinite(item):
            result[name] = item
    return result


def checksum(message: Message) -> str:
    """Checksum of a message's arrays with their names, dtypes and shapes; the same at both ends of
    a link.
    """
    crc = 0
    for name in sorted(message.arrays):
        array = _portable(name, message.arrays[name])
        crc = crc32(f"{name} {_NAMES[array.dtype]} {array.shape} ".encode(), crc)
        crc = crc32(array.reshape(-1).view(np.uint8).data, crc)
    return f"{crc:08x}"


def _portable(name: str, value: Any) -> np.ndarray:
    """Returns the array as contiguous and little-endian; raises an error for an unsupported
    dtype.
    """
    array = np.asarray(value)
    array = np.ascontiguousarray(array.astype(array.dtype.newbyteorder("<"), copy=False)).reshape(
        array.shape
    )
    if array.dtype not in _NAMES:
        raise CongraspError(
            f"The array {name!r} has dtype {array.dtype}.", f"Messages hold {', '.join(_DTYPES)}."
        )
    if not isinstance(name, str) or name == "__metadata__":
        raise CongraspError(f"{name!r} cannot be the name of an array.")
    return array


def _header(text: bytes) -> dict[str, Any]:
    try:
        header = json.loads(
            text.decode(),
            object_pairs_hook=_unique,
            parse_constant=_no_constant,
            parse_float=_number,
        )
    except (ValueError, RecursionError) as error:
        raise CongraspError(f"The message's header is not JSON: {str(error)[:80]}.") from None
    if not isinstance(header, dict):
        raise CongraspError("The message's header is not a JSON object.")
    return header


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) < len(pairs):
        raise CongraspError("The message's header has a key twice.")
    return result


def _number(text: str) -> float:
    if not math.isfinite(number := float(text)):
        raise CongraspError(
            f"The message's header holds {text[:30]}, which is not a number in range."
        )
    return number


def _no_constant(name: str) -> Any:
    raise CongraspError(f"The message's header holds {name}, which is not JSON.")


def _metadata(entry: Any) -> dict[str, Any]:
    """Parses the metadata."""
    if (
        not isinstance(entry, dict)
        or entry.keys() != {"checksum", "meta"}
        or not isinstance(entry["meta"], str)
    ):
        raise CongraspError("The message lacks its metadata.")
    return _header(entry["meta"].encode(errors="replace"))


def _arrays(header: dict[str, Any], section: memoryview) -> dict[str, np.ndarray]:
    entries = sorted(
        ((name, *_entry(name, entry)) for name, entry in header.items()),
        key=lambda entry: entry[3:],
    )
    arrays, position = {}, 0
    for name, dtype, shape, begin, end in entries:
        if begin != position:
            raise CongraspError(
                f"The array {_short(name)} starts at byte {begin}, not at {position}: a gap or an "
                f"overlap."
            )
        if end - begin != math.prod(shape) * dtype.itemsize:
            raise CongraspError(
                f"The array {_short(name)} has {end - begin} bytes, which is not {dtype} times "
                f"{shape}."
            )
        if end > len(section):
            raise CongraspError(
                f"The message is cut: the array {_short(name)} ends at {end} of {len(section)} "
                f"bytes."
            )
        is_bool = dtype.kind == "b"
        array = np.frombuffer(section[begin:end], np.uint8 if is_bool else dtype)
        if is_bool:
            if array.size and array.max() > 1:
                raise CongraspError(f"The array {_short(name)} has booleans other than 0 and 1.")
            array = array.view(bool)
        arrays[name] = array.reshape(shape)
        position = end
    if position != len(section):
        raise CongraspError(
            f"The message has {len(section) - position} bytes that belong to no array."
        )
    return arrays


def _entry(name: str, entry: Any) -> tuple[np.dtype, tuple[int, ...], int, int]:
    """Dtype, shape and byte range of a header's entry."""
    if not isinstance(entry, dict) or entry.keys() != {"dtype", "shape", "data_offsets"}:
        raise CongraspError(
            f"The array {_short(name)} is not described by dtype, shape and data_offsets."
        )
    dtype, shape, offsets = entry["dtype"], entry["shape"], entry["data_offsets"]
    if not isinstance(dtype, str) or dtype not in _DTYPES:
        raise CongraspError(
            f"The array {_short(name)} has dtype {_short(dtype)}.",
            f"Messages hold {', '.join(_DTYPES)}.",
        )
    if (
        not _is_counts(shape)
        or len(shape) > _MAX_DIMENSIONS
        or math.prod(size or 1 for size in shape) >= _MAX_ITEMS
    ):
        raise CongraspError(
            f"The array {_short(name)} has shape {_short(shape)}, which is not valid."
        )
    if not _is_counts(offsets) or len(offsets) != 2:
        raise CongraspError(
            f"The array {_short(name)} has data_offsets {_short(offsets)}, which is not a valid "
            f"range."
        )
    return _DTYPES[dtype], tuple(shape), offsets[0], offsets[1]


def _is_counts(value: Any) -> bool:
    return isinstance(value, list) and all(
        type(item) is int and 0 <= item < _MAX_ITEMS for item in value
    )


def _short(value: Any) -> str:
    """Untrusted value as printable text of bounded length."""
    return ascii(value)[:60]
