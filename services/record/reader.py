"""Reads recordings, complete, cut off or damaged: a killed writer's file is readable up to its last
flush.

Damaged chunks of an MCAP file are dropped and counted, later ones are read. The layout is that of
https://mcap.dev/spec: records of an opcode (1 byte), a length (8) and content. A chunk's content
has a CRC-32 of its uncompressed records. After an invalid record, reading resumes at the next
compressed chunk.
"""

import collections
import dataclasses
import io
import logging
import pathlib
import re
import struct
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import Any, BinaryIO, NamedTuple, TypeVar

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE, make_reader
from mcap.records import Channel, McapRecord, Schema
from mcap.records import Message as McapMessage
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from congrasp.common.errors import CongraspError, os_errors_as
from congrasp.common.io.inputs import open_file, parse_json
from congrasp.common.wire.codec import Message, decode
from congrasp.services.record.chunks import (
    COMPRESSIONS,
    DAMAGE,
    FRAME,
    Budget,
    DamagedChunkError,
    content_of,
    records_of,
)
from congrasp.services.record.scene import EPISODE_SCHEMA, check_episode
from congrasp.services.record.writer import FLUSH_SECONDS, PART, ROLLOUT_SCHEMA, flatten

_MARKS = tuple(len(name).to_bytes(4, "little") + name.encode() for name in COMPRESSIONS)
# Of a compression's name in a chunk's record; times, size and CRC precede it, the data's length
# follows
_MARK_AT = FRAME.size + 28
_MARK = re.compile(b"|".join(map(re.escape, _MARKS)))
_HEAD = _MARK_AT + max(map(len, _MARKS)) + 8
_TIMES = struct.Struct("<QQ")  # of a chunk's first and last message, after its frame
_FOOTER, _CRC = struct.Struct("<QQI"), struct.Struct("<I")
_LIMIT = 512 << 20  # limit of a record, bytes
_LONGEST_LOSS = 86400.0  # seconds; a chunk with a later end is damaged
_BLOCK = 1 << 20
_PLACES = 5
_log = logging.getLogger(__name__)
_T = TypeVar("_T")


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
    last: int = 0
    """Time of the last message, ns."""
    cut_until: int = 0
    """Time until which the incomplete chunk at the end has messages, ns; 0 if unknown."""

    @property
    def seconds(self) -> float:
        """Seconds that are missing at the end at least, or may be."""
        lost = 0.0
        if self.last:
            lost = (self.cut_until - self.last) / 1e9
        if lost > _LONGEST_LOSS:
            lost = 0.0
        return max(FLUSH_SECONDS, lost)

    def __str__(self) -> str:
        """One line; empty if the file is complete."""
        parts = []
        if self.places or self.messages:
            parts.append(self._damage())
        if not self.is_finished:
            parts.append(f"not finished: {self.seconds:.1f} s or more may be missing at its end")
        return ", and ".join(parts)

    def _damage(self) -> str:
        """Places and messages that were lost by damage."""
        more = ", …" if len(self.places) > _PLACES else ""
        where = ", ".join(map(str, self.places[:_PLACES])) + more
        at = f", at byte {where}" if where else ""
        return (
            f"damaged in {len(self.places)} place(s){at}; at least {self.messages} message(s) were "
            f"dropped"
        )


def read_messages(  # noqa: C901
    file: BinaryIO, dropped: Dropped
) -> Iterator[tuple[Schema | None, Channel, McapMessage]]:
    """Yields messages with their channels, in the order of writing.

    Args:
      file: a seekable MCAP file.
      dropped: receives the parts that could not be read; complete once the iterator is exhausted.
    """
    size, position = file.seek(0, io.SEEK_END), len(MCAP0_MAGIC)
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    asked, lost_chunk, chunked = False, False, False
    budget = Budget.of(size)
    dropped.is_finished = _read(file, max(0, size - len(MCAP0_MAGIC)), size) == MCAP0_MAGIC
    dropped.is_finished &= size > 2 * len(MCAP0_MAGIC)
    while position < size:
        opcode, records, end = _record_at(file, position, size, budget)
        chunked |= opcode == Opcode.CHUNK
        if (
            opcode == Opcode.MESSAGE and chunked
        ):  # not covered by a checksum: another record with a damaged opcode
            records = None
        if records is None:
            found = end if end is not None else _next_chunk(file, position + 1, size)
            if found is None and _is_cut(file, position, size):
                dropped.cut = size - position
                dropped.cut_until = _end_of_chunk(file, position)
                return
            dropped.places.append(position)
            position, lost_chunk = size if found is None else found, end is not None
            continue
        if opcode == Opcode.MESSAGE_INDEX:
            assert end is not None
            dropped.messages += lost_chunk * ((end - position - FRAME.size - 6) // 16)
        else:
            lost_chunk = False
        for record in records:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, McapMessage):
                dropped.last = max(dropped.last, record.log_time)
                if record.channel_id not in channels and not asked:  # it was in a damaged chunk
                    asked = True
                    if summary := intact_summary(file):
                        schemas.update({**summary.schemas, **schemas})
                        channels.update({**summary.channels, **channels})
                if record.channel_id not in channels:
                    dropped.messages += 1
                    continue
                channel = channels[record.channel_id]
                yield schemas.get(channel.schema_id), channel, record
        assert end is not None
        position = end


