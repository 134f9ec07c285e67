"""Output of a recorder: entries on channels, for a live viewer or an MCAP file.

Metrics and signals are JSON with a JSON schema, so that viewers can plot them; events and scenes
are Foxglove's Protobuf messages, which Rerun also reads; rollouts and raw episodes are the bytes of
`common.wire.codec`. MCAP files survive a kill: they are flushed often, rotated, and renamed to
`*.mcap` only when finished.
"""

import collections
import contextlib
import dataclasses
import datetime
import functools
import json
import pathlib
from collections.abc import Callable, Mapping
from typing import IO, Any, NamedTuple

from google.protobuf.message import Message as Protobuf
from mcap.writer import CompressionType, IndexType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from congrasp.common.errors import CongraspError, os_errors_as
from congrasp.common.io.opening import create_new
from congrasp.common.runtime import platforms
from congrasp.common.wire.codec import finite

OPAQUE = "x-safetensors"
"""Encoding of messages in the format of `common.wire.codec`."""
ROLLOUT_SCHEMA = "congrasp.Rollout"
"""Name of the schema of rollouts."""
EPISODE_SCHEMA = "congrasp.Episode"
"""Name of the schema of episodes."""

_MAX_FIELDS = 512
"""Limit of a topic's fields."""
_MAX_SCHEMA_CHANGES = 32
"""Limit of the changes of a topic's schema, which is written in full each time."""
_MAX_NAME_CHARACTERS = 128
_MAX_NAME_LEVELS = 8

CONVENTIONS = {
    "units": "metres, radians, seconds, newtons, kilograms",
    "quaternions": "(w, x, y, z) in JSON and x-safetensors; by field name in Foxglove's messages",
    "frames": (
        "world: z up, table's top at z = 0; <actor>/<link> and <actor>/object as in the simulation"
    ),
    "joints": (
        "finger joints by name, in the order of the hand's 'q'; wrist x, y, z, then intrinsic "
        "x-y-z angles"
    ),
}
"""Metadata of every file: meaning of the numbers."""
PART = ".part"
"""Suffix of a file that is being written, or whose writer was killed."""
FLUSH_SECONDS = 0.5
"""Seconds between two flushes; a killed recorder loses no more than these."""
CHUNK = 1 << 20
"""Bytes of a chunk before compression."""
_INDEXES = IndexType.CHUNK | IndexType.MESSAGE | IndexType.METADATA


@dataclasses.dataclass(frozen=True)
class Channel:
    """A stream of messages of one schema."""

    topic: str
    encoding: str
    """Encoding of the messages: json, protobuf or x-safetensors."""
    schema_name: str
    schema_encoding: str
    schema: bytes
    latched: bool = False
    """Sent rarely and needed by late subscribers: a live viewer that subscribes receives the last
    message.
    """


class Entry(NamedTuple):
    """One message on a channel."""

    channel: Channel
    time: int
    """Nanoseconds since 1970 of the event, by the recorder's clock."""
    data: bytes


@functools.lru_cache(maxsize=4096)
def protobuf_channel(topic: str, kind: type[Protobuf], *, latched: bool = False) -> Channel:
    """Returns a channel of one of Foxglove's messages, with the descriptors that readers need."""
    hashable: Any = kind  # its type does not declare it
    return Channel(
        topic=topic,
        encoding="protobuf",
        schema_name=kind.DESCRIPTOR.full_name,
        schema_encoding="protobuf",
        schema=_descriptors(hashable),
        latched=latched,
    )


@functools.cache
def _descriptors(kind: Any) -> bytes:
    """Schema of one of Foxglove's messages, shared by all channels."""
    return build_file_descriptor_set(kind).SerializeToString()


@functools.lru_cache(maxsize=4096)
def opaque_channel(topic: str, name: str) -> Channel:
    """Returns a channel of encoded `common.wire.codec.Message`s of the kind `name`."""
    return Channel(topic, OPAQUE, schema_name=name, schema_encoding="", schema=b"")


