"""Reads recordings, complete, cut off or damaged: a killed writer's file is readable up to its last
flush.

Damaged chunks of an MCAP file are dropped and counted, later ones are read. The layout is that of
https://mcap.dev/spec: records of an opcode (1 byte), a length (8) and content. A chunk's content
has a CRC-32 of its uncompressed records. After an invalid record, reading resumes at the next
Zstandard chunk.
"""

import collections
import dataclasses
import io
import logging
import pathlib
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE, make_reader
from mcap.records import Channel, Chunk, McapRecord, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import breakup_chunk
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from congrasp.common.errors import CongraspError, os_errors_as
from congrasp.common.io.inputs import open_file, parse_json
from congrasp.common.wire.codec import Message, decode
from congrasp.services.record.scene import EPISODE_SCHEMA, check_episode
from congrasp.services.record.writer import PART, ROLLOUT_SCHEMA, flatten

DAMAGE = (McapError, struct.error, zstandard.ZstdError, ValueError, MemoryError, OverflowError)
"""Exceptions of the `mcap` package on damaged files."""
_FRAME = struct.Struct("<BQ")
_ZSTD = b"\x04\x00\x00\x00zstd"
# In a chunk's record; times, size and CRC precede it, the data's length follows
_ZSTD_AT = _FRAME.size + 28
_HEAD = _ZSTD_AT + len(_ZSTD) + 8
_FOOTER, _CRC = struct.Struct("<QQI"), struct.Struct("<I")
_LIMIT = 512 << 20  # limit of a record, and of an inflated chunk, bytes
_BLOCK = 1 << 20
_PLACES = 5
_log = logging.getLogger(__name__)


@dataclasses.dataclass
class Dropped:
    """Parts of a file that could not be read."""

    places: list[int] = dataclasses.field(default_factory=list)
    """Offsets at which damage begins."""
    messages: int = 0
    """Messages known to be lost, from chunks' indexes, or of an unknown channel."""
    cut: int = 0
    """Bytes of an incomplete record at the end: the writer was killed, or is still writing."""

    def __str__(self) -> str:
        """One line; empty if at most the end of the file is cut."""
        if not self.places and not self.messages:
            return ""
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
    while position < size:
        opcode, records, end = _record_at(file, position, size)
        chunked |= opcode == Opcode.CHUNK
        if (
            opcode == Opcode.MESSAGE and chunked
        ):  # not covered by a checksum: another record with a damaged opcode
            records = None
        if records is None:
            found = end if end is not None else _next_chunk(file, position + 1, size)
            if found is None and _is_cut(file, position, size):
                dropped.cut = size - position
                return
            dropped.places.append(position)
            position, lost_chunk = size if found is None else found, end is not None
            continue
        if opcode == Opcode.MESSAGE_INDEX:
            assert end is not None
            dropped.messages += lost_chunk * ((end - position - _FRAME.size - 6) // 16)
        else:
            lost_chunk = False
        for record in records:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, McapMessage):
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
    file: BinaryIO, position: int, size: int
) -> tuple[int, list[McapRecord] | None, int | None]:
    """Returns a record's opcode, its records (None if damaged), and its end (None if unknown)."""
    head = _read(file, position, _HEAD)
    if head == MCAP0_MAGIC and position + len(head) == size:
        return 0, [], size
    if len(head) < _FRAME.size:
        return 0, None, None
    opcode, length = _FRAME.unpack_from(head)
    end = position + _FRAME.size + length
    if head[_ZSTD_AT : _ZSTD_AT + len(_ZSTD)] == _ZSTD and opcode != Opcode.CHUNK_INDEX:
        # Opcode and length, which no checksum covers, are not needed if the rest is consistent.
        inner = position + _HEAD + int.from_bytes(head[-8:], "little")
        for each in (inner, end):
            if each <= min(size, position + _LIMIT) and (
                records := _chunk(_read(file, position, each - position))
            ):
                return Opcode.CHUNK, records, each
        return Opcode.CHUNK, None, end if inner == end <= size else None
    if not Opcode.HEADER <= opcode <= Opcode.DATA_END or end > min(size, position + _LIMIT):
        return opcode, None, None
    whole = _read(file, position, end - position)
    if opcode == Opcode.CHUNK:
        return opcode, _chunk(whole), end
    if opcode == Opcode.MESSAGE_INDEX and int.from_bytes(whole[11:15], "little") != length - 6:
        return opcode, None, None
    if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
        hidden = _next_chunk(file, position + 1, end)  # the length is too large
        return opcode, [], end if hidden is None else hidden
    return opcode, _parse(opcode, whole[_FRAME.size :]), end


def _chunk(whole: bytes) -> list[McapRecord] | None:
    """Returns the records of a chunk's record; None if it is damaged."""
    try:
        chunk = Chunk.read(ReadDataStream(io.BytesIO(whole[_FRAME.size :])))
        compressed = chunk.compression == "zstd"
        if (
            compressed
            and max(chunk.uncompressed_size, zstandard.frame_content_size(chunk.data)) > _LIMIT
        ):
            return None
        return breakup_chunk(chunk, validate_crc=True)
    except DAMAGE:
        return None


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
    """Returns the start of the next Zstandard chunk with consistent lengths; None if there is none
    before `end`.
    """
    first = start
    while start < end:
        block = _read(file, start, min(_BLOCK, end - start))
        at = block.find(_ZSTD)
        while at >= 0:
            begin = start + at - _ZSTD_AT
            if begin >= first and len(head := _read(file, begin, _HEAD)) == _HEAD:
                length = _FRAME.unpack_from(head)[1]
                if length == _HEAD - _FRAME.size + int.from_bytes(head[-8:], "little"):
                    return begin
            at = block.find(_ZSTD, at + 1)
        start += max(1, len(block) - len(_ZSTD) + 1)
    return None


def _is_cut(file: BinaryIO, position: int, size: int) -> bool:
    """True if a record begins here that would end beyond the file's end."""
    head = _read(file, position, _FRAME.size)
    if len(head) < _FRAME.size:
        return True
    opcode, length = _FRAME.unpack(head)
    return (
        bool(Opcode.HEADER <= opcode <= Opcode.DATA_END) and position + _FRAME.size + length > size
    )


def intact_summary(file: BinaryIO) -> Summary | None:
    """Returns the summary at the end of a finished file; None if it is missing or does not match
    its checksum.
    """
    end = file.seek(0, io.SEEK_END) - FOOTER_SIZE - len(MCAP0_MAGIC)
    try:
        start, _, crc = _FOOTER.unpack_from(_read(file, max(0, end), FOOTER_SIZE), _FRAME.size)
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
      warn: called at the end with the number and places of messages lost by damage, if any.

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
        for schema, channel, message in read_messages(file, dropped):
            if wanted(channel.topic):
                name = schema.name if schema else ""
                yield Record(
                    channel.topic, name, channel.message_encoding, message.log_time, message.data
                )
    if text := str(dropped):
        warn(f"{path} is {text}.")


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