def _record_at(
    file: BinaryIO, position: int, size: int, budget: Budget
) -> tuple[int, Iterable[McapRecord] | None, int | None]:
    """Returns a record's opcode, its records (None if damaged), and its end (None if unknown)."""
    head = _read(file, position, _HEAD)
    if head == MCAP0_MAGIC and position + len(head) == size:
        return 0, [], size
    if len(head) < FRAME.size:
        return 0, None, None
    opcode, length = FRAME.unpack_from(head)
    end = position + FRAME.size + length
    mark = _mark_of(head)
    if mark and opcode != Opcode.CHUNK_INDEX:
        # Opcode and length, which no checksum covers, are not needed if the rest is consistent.
        inner = position + _after_mark(mark) + _data_length(head, mark)
        for each in (inner, end):
            if each <= min(size, position + _LIMIT) and (
                content := _chunk(_read(file, position, each - position), budget)
            ):
                return Opcode.CHUNK, records_of(content), each
        return Opcode.CHUNK, None, end if inner == end <= size else None
    if not Opcode.HEADER <= opcode <= Opcode.DATA_END or end > min(size, position + _LIMIT):
        return opcode, None, None
    whole = _read(file, position, end - position)
    if opcode == Opcode.CHUNK:
        content = _chunk(whole, budget)
        if content is None:
            return opcode, None, end
        return opcode, records_of(content), end
    if opcode == Opcode.MESSAGE_INDEX and int.from_bytes(whole[11:15], "little") != length - 6:
        return opcode, None, None
    if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
        hidden = _next_chunk(file, position + 1, end)  # the length is too large
        return opcode, [], end if hidden is None else hidden
    return opcode, _parse(opcode, whole[FRAME.size :]), end


def _mark_of(head: bytes) -> bytes:
    """Length and name of the compression in the head of a chunk; empty if there is none."""
    return next((mark for mark in _MARKS if head.startswith(mark, _MARK_AT)), b"")


def _after_mark(mark: bytes) -> int:
    """Bytes of a chunk's record before its data."""
    return _MARK_AT + len(mark) + 8


def _data_length(head: bytes, mark: bytes) -> int:
    """Bytes of a chunk's data, by the head of its record."""
    after = _after_mark(mark)
    return int.from_bytes(head[after - 8 : after], "little")


def _end_of_chunk(file: BinaryIO, position: int) -> int:
    """Time of the last message of a chunk, whose head suffices, ns; 0 for another record."""
    head = _read(file, position, FRAME.size + _TIMES.size)
    if len(head) < FRAME.size + _TIMES.size or head[0] != Opcode.CHUNK:
        return 0
    _, end = _TIMES.unpack_from(head, FRAME.size)
    return int(end)


def _chunk(whole: bytes, budget: Budget) -> bytes | None:
    """Returns the content of a chunk's record; None if it is damaged."""
    try:
        return content_of(whole[FRAME.size :], budget)
    except DamagedChunkError:
        return None


def messages_between(
    file: BinaryIO, summary: Summary, topics: Collection[str], begin: int, end: int
) -> Iterator[tuple[Schema | None, Channel, McapMessage]]:
    """Yields messages between two times (ns, inclusive) by the index of a finished file.

    Raises:
      DamagedChunkError: a chunk is damaged.
      CongraspError: the file inflates to much more than its size.
    """
    budget = Budget.of(file.seek(0, io.SEEK_END))
    channels = {key: one for key, one in summary.channels.items() if one.topic in topics}
    for index in summary.chunk_indexes:
        is_outside = index.message_start_time > end or index.message_end_time < begin
        if is_outside or index.chunk_length > _LIMIT:
            continue
        if channels.keys().isdisjoint(index.message_index_offsets):
            continue
        whole = _read(file, index.chunk_start_offset, index.chunk_length)
        for record in records_of(content_of(whole[FRAME.size :], budget)):
            if not isinstance(record, McapMessage) or not begin <= record.log_time <= end:
                continue
            channel = channels.get(record.channel_id)
            if channel is not None:
                yield summary.schemas.get(channel.schema_id), channel, record