class JsonChannels:
    """Channels of JSON objects whose schemas grow with new fields, since a field must be in the
    schema to be plotted.

    The numbers of fields and of changes are limited; further fields are dropped.
    """

    def __init__(self) -> None:
        """Starts without topics."""
        self._fields: dict[str, dict[str, Any]] = {}
        self._channels: dict[str, Channel] = {}
        self._schema_changes: collections.Counter[str] = collections.Counter()

    def entry(self, topic: str, time: int, value: Mapping[str, Any]) -> Entry:
        """Returns the object as an entry, without fields that are NaN or infinite, which JSON
        cannot represent.
        """
        finite_values = finite(value)
        fields = self._fields.setdefault(topic, {})
        content = self._within_limits(topic, finite_values)
        is_changed = _merge(fields, content)
        if is_changed or topic not in self._channels:
            self._schema_changes[topic] += 1
            self._channels[topic] = Channel(
                topic=topic,
                encoding="json",
                # Schemas are identified by name, so every topic has a separate one.
                schema_name=f"congrasp{topic.replace('/', '.')}",
                schema_encoding="jsonschema",
                schema=json.dumps(_schema(fields)).encode(),
            )
        data = json.dumps(content, separators=(",", ":")).encode()
        return Entry(self._channels[topic], time, data)

    def _within_limits(self, topic: str, content: dict[str, Any]) -> dict[str, Any]:
        """Returns an object, without its new fields if the topic would exceed one of its limits."""
        fields = self._fields[topic]
        old_content = _in_fields(fields, content)
        if self._schema_changes[topic] >= _MAX_SCHEMA_CHANGES:
            return old_content
        new_fields = _count(content) - _count(old_content)
        if _count(fields) + new_fields > _MAX_FIELDS:
            return old_content
        return content

    def forget(self, topic: str) -> None:
        """Forgets a topic that is no longer published."""
        self._fields.pop(topic, None)
        self._channels.pop(topic, None)
        self._schema_changes.pop(topic, None)


def check_field(name: str) -> str:
    """Returns a field's name; raises a CongraspError if it is too long, or nested too deep."""
    if len(name) > _MAX_NAME_CHARACTERS or name.count("/") > _MAX_NAME_LEVELS:
        raise CongraspError(
            f"{ascii(name)[:60]} is too long or nested too deep for the name of a metric."
        )
    return name


def nest(values: Mapping[str, float]) -> dict[str, Any]:
    """Converts `{"term/contact": 1}` to `{"term": {"contact": 1}}`; the inverse of `flatten`.

    A name that is also a prefix of another (`loss` and `loss/policy`) becomes that group's empty
    name.
    """
    groups = set()
    for name in values:
        levels = name.split("/")
        for count in range(1, len(levels)):
            groups.add("/".join(levels[:-count]))
    tree: dict[str, Any] = {}
    for name, value in values.items():
        *path, leaf = name.split("/")
        if name in groups:
            path = name.split("/")
            leaf = ""
        node = tree
        for part in path:
            node = node.setdefault(part, {})
        node[leaf] = value
    return tree


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Converts `{"term": {"contact": 1}}` to `{"term/contact": 1}`."""
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        path = f"{prefix}/{name}".strip("/")
        if isinstance(value, Mapping):
            flat |= flatten(value, path)
        else:
            flat[path] = value
    return flat


def _merge(fields: dict[str, Any], value: Mapping[str, Any]) -> bool:
    """Adds the fields of an object; returns True if any is new.

    A field has a JSON type, or the fields of a group.
    """
    is_changed = False
    for name, item in value.items():
        if isinstance(item, Mapping):
            group = fields.setdefault(name, {})
            if isinstance(group, dict):
                is_changed |= _merge(group, item)
        elif name not in fields:
            fields[name] = _json_type(item)
            is_changed = True
    return is_changed


def _json_type(value: Any) -> str:
    """Name of a scalar's type in a JSON schema."""
    if isinstance(value, bool):
        return "boolean"
    if isinstance(value, int | float):
        return "number"
    return "string"


