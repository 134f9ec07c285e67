"""Messages of an MCAP file, complete, cut off or damaged.

Damaged chunks are dropped and counted, later ones are read. The layout is that of
https://mcap.dev/spec: records of an opcode (1 byte), a length (8) and content. A chunk's content
has a CRC-32 of its uncompressed records. After an invalid record, reading resumes at the next
compressed chunk.
"""

import dataclasses
import io
import re
import struct
import zlib
from collections.abc import Collection, Iterable, Iterator
from typing import BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE, make_reader
from mcap.records import Channel, McapRecord, Schema
from mcap.records import Message as McapMessage
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from congrasp.services.record.chunks import (
    COMPRESSIONS,
    DAMAGE,
    FRAME,
    Budget,
    DamagedChunkError,
    content_of,
    records_of,
)
from congrasp.services.record.writer import FLUSH_SECONDS

_MARKS = tuple(len(name).to_bytes(4, "little") + name.encode() for name in COMPRESSIONS)
"""Length and name of each compression, as in a chunk's record."""
_MARK_PATTERN = re.compile(b"|".join(map(re.escape, _MARKS)))
_LONGEST_MARK = max(map(len, _MARKS))
_MARK_OFFSET = FRAME.size + 28
"""Bytes of a chunk's record before the mark: frame, times, size and CRC."""
_DATA_LENGTH_BYTES = 8  # after the mark
_CHUNK_HEAD_BYTES = _MARK_OFFSET + _LONGEST_MARK + _DATA_LENGTH_BYTES
_CHUNK_TIMES = struct.Struct("<QQ")
"""Times of a chunk's first and last message, after its frame."""
_INDEX_HEAD_BYTES = 6  # of a message index's record, after its frame: channel, size of the entries
_INDEX_ENTRY_BYTES = 16
_FOOTER = struct.Struct("<QQI")
"""Starts of the summary and of its offsets, and its CRC, after the footer's frame."""
_CRC = struct.Struct("<I")
_MAX_RECORD_BYTES = 512 << 20
_SEARCH_BYTES = 1 << 20  # read at a time in search of a chunk
_MAX_LOSS_S = 86400.0  # a chunk that ends more than a day after the message before it is damaged
_MAX_LISTED_PLACES = 5

FileMessage = tuple[Schema | None, Channel, McapMessage]
"""A message with its channel and the channel's schema."""


@dataclasses.dataclass
class Dropped:
    """Parts of a file that could not be read."""

    places: list[int] = dataclasses.field(default_factory=list)
    """Offsets at which damage begins."""
    messages: int = 0
    """Messages known to be lost, from chunks' indexes, or of an unknown channel."""
    cut: int = 0
    """Bytes of an incomplete record at the end: the writer was killed, or is still writing."""
    is_finished: bool = True
    """False if the file lacks its end."""
    last_time_ns: int = 0
    """Time of the latest message that was read; 0 if none was."""
    cut_until_ns: int = 0
    """Time of the last message in the incomplete chunk at the end; 0 if unknown."""

    @property
    def seconds(self) -> float:
        """Seconds that may be missing at the end: those of the incomplete chunk, but at least the
        time between two flushes.
        """
        lost = 0.0
        if self.last_time_ns:
            lost = (self.cut_until_ns - self.last_time_ns) / 1e9
        if lost > _MAX_LOSS_S:
            lost = 0.0
        return max(FLUSH_SECONDS, lost)

    def __str__(self) -> str:
        """Describes the losses in one line; empty if the file is complete."""
        losses = []
        if self.places or self.messages:
            losses.append(self._damage())
        if not self.is_finished:
            losses.append(f"not finished: {self.seconds:.1f} s or more may be missing at its end")
        return ", and ".join(losses)

    def _damage(self) -> str:
        """Describes the damaged places and the messages lost there."""
        offsets = [str(place) for place in self.places[:_MAX_LISTED_PLACES]]
        if len(self.places) > _MAX_LISTED_PLACES:
            offsets.append("…")
        where = ""
        if offsets:
            where = f", at byte {', '.join(offsets)}"
        return (
            f"damaged in {len(self.places)} place(s){where}; at least {self.messages} message(s) "
            f"were dropped"
        )


class _Intact(NamedTuple):
    """A record of the file that can be read."""

    opcode: int
    content: Iterable[McapRecord]
    """Schemas, channels and messages in the record."""
    end: int
    """Offset of the next record."""