def _parse(opcode: int, content: bytes) -> list[McapRecord] | None:
    """Returns a record outside any chunk; None if it is damaged."""
    stream = ReadDataStream(io.BytesIO(content))
    try:
        if opcode == Opcode.MESSAGE:
            return [McapMessage.read(stream, len(content))]
        return [Schema.read(stream) if opcode == Opcode.SCHEMA else Channel.read(stream)]
    except DAMAGE:
        return None


def _next_chunk(file: BinaryIO, start: int, end: int) -> int | None:
    """Returns the start of the next compressed chunk with consistent lengths; None if there is none
    before `end`.
    """
    first = start
    while start < end:
        block = _read(file, start, min(_BLOCK, end - start))
        for found in _MARK.finditer(block):
            begin = start + found.start() - _MARK_AT
            if begin >= first and _is_chunk(_read(file, begin, _HEAD), found[0]):
                return begin
        start += max(1, len(block) - max(map(len, _MARKS)) + 1)
    return None


def _is_chunk(head: bytes, mark: bytes) -> bool:
    """True if the head of a record is that of a chunk with this compression."""
    if len(head) < _after_mark(mark):
        return False
    length = FRAME.unpack_from(head)[1]
    return bool(length == _after_mark(mark) - FRAME.size + _data_length(head, mark))


def _is_cut(file: BinaryIO, position: int, size: int) -> bool:
    """True if a record begins here that would end beyond the file's end."""
    head = _read(file, position, FRAME.size)
    if len(head) < FRAME.size:
        return True
    opcode, length = FRAME.unpack(head)
    return (
        bool(Opcode.HEADER <= opcode <= Opcode.DATA_END) and position + FRAME.size + length > size
    )


def intact_summary(file: BinaryIO) -> Summary | None:
    """Returns the summary at the end of a finished file; None if it is missing or does not match
    its checksum.
    """
    end = file.seek(0, io.SEEK_END) - FOOTER_SIZE - len(MCAP0_MAGIC)
    try:
        start, _, crc = _FOOTER.unpack_from(_read(file, max(0, end), FOOTER_SIZE), FRAME.size)
        # The checksum covers the summary and the footer up to the checksum itself.
        covered = (
            _read(file, start, end + FOOTER_SIZE - _CRC.size - start) if 0 < start < end else b""
        )
        file.seek(0)
        return make_reader(file).get_summary() if covered and zlib.crc32(covered) == crc else None
    except DAMAGE:
        return None


def _read(file: BinaryIO, position: int, count: int) -> bytes:
    file.seek(position)
    return file.read(count)


class Record(NamedTuple):
    """One message of a file."""

    topic: str
    schema: str
    """Name of its schema."""
    encoding: str
    time: int
    """Nanoseconds since 1970."""
    data: bytes


def log_files(path: pathlib.Path) -> list[pathlib.Path]:
    """The recordings at `path`, a file or a folder (with those below it), in the order of their
    names.

    Raises:
      CongraspError: there are no recordings.
    """
    if not path.exists():
        raise CongraspError(
            f"There is no file or folder {path}.", "Pass a run's folder or an MCAP file."
        )
    if path.is_file():
        return [path]
    found = sorted(
        [*path.rglob("*.mcap"), *path.rglob(f"*.mcap{PART}")], key=lambda file: (file.name, file)
    )
    if not found:
        raise CongraspError(
            f"There is no recording (*.mcap) in {path}.", "Pass a run's folder or an MCAP file."
        )
    return found


def read_records(
    path: pathlib.Path,
    wanted: Callable[[str], bool] = lambda topic: True,
    warn: Callable[[str], None] = _log.warning,
) -> Iterator[Record]:
    """Yields the messages of one file in the order of writing, as far as the file is intact.

    Args:
      path: the file.
      wanted: predicate of the topics to read.
      warn: called at the end with the number and places of messages lost by damage, and for a file
        that lacks its end with the seconds that may be missing.

    Raises:
      CongraspError: the file cannot be opened, or is not an MCAP file.
    """
    dropped = Dropped()
    with os_errors_as(f"{path} cannot be read"), open_file(path) as file:
        start = file.read(len(MCAP0_MAGIC))
        if not MCAP0_MAGIC.startswith(start):
            raise CongraspError(
                f"{path} is not an MCAP file.", "Pass a file written by 'congrasp record'."
            )
        for schema, channel, message in _named(path, read_messages(file, dropped)):
            if wanted(channel.topic):
                name = schema.name if schema else ""
                yield Record(
                    channel.topic, name, channel.message_encoding, message.log_time, message.data
                )
    if text := str(dropped):
        warn(f"{path} is {text}.")