def _in_fields(fields: Mapping[str, Any], value: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the part of an object whose fields are listed."""
    content: dict[str, Any] = {}
    for name, item in value.items():
        if name not in fields:
            continue
        if isinstance(item, Mapping) and isinstance(fields[name], dict):
            item = _in_fields(fields[name], item)
        content[name] = item
    return content


def _count(fields: Mapping[str, Any]) -> int:
    """Number of fields at any depth; groups themselves are not counted."""
    count = 0
    for item in fields.values():
        count += _count(item) if isinstance(item, Mapping) else 1
    return count


def _schema(fields: Mapping[str, Any]) -> dict[str, Any]:
    """JSON schema of an object with these fields, each a JSON type or the fields of a group."""
    properties = {}
    for name, field in fields.items():
        properties[name] = _schema(field) if isinstance(field, dict) else {"type": field}
    return {"type": "object", "properties": properties}


class LogWriter:
    """Writes entries to `<directory>/<name>-<UTC time>-<number>.mcap`, one file after another.

    Every file holds all channels and schemas it needs. Not thread-safe.
    """

    def __init__(
        self,
        directory: pathlib.Path,
        name: str,
        *,
        run: str = "",
        max_bytes: int = 256 << 20,
        max_seconds: float = 600.0,
        open_file: Callable[[pathlib.Path], IO[bytes]] = create_new,
    ):
        """Creates the directory; the first entry opens the first file.

        Args:
          directory: folder for the files.
          name: prefix of their names.
          run: name of the run, stored in every file.
          max_bytes: size at which a file is finished and the next begins.
          max_seconds: age of a file's first entry at which the next file begins.
          open_file: opens a new file for writing.

        Raises:
          CongraspError: the directory cannot be created.
        """
        with os_errors_as(f"The folder {directory} cannot be created"):
            directory.mkdir(parents=True, exist_ok=True)
        self._directory = directory
        self._name = name
        self._run = run
        self._max_bytes = max_bytes
        self._max_age_ns = round(1e9 * max_seconds)
        self._open_file = open_file
        self._file_number = 0
        self._file: IO[bytes] | None = None
        self._path = directory
        self.files: list[pathlib.Path] = []
        """Files so far, the current one last."""

    def write(self, *entries: Entry) -> None:
        """Writes entries that belong together to one file.

        Raises:
          OSError: the disk is full or broken; flushed entries stay readable.
        """
        if not entries:
            return
        time = entries[0].time
        if self._file and self._is_full(self._file, time):
            self.close()
        if self._file is None:
            self._begin(time)
        for entry in entries:
            if entry.channel not in self._channels:
                self._channels[entry.channel] = self._register(entry.channel)
            channel_id = self._channels[entry.channel]
            sequence = self._sequences.get(channel_id, 0) + 1
            self._sequences[channel_id] = sequence
            self._writer.add_message(channel_id, entry.time, entry.data, entry.time, sequence)

    def _is_full(self, file: IO[bytes], time: int) -> bool:
        """True if the current file is too large or too old for an entry of a time, ns."""
        # The difference may be negative: a clock that was set back must not keep a file open.
        age = abs(time - self._first_time_ns)
        return file.tell() > self._max_bytes or age > self._max_age_ns

    def flush(self) -> None:
        """Flushes to the operating system; a killed writer loses only later entries.

        Raises:
          OSError: see `write`.
        """
        if self._file is not None:
            self._writer.flush()

    def close(self) -> None:
        """Finishes the file and gives it its final name; the next entry begins a new one.

        Raises:
          OSError: see `write`; the unfinished file keeps its suffix `.part`.
        """
        file = self._file
        self._file = None
        if file is None:
            return
        with file:
            self._writer.finish()
        final = self._path.with_suffix("")
        platforms.replace(self._path, final)
        self.files[-1] = final

    def abandon(self) -> None:
        """Drops the file after an OSError, without writing to it."""
        file = self._file
        self._file = None
        if file is not None:
            with contextlib.suppress(OSError):
                file.close()

    def _begin(self, time: int) -> None:
        """Begins a new file whose first entry has a time, ns since 1970."""
        stamp = datetime.datetime.fromtimestamp(time / 1e9, datetime.UTC).strftime("%Y%m%dT%H%M%SZ")
        self._file = self._create_file(stamp)
        self._first_time_ns = time
        self._writer = Writer(self._file, CHUNK, CompressionType.ZSTD, _INDEXES)
        self._channels: dict[Channel, int] = {}
        self._schemas: dict[tuple[str, bytes], int] = {}
        self._sequences: dict[int, int] = {}
        self.files.append(self._path)
        self._writer.start(profile="", library="congrasp")
        self._writer.add_metadata("congrasp", {"run": self._run, **CONVENTIONS})
        self._writer.flush()

    def _create_file(self, stamp: str) -> IO[bytes]:
        """Opens a new file under an unused name, `_path`."""
        while True:
            name = f"{self._name}-{stamp}-{self._file_number:03d}.mcap{PART}"
            self._path = self._directory / name
            self._file_number += 1
            try:
                file = self._open_file(self._path)
            except FileExistsError:  # another recorder is writing it
                continue
            if not self._path.with_suffix("").exists():
                return file
            # Another recorder has finished a file of this name within the same second.
            file.close()
            self._path.unlink()

    def _register(self, channel: Channel) -> int:
        """Returns the file's id of a channel, writing its schema first if needed."""
        key = (channel.schema_name, channel.schema)
        if key not in self._schemas:
            self._schemas[key] = self._writer.register_schema(
                channel.schema_name, channel.schema_encoding, channel.schema
            )
        return self._writer.register_channel(channel.topic, channel.encoding, self._schemas[key])