class _Damaged(NamedTuple):
    """A record of the file that cannot be read."""

    opcode: int
    """The opcode that it appears to have."""
    end: int | None
    """Offset of the next record; None if unknown."""


class _Channels:
    """Channels and schemas read so far. The summary replaces those that were in damaged chunks."""

    def __init__(self, file: BinaryIO):
        self._file = file
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._is_summary_read = False

    def add_schema(self, schema: Schema) -> None:
        """Adds a schema, or replaces the one with its id."""
        self._schemas[schema.id] = schema

    def add_channel(self, channel: Channel) -> None:
        """Adds a channel, or replaces the one with its id."""
        self._channels[channel.id] = channel

    def with_channel(self, message: McapMessage) -> FileMessage | None:
        """Returns a message with its channel and schema; None if its channel is unknown."""
        if message.channel_id not in self._channels and not self._is_summary_read:
            self._add_summary()
        channel = self._channels.get(message.channel_id)
        if channel is None:
            return None
        return self._schemas.get(channel.schema_id), channel, message

    def _add_summary(self) -> None:
        """Adds the schemas and channels that only the summary has, if it is intact."""
        self._is_summary_read = True
        summary = intact_summary(self._file)
        if summary is not None:
            self._schemas = {**summary.schemas, **self._schemas}
            self._channels = {**summary.channels, **self._channels}


def read_messages(file: BinaryIO, dropped: Dropped) -> Iterator[FileMessage]:
    """Yields messages with their channels, in the order of writing.

    Args:
      file: a seekable MCAP file.
      dropped: receives the parts that could not be read; complete once the iterator is exhausted.

    Raises:
      CongraspError: the file inflates to much more than its size.
    """
    size = file.seek(0, io.SEEK_END)
    dropped.is_finished = _is_finished(file, size)
    budget = Budget.of(size)
    channels = _Channels(file)
    has_chunks = False
    follows_lost_chunk = False
    position = len(MCAP0_MAGIC)
    while position < size:
        record = _record_at(file, position, size, budget)
        has_chunks |= record.opcode == Opcode.CHUNK
        if has_chunks and record.opcode == Opcode.MESSAGE:
            # In a file with chunks, a message outside them, which no checksum covers, is taken for
            # another record with a damaged opcode.
            record = _Damaged(record.opcode, record.end)
        if isinstance(record, _Damaged):
            following = record.end
            if following is None:
                following = _next_chunk(file, position + 1, size)
            if following is None and _is_cut(file, position, size):
                dropped.cut = size - position
                dropped.cut_until_ns = _last_time_of_chunk_ns(file, position)
                return
            dropped.places.append(position)
            if following is None:
                return
            # Message indexes follow a chunk; after a search for the next chunk there are none.
            follows_lost_chunk = record.end is not None
            position = following
            continue
        # The message indexes after a lost chunk give the number of its messages.
        if record.opcode != Opcode.MESSAGE_INDEX:
            follows_lost_chunk = False
        elif follows_lost_chunk:
            entries_bytes = record.end - position - FRAME.size - _INDEX_HEAD_BYTES
            dropped.messages += entries_bytes // _INDEX_ENTRY_BYTES
        yield from _messages_of(record, channels, dropped)
        position = record.end


def _messages_of(record: _Intact, channels: _Channels, dropped: Dropped) -> Iterator[FileMessage]:
    """Yields the messages of a record and adds its schemas and channels to `channels`."""
    for item in record.content:
        if isinstance(item, Schema):
            channels.add_schema(item)
        elif isinstance(item, Channel):
            channels.add_channel(item)
        elif isinstance(item, McapMessage):
            dropped.last_time_ns = max(dropped.last_time_ns, item.log_time)
            message = channels.with_channel(item)
            if message is None:
                dropped.messages += 1
            else:
                yield message


