"""Chunks of MCAP files, whichever compression they use: inflated within limits, then parsed one
record at a time.

This is the only module that calls decompressors; their errors end here.
"""

import dataclasses
import io
import struct
import zlib
from collections.abc import Iterator

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Schema
from mcap.records import Message as McapMessage

from congrasp.common.errors import CongraspError

DAMAGE = (McapError, struct.error, ValueError, MemoryError, OverflowError)
"""Exceptions of the `mcap` package, and of this module, on damaged files."""
FRAME = struct.Struct("<BQ")
"""Opcode and length of a record."""
_MAX_CHUNK_BYTES = 512 << 20
"""Limit of an inflated chunk."""
COMPRESSIONS = ("zstd", "lz4")
"""Names of the compressions."""
_MESSAGE_HEAD_BYTES = 22  # of a message's record before its data
_INFLATED_BYTES = 128 << 20
"""Bytes to which the chunks of any file may inflate, in addition to `_MAX_RATIO` times its size."""
_MAX_RATIO = 20
"""See `_INFLATED_BYTES`; our recordings inflate to ten times their size."""


class DamagedChunkError(ValueError):
    """A chunk cannot be inflated, or its content does not match its checksum or form."""


@dataclasses.dataclass
class Budget:
    """Bytes to which the chunks of a file may still inflate."""

    left: int

    @classmethod
    def of(cls, size: int) -> "Budget":
        """Budget of a file of `size` bytes."""
        return cls(_INFLATED_BYTES + _MAX_RATIO * size)

    def take(self, count: int) -> None:
        """Takes `count` bytes.

        Raises:
          CongraspError: there are fewer left.
        """
        self.left -= count
        if self.left < 0:
            raise CongraspError(
                "The recording inflates to much more than its size.", "Record it again."
            )


def content_of(record: bytes, budget: Budget) -> bytes:
    """Inflates a chunk and checks its content.

    Args:
      record: the chunk's record without opcode and length.
      budget: bytes that may be inflated.

    Returns:
      The content, for `records_of`.

    Raises:
      DamagedChunkError: it is damaged, or exceeds `_MAX_CHUNK_BYTES`.
      CongraspError: the budget is spent.
    """
    try:
        chunk = Chunk.read(ReadDataStream(io.BytesIO(record)))
        content = _inflated(chunk, budget)
        if chunk.uncompressed_crc and zlib.crc32(content) != chunk.uncompressed_crc:
            raise DamagedChunkError("The checksum differs.")
        for opcode, start, end in _frames(content):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                _parsed(opcode, content[start:end])
            elif opcode == Opcode.MESSAGE and end - start < _MESSAGE_HEAD_BYTES:
                raise DamagedChunkError("A message lacks its fields.")
    except DAMAGE as error:
        raise DamagedChunkError(str(error)) from None
    return content


def records_of(content: bytes) -> Iterator[McapRecord]:
    """Yields the schemas, channels and messages of a chunk's content."""
    for opcode, start, end in _frames(content):
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            yield _parsed(opcode, content[start:end])


def _inflated(chunk: Chunk, budget: Budget) -> bytes:
    """Content of a chunk, whose size is checked before and while it inflates."""
    size = chunk.uncompressed_size
    if size > _MAX_CHUNK_BYTES:
        raise DamagedChunkError("The chunk is too large.")
    # One byte more, so that a chunk that exceeds its size or the budget is noticed below.
    limit = min(size, budget.left) + 1
    if chunk.compression == "":
        content = bytes(chunk.data)
    elif chunk.compression == "zstd":
        content = _read_zstd(chunk.data, limit)
    elif chunk.compression == "lz4":
        content = _read_lz4(chunk.data, limit)
    else:
        raise DamagedChunkError(f"The compression {ascii(chunk.compression)[:40]} is not known.")
    budget.take(len(content))
    if len(content) != size:
        raise DamagedChunkError("The chunk does not have the size in its head.")
    return content


def _read_zstd(data: bytes, limit: int) -> bytes:
    """Returns at most `limit` inflated bytes."""
    try:
        with zstandard.ZstdDecompressor().stream_reader(data) as stream:
            return stream.read(limit)
    except zstandard.ZstdError as error:
        raise DamagedChunkError(str(error)) from None


def _read_lz4(data: bytes, limit: int) -> bytes:
    """Returns at most `limit` inflated bytes."""
    try:
        return lz4.frame.LZ4FrameDecompressor().decompress(data, limit)
    except (RuntimeError, EOFError) as error:
        raise DamagedChunkError(str(error)) from None


def _frames(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Yields the opcode, start and end of each record.

    Raises:
      DamagedChunkError: a record reaches beyond the content.
    """
    position = 0
    while position < len(content):
        if position + FRAME.size > len(content):
            raise DamagedChunkError("A record is cut.")
        opcode, length = FRAME.unpack_from(content, position)
        if not opcode:
            raise DamagedChunkError("A record has no opcode.")
        start = position + FRAME.size
        position = start + length
        if position > len(content):
            raise DamagedChunkError("A record is cut.")
        yield opcode, start, position


def _parsed(opcode: int, record: bytes) -> McapRecord:
    """Returns the schema, channel or message of a record, which has no opcode and length."""
    stream = ReadDataStream(io.BytesIO(record))
    if opcode == Opcode.SCHEMA:
        return Schema.read(stream)
    if opcode == Opcode.CHANNEL:
        return Channel.read(stream)
    return McapMessage.read(stream, len(record))
