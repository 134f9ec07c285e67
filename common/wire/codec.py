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
from typing import Any, NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.wire import compression

try:  # the same checksum, seven times as fast if installed
    from isal.isal_zlib import crc32
except ImportError:
    from zlib import crc32

MAX_MESSAGE = 256 << 20
"""Default limit of a message's length in bytes."""
MAX_HEADER = 1 << 20
"""Limit of a header's length in bytes."""
_LENGTH_BYTES = 8
"""Length of the number of bytes of the header, at the beginning."""
_HEADER_START = b'{"__metadata__":{"checksum":"'
_CHECKSUM_DIGITS = 8
_ALIGNMENT_BYTES = 8
"""The data section begins at a multiple of this."""
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
    """A message that is sent more than once; its bytes are encoded on first use and stored."""

    @functools.cached_property
    def encoded(self) -> bytes:
        """The encoded message."""
        return _encode(self)


class CompressedMessage(SharedMessage):
    """A message whose encoded form is compressed; it arrives as a plain one."""

    @functools.cached_property
    def encoded(self) -> bytes:
        """The encoded and compressed message."""
        return compression.deflated(_encode(self))


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
    header: dict[str, Any] = {"__metadata__": {"checksum": "0" * _CHECKSUM_DIGITS, "meta": meta}}
    parts = []
    offset = 0
    crc = 0
    for name in order:
        array = arrays[name]
        end = offset + array.nbytes
        header[name] = {
            "dtype": _NAMES[array.dtype],
            "shape": array.shape,
            "data_offsets": [offset, end],
        }
        part = array.reshape(-1).view(np.uint8).data
        parts.append(part)
        crc = crc32(part, crc)
        offset = end
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % _ALIGNMENT_BYTES)
    if len(text) > MAX_HEADER:
        raise CongraspError(
            f"A message's header has {len(text)} bytes.",
            f"The limit is {MAX_HEADER}: send less metadata.",
        )
    after_checksum = text[len(_HEADER_START) + _CHECKSUM_DIGITS :]
    text = b"%s%08x%s" % (_HEADER_START, crc32(text, crc), after_checksum)
    return b"".join([len(text).to_bytes(_LENGTH_BYTES, "little"), text, *parts])


def decode(data: bytes, *, max_bytes: int = MAX_MESSAGE) -> Message:
    """Decodes bytes from an untrusted peer; the inverse of `encode`.

    Args:
      data: the bytes; the arrays of the result are views of them, and `encode` of the result
        returns the same bytes, or those of the plain form if they are compressed.
      max_bytes: limit of the message's length.

    Raises:
      CongraspError: the bytes are not an intact message; the message names the fault.
    """
    if len(data) > max_bytes:
        raise CongraspError(f"The message has {len(data)} bytes; the limit is {max_bytes}.")
    if data[: len(compression.FRAME_START)] == compression.FRAME_START:
        data = compression.inflated(data, max_bytes)
    text, section = _split(data)
    _check_checksum(text, section)
    header = _parse_header(text)
    meta = _parse_metadata(header.pop("__metadata__"))
    message = SharedMessage(_arrays(header, section), meta)
    vars(message)["encoded"] = data
    return message


def _split(data: bytes) -> tuple[bytes, memoryview]:
    """Returns the text of a message's header, and its data section."""
    if len(data) < _LENGTH_BYTES:
        raise CongraspError(f"The message is cut: it has only {len(data)} bytes.")
    length = int.from_bytes(data[:_LENGTH_BYTES], "little")
    if length > MAX_HEADER:
        raise CongraspError(
            f"The message's header claims {length} bytes; the limit is {MAX_HEADER}."
        )
    end = _LENGTH_BYTES + length
    if end > len(data):
        raise CongraspError(
            f"The message is cut inside its header: {len(data)} bytes of {end} or more."
        )
    return data[_LENGTH_BYTES:end], memoryview(data)[end:]


def _check_checksum(text: bytes, section: memoryview) -> None:
    """Raises a CongraspError if header or data section differ from what was sent."""
    if not text.startswith(_HEADER_START):
        raise CongraspError("The message does not begin with its checksum.")
    start = len(_HEADER_START)
    end = start + _CHECKSUM_DIGITS
    unsigned = text[:start] + b"0" * _CHECKSUM_DIGITS + text[end:]
    crc = crc32(unsigned, crc32(section))
    if text[start:end] != b"%08x" % crc:
        raise CongraspError("The message does not match its checksum.")


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
    little_endian = array.astype(array.dtype.newbyteorder("<"), copy=False)
    # `ascontiguousarray` makes a scalar one-dimensional.
    array = np.ascontiguousarray(little_endian).reshape(array.shape)
    if array.dtype not in _NAMES:
        raise CongraspError(
            f"The array {name!r} has dtype {array.dtype}.", f"Messages hold {', '.join(_DTYPES)}."
        )
    if not isinstance(name, str) or name == "__metadata__":
        raise CongraspError(f"{name!r} cannot be the name of an array.")
    return array