def _named(path: pathlib.Path, messages: Iterator[_T]) -> Iterator[_T]:
    """Yields the messages; errors name the file."""
    try:
        yield from messages
    except CongraspError as error:
        raise CongraspError(f"{path} cannot be read: {error}") from None


def is_episode(topic: str) -> bool:
    """True if a topic is that of an actor's whole episodes."""
    return topic.startswith("/episode/") and topic.endswith("/raw")


def read_metrics(path: pathlib.Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Reads every metric of a run's recordings, by `<role>/<name>/<metric>`.

    Returns:
      For each metric its steps (n,), rising (updates, else versions, else seconds since the first
      message), and values (n,). If a run was resumed from a checkpoint, the later value of a step
      is used.
    """
    series: dict[str, dict[float, float]] = collections.defaultdict(dict)
    first: int | None = None
    for file in log_files(path):
        for record in read_records(file, lambda topic: topic.startswith("/metrics/")):
            first = record.time if first is None else first
            message = metrics_of(record)
            step = message.get("update", message.get("version", (record.time - first) / 1e9))
            for name, value in flatten(message["values"]).items():
                series[f"{record.topic.removeprefix('/metrics/')}/{name}"][step] = value
    return {
        name: (np.array(sorted(points)), np.array([points[step] for step in sorted(points)]))
        for name, points in sorted(series.items())
    }


def metrics_of(record: Record) -> dict[str, Any]:
    """Returns the object of a record of metrics: `values` {name: number, or a group}, and further
    numbers.

    Raises:
      CongraspError: the record is not valid.
    """
    found = parse_json(record.data, f"A record of {ascii(record.topic)[:100]}")
    values = found.get("values") if isinstance(found, dict) else None
    steps = (
        [found.get(name, 0) for name in ("update", "version")] if isinstance(found, dict) else []
    )
    if not isinstance(values, dict) or not all(
        isinstance(n, int | float) for n in [*flatten(values).values(), *steps]
    ):
        raise CongraspError(f"A record of {ascii(record.topic)[:100]} has no metrics.")
    return found


def read_episodes(path: pathlib.Path) -> Iterator[Message]:
    """Yields the recorded episodes at `path`, a file or a folder, as sent by the actors, in the
    order of recording.

    Raises:
      CongraspError: an episode is not valid.
    """
    for episode in _messages(path, EPISODE_SCHEMA, is_episode):
        check_episode(episode)
        yield episode


def pick_episode(path: pathlib.Path, index: int, *, success: bool = False) -> Message:
    """Returns one of the recorded episodes at `path`.

    Args:
      path: a file or a folder.
      index: index from 0; -1 is the last.
      success: counts only successful episodes.

    Raises:
      CongraspError: there is no such index; the message gives their number.
    """
    last: collections.deque[Message] = collections.deque(maxlen=max(1, -index))
    count = 0
    for episode in read_episodes(path):
        if episode.meta["success"] or not success:
            last.append(episode)
            count += 1
            if count == index + 1:
                break
    if not -count <= index < count:
        kind = "successful episodes" if success else "episodes"
        empty = "Leave out success=True." if success else "Pass one of 'congrasp record'."
        remedy = f"Choose from {-count} to {count - 1}." if count else empty
        raise CongraspError(f"{path} holds {count} {kind}, none with index {index}.", remedy)
    return last[0 if index < 0 else -1]


def read_rollouts(path: pathlib.Path) -> Iterator[Message]:
    """Yields the recorded rollouts at `path`, a file or a folder, as sent by the actors, in the
    order of recording.

    Axes are (T, B, ...); `meta["layout"]` lists the blocks of an observation with their sizes.
    """
    return _messages(path, ROLLOUT_SCHEMA, lambda topic: topic.startswith("/rollout/"))


def _messages(path: pathlib.Path, schema: str, wanted: Callable[[str], bool]) -> Iterator[Message]:
    """Yields decoded messages of one schema on the wanted topics."""
    for file in log_files(path):
        for record in read_records(file, wanted):
            if record.schema == schema:
                yield decode(record.data)