def messages_between(
    file: BinaryIO, summary: Summary, topics: Collection[str], begin: int, end: int
) -> Iterator[FileMessage]:
    """Yields messages between two times by the index of a finished file.

    Args:
      file: the file.
      summary: its summary, with the index.
      topics: topics of the messages.
      begin: first time, ns.
      end: last time, ns, inclusive.

    Raises:
      DamagedChunkError: a chunk is damaged.
      CongraspError: the file inflates to much more than its size.
    """
    budget = Budget.of(file.seek(0, io.SEEK_END))
    channels = {}
    for channel_id, channel in summary.channels.items():
        if channel.topic in topics:
            channels[channel_id] = channel
    for index in summary.chunk_indexes:
        is_outside = index.message_start_time > end or index.message_end_time < begin
        if is_outside or index.chunk_length > _MAX_RECORD_BYTES:
            continue
        if channels.keys().isdisjoint(index.message_index_offsets):
            continue
        chunk = _read(file, index.chunk_start_offset, index.chunk_length)
        for record in records_of(content_of(chunk[FRAME.size :], budget)):
            if not isinstance(record, McapMessage) or not begin <= record.log_time <= end:
                continue
            if record.channel_id in channels:
                channel = channels[record.channel_id]
                yield summary.schemas.get(channel.schema_id), channel, record


def intact_summary(file: BinaryIO) -> Summary | None:
    """Returns the summary at the end of a finished file; None if it is missing or does not match
    its checksum.
    """
    footer_start = file.seek(0, io.SEEK_END) - FOOTER_SIZE - len(MCAP0_MAGIC)
    try:
        footer = _read(file, max(0, footer_start), FOOTER_SIZE)
        summary_start, _, crc = _FOOTER.unpack_from(footer, FRAME.size)
        if not 0 < summary_start < footer_start:
            return None
        # The checksum covers the summary and the footer up to the checksum itself.
        covered_end = footer_start + FOOTER_SIZE - _CRC.size
        covered = _read(file, summary_start, covered_end - summary_start)
        if zlib.crc32(covered) != crc:
            return None
        file.seek(0)
        return make_reader(file).get_summary()
    except DAMAGE:
        return None


def _is_finished(file: BinaryIO, size: int) -> bool:
    """True if the file ends with the magic bytes, and they are not those at its start."""
    magic_bytes = len(MCAP0_MAGIC)
    end = _read(file, max(0, size - magic_bytes), magic_bytes)
    return end == MCAP0_MAGIC and size > 2 * magic_bytes


def _record_at(file: BinaryIO, position: int, size: int, budget: Budget) -> _Intact | _Damaged:
    """Reads the record at an offset of a file of `size` bytes."""
    head = _read(file, position, _CHUNK_HEAD_BYTES)
    if head == MCAP0_MAGIC and position + len(head) == size:
        return _Intact(0, [], size)
    if len(head) < FRAME.size:
        return _Damaged(0, None)
    opcode, length = FRAME.unpack_from(head)
    if _mark_of(head):  # whatever the opcode is, which may be damaged
        return _compressed_chunk_at(file, position, size, budget)
    end = position + FRAME.size + length
    is_opcode = Opcode.HEADER <= opcode <= Opcode.DATA_END
    if not is_opcode or end > min(size, position + _MAX_RECORD_BYTES):
        return _Damaged(opcode, None)
    return _record_between(file, position, end, budget)


def _record_between(file: BinaryIO, position: int, end: int, budget: Budget) -> _Intact | _Damaged:
    """Reads the record between two offsets."""
    record = _read(file, position, end - position)
    opcode = record[0]
    if opcode == Opcode.CHUNK:
        content = _chunk_content(record, budget)
        if content is None:
            return _Damaged(opcode, end)
        return _Intact(opcode, records_of(content), end)
    if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
        parsed = _parse(opcode, record[FRAME.size :])
        if parsed is None:
            return _Damaged(opcode, end)
        return _Intact(opcode, [parsed], end)
    if opcode == Opcode.MESSAGE_INDEX and not _is_message_index(record):
        return _Damaged(opcode, None)
    enclosed_chunk = _next_chunk(file, position + 1, end)
    if enclosed_chunk is not None:  # the length in the record's frame is damaged
        end = enclosed_chunk
    return _Intact(opcode, [], end)