def _parse_header(text: bytes) -> dict[str, Any]:
    """Parses a JSON object without repeated keys, and without numbers that are not finite."""
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
    """Object of these pairs; raises a CongraspError for a repeated key."""
    result = dict(pairs)
    if len(result) < len(pairs):
        raise CongraspError("The message's header has a key twice.")
    return result


def _number(text: str) -> float:
    """Finite number of a text; raises a CongraspError for another."""
    number = float(text)
    if not math.isfinite(number):
        raise CongraspError(
            f"The message's header holds {text[:30]}, which is not a number in range."
        )
    return number


def _no_constant(name: str) -> Any:
    """Raises a CongraspError: Python's NaN and Infinity are not JSON."""
    raise CongraspError(f"The message's header holds {name}, which is not JSON.")


def _parse_metadata(entry: Any) -> dict[str, Any]:
    """Parses the metadata."""
    if not isinstance(entry, dict) or entry.keys() != {"checksum", "meta"}:
        raise CongraspError("The message lacks its metadata.")
    meta = entry["meta"]
    if not isinstance(meta, str):
        raise CongraspError("The message lacks its metadata.")
    return _parse_header(meta.encode(errors="replace"))


class _Entry(NamedTuple):
    """Description of an array in the header."""

    name: str
    dtype: np.dtype
    shape: tuple[int, ...]
    begin: int
    """First byte in the data section."""
    end: int
    """Byte after the last one."""


def _arrays(header: dict[str, Any], section: memoryview) -> dict[str, np.ndarray]:
    """Returns views of the arrays in a data section, which they must fill without gaps."""
    entries = [_parse_entry(name, entry) for name, entry in header.items()]
    entries.sort(key=lambda entry: (entry.begin, entry.end))
    arrays = {}
    position = 0
    for entry in entries:
        _check_range(entry, position, len(section))
        arrays[entry.name] = _view(entry, section)
        position = entry.end
    if position != len(section):
        raise CongraspError(
            f"The message has {len(section) - position} bytes that belong to no array."
        )
    return arrays


def _check_range(entry: _Entry, position: int, section_bytes: int) -> None:
    """Raises a CongraspError if an array does not begin at `position`, its length is not that of
    its dtype and shape, or it ends outside the data section.
    """
    name, dtype, shape, begin, end = entry
    if begin != position:
        raise CongraspError(
            f"The array {_short(name)} starts at byte {begin}, not at {position}: a gap or an "
            f"overlap."
        )
    if end - begin != math.prod(shape) * dtype.itemsize:
        raise CongraspError(
            f"The array {_short(name)} has {end - begin} bytes, which is not {dtype} times {shape}."
        )
    if end > section_bytes:
        raise CongraspError(
            f"The message is cut: the array {_short(name)} ends at {end} of {section_bytes} bytes."
        )


def _view(entry: _Entry, section: memoryview) -> np.ndarray:
    """Returns an array as a view of the data section."""
    data = section[entry.begin : entry.end]
    if entry.dtype.kind != "b":
        return np.frombuffer(data, entry.dtype).reshape(entry.shape)
    array = np.frombuffer(data, np.uint8)
    if array.size and array.max() > 1:
        raise CongraspError(f"The array {_short(entry.name)} has booleans other than 0 and 1.")
    return array.view(bool).reshape(entry.shape)


def _parse_entry(name: str, entry: Any) -> _Entry:
    """Parses an array's entry of the header."""
    if not isinstance(entry, dict) or entry.keys() != {"dtype", "shape", "data_offsets"}:
        raise CongraspError(
            f"The array {_short(name)} is not described by dtype, shape and data_offsets."
        )
    dtype = entry["dtype"]
    shape = entry["shape"]
    offsets = entry["data_offsets"]
    if not isinstance(dtype, str) or dtype not in _DTYPES:
        raise CongraspError(
            f"The array {_short(name)} has dtype {_short(dtype)}.",
            f"Messages hold {', '.join(_DTYPES)}.",
        )
    if not _is_shape(shape):
        raise CongraspError(
            f"The array {_short(name)} has shape {_short(shape)}, which is not valid."
        )
    if not _is_counts(offsets) or len(offsets) != 2:
        raise CongraspError(
            f"The array {_short(name)} has data_offsets {_short(offsets)}, which is not a valid "
            f"range."
        )
    begin, end = offsets
    return _Entry(name, _DTYPES[dtype], tuple(shape), begin, end)


def _is_shape(value: Any) -> bool:
    """True if a value is a shape within the limits."""
    if not _is_counts(value) or len(value) > _MAX_DIMENSIONS:
        return False
    return math.prod(size or 1 for size in value) < _MAX_ITEMS


def _is_counts(value: Any) -> bool:
    """True if a value is a list of integers from zero to below `_MAX_ITEMS`."""
    if not isinstance(value, list):
        return False
    return all(type(item) is int and 0 <= item < _MAX_ITEMS for item in value)


def _short(value: Any) -> str:
    """Untrusted value as printable text of bounded length."""
    return ascii(value)[:60]