def _compressed_chunk_at(
    file: BinaryIO, position: int, size: int, budget: Budget
) -> _Intact | _Damaged:
    """Reads the compressed chunk at an offset.

    Opcode and length, which no checksum covers, are not needed if the rest is consistent: the
    length of the data gives the chunk's end, too.
    """
    head = _read(file, position, _CHUNK_HEAD_BYTES)
    mark = _mark_of(head)
    _, length = FRAME.unpack_from(head)
    end_by_length = position + FRAME.size + length
    end_by_data = position + _bytes_before_data(mark) + _data_length(head, mark)
    for end in (end_by_data, end_by_length):
        if end > min(size, position + _MAX_RECORD_BYTES):
            continue
        content = _chunk_content(_read(file, position, end - position), budget)
        if content:
            return _Intact(Opcode.CHUNK, records_of(content), end)
    if end_by_data == end_by_length <= size:
        return _Damaged(Opcode.CHUNK, end_by_length)
    return _Damaged(Opcode.CHUNK, None)


def _chunk_content(record: bytes, budget: Budget) -> bytes | None:
    """Returns the content of a chunk's record; None if it is damaged."""
    try:
        return content_of(record[FRAME.size :], budget)
    except DamagedChunkError:
        return None


def _is_message_index(record: bytes) -> bool:
    """True if the size of the entries, after the channel's number, matches the record's length."""
    entries_bytes = int.from_bytes(record[FRAME.size + 2 : FRAME.size + 6], "little")
    return entries_bytes == len(record) - FRAME.size - _INDEX_HEAD_BYTES


def _parse(opcode: int, content: bytes) -> McapRecord | None:
    """Returns a record outside any chunk; None if it is damaged."""
    stream = ReadDataStream(io.BytesIO(content))
    try:
        if opcode == Opcode.MESSAGE:
            return McapMessage.read(stream, len(content))
        if opcode == Opcode.SCHEMA:
            return Schema.read(stream)
        return Channel.read(stream)
    except DAMAGE:
        return None


def _mark_of(head: bytes) -> bytes:
    """Length and name of the compression in the head of a chunk; empty if it has none of
    `COMPRESSIONS`, or is not a chunk.
    """
    for mark in _MARKS:
        if head.startswith(mark, _MARK_OFFSET):
            return mark
    return b""


def _bytes_before_data(mark: bytes) -> int:
    """Bytes of a chunk's record before its data."""
    return _MARK_OFFSET + len(mark) + _DATA_LENGTH_BYTES


def _data_length(head: bytes, mark: bytes) -> int:
    """Bytes of a chunk's data, by the head of its record."""
    end = _bytes_before_data(mark)
    return int.from_bytes(head[end - _DATA_LENGTH_BYTES : end], "little")


def _last_time_of_chunk_ns(file: BinaryIO, position: int) -> int:
    """Time of the last message of a chunk, from its head; 0 for another record."""
    head = _read(file, position, FRAME.size + _CHUNK_TIMES.size)
    if len(head) < FRAME.size + _CHUNK_TIMES.size or head[0] != Opcode.CHUNK:
        return 0
    _, last = _CHUNK_TIMES.unpack_from(head, FRAME.size)
    return int(last)


def _next_chunk(file: BinaryIO, start: int, end: int) -> int | None:
    """Returns the start of the next compressed chunk with consistent lengths; None if there is none
    before `end`.
    """
    position = start
    while position < end:
        block = _read(file, position, min(_SEARCH_BYTES, end - position))
        for match in _MARK_PATTERN.finditer(block):
            chunk_start = position + match.start() - _MARK_OFFSET
            if chunk_start < start:
                continue
            if _is_chunk(_read(file, chunk_start, _CHUNK_HEAD_BYTES), match[0]):
                return chunk_start
        # The next block overlaps this one, so that a mark across their border is seen.
        position += max(1, len(block) - _LONGEST_MARK + 1)
    return None


def _is_chunk(head: bytes, mark: bytes) -> bool:
    """True if the head of a record is that of a chunk with this compression."""
    before_data = _bytes_before_data(mark)
    if len(head) < before_data:
        return False
    _, length = FRAME.unpack_from(head)
    return bool(length == before_data - FRAME.size + _data_length(head, mark))


def _is_cut(file: BinaryIO, position: int, size: int) -> bool:
    """True if a record begins here that would end beyond the file's end."""
    head = _read(file, position, FRAME.size)
    if len(head) < FRAME.size:
        return True
    opcode, length = FRAME.unpack(head)
    is_record = Opcode.HEADER <= opcode <= Opcode.DATA_END
    return bool(is_record and position + FRAME.size + length > size)


def _read(file: BinaryIO, position: int, count: int) -> bytes:
    """Reads up to `count` bytes at an offset."""
    file.seek(position)
    return file.read(count)
