"""Output of a recorder: entries on channels, for an MCAP file or a live viewer.

Metrics and signals are JSON with a JSON schema, so that viewers can plot them; events and scenes are Foxglove's
Protobuf messages, which Rerun also reads; rollouts and raw episodes are the bytes of `common.wire.codec`.
"""

import collections
import dataclasses
import functools
import json
from collections.abc import Mapping
from typing import Any, NamedTuple

from google.protobuf.message import Message as Protobuf
from mcap_protobuf.schema import build_file_descriptor_set

from congrasp.common.errors import CongraspError
from congrasp.common.wire.codec import finite

OPAQUE = "x-safetensors"
"""Encoding of messages in the format of `common.wire.codec`."""
ROLLOUT_SCHEMA = "congrasp.Rollout"
"""Name of the schema of rollouts."""

_FIELDS, _GROWTHS = 512, 32
"""Limits of a topic's fields, and of the growth of its schema, which is written in full each time."""
_LONGEST_NAME, _DEEPEST = 128, 8

CONVENTIONS = {
    "units": "metres, radians, seconds, newtons, kilograms",
    "quaternions": "(w, x, y, z) in JSON and x-safetensors; by field name in Foxglove's messages",
    "frames": "world: z up, table's top at z = 0; <actor>/<link> and <actor>/object as in the simulation",
    "joints": "finger joints by name, in the order of the hand's 'q'; wrist x, y, z, then intrinsic x-y-z angles",
}
"""Metadata of every file: meaning of the numbers."""


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
    """Sent rarely and needed by late subscribers: a live viewer that subscribes receives the last message."""


class Entry(NamedTuple):
    """One message on a channel."""

    channel: Channel
    time: int
    """Nanoseconds since 1970 of the event, by the recorder's clock."""
    data: bytes


@functools.lru_cache(maxsize=4096)
def protobuf_channel(topic: str, kind: type[Protobuf], *, latched: bool = False) -> Channel:
    """Returns a channel of one of Foxglove's messages, with the descriptors that readers need."""
    own: Any = kind  # hashable, although its type does not declare it
    return Channel(topic, "protobuf", kind.DESCRIPTOR.full_name, "protobuf", _descriptors(own), latched)


@functools.cache
def _descriptors(kind: Any) -> bytes:
    """Schema of one of Foxglove's messages, shared by all channels."""
    return build_file_descriptor_set(kind).SerializeToString()


@functools.lru_cache(maxsize=4096)
def opaque_channel(topic: str, name: str) -> Channel:
    """Returns a channel of encoded `common.wire.codec.Message`s of the kind `name`."""
    return Channel(topic, OPAQUE, name, "", b"")


class JsonChannels:
    """Channels of JSON objects whose schemas grow with new fields, since a field must be in the schema to be plotted.

    The numbers of fields and of changes are limited; further fields are dropped.
    """

    def __init__(self) -> None:
        """Starts without topics."""
        self._fields: dict[str, dict[str, Any]] = {}
        self._channels: dict[str, Channel] = {}
        self._growths: collections.Counter[str] = collections.Counter()

    def entry(self, topic: str, time: int, value: Mapping[str, Any]) -> Entry:
        """Returns the object as an entry, without fields that are NaN or infinite, which JSON cannot represent."""
        plain = finite(value)
        fields = self._fields.setdefault(topic, {})
        known = _known(fields, plain)
        if self._growths[topic] >= _GROWTHS or _count(fields) + _count(plain) - _count(known) > _FIELDS:
            plain = known
        if _merge(fields, plain) or topic not in self._channels:
            self._growths[topic] += 1
            # Schemas are identified by name, so every topic has a separate one.
            schema = json.dumps(_schema(fields)).encode()
            self._channels[topic] = Channel(topic, "json", f"congrasp{topic.replace('/', '.')}", "jsonschema", schema)
        return Entry(self._channels[topic], time, json.dumps(plain, separators=(",", ":")).encode())

    def forget(self, topic: str) -> None:
        """Forgets a topic that is no longer published."""
        for known in (self._fields, self._channels, self._growths):
            known.pop(topic, None)


def check_field(name: str) -> str:
    """Returns a field's name; raises a CongraspError if it is too long, or nested too deep."""
    if len(name) > _LONGEST_NAME or name.count("/") > _DEEPEST:
        raise CongraspError(f"{ascii(name)[:60]} is too long or nested too deep for the name of a metric.")
    return name


def nest(values: Mapping[str, float]) -> dict[str, Any]:
    """Converts `{"term/contact": 1}` to `{"term": {"contact": 1}}`; the inverse of `flatten`.

    A name that is also a prefix of another (`loss` and `loss/policy`) becomes that group's empty name.
    """
    tree: dict[str, Any] = {}
    groups = {name.rsplit("/", i)[0] for name in values for i in range(1, name.count("/") + 1)}
    for name, value in values.items():
        *path, leaf = name.split("/") if name not in groups else [*name.split("/"), ""]
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
    """Adds the fields of an object to the known ones; returns True if any is new."""
    grown = False
    for name, item in value.items():
        if isinstance(item, Mapping):
            known = fields.setdefault(name, {})
            grown |= _merge(known, item) if isinstance(known, dict) else False
        elif name not in fields:
            fields[name] = _kind(item)
            grown = True
    return grown


def _known(fields: Mapping[str, Any], value: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the part of an object in known fields."""
    kept = {name: item for name, item in value.items() if name in fields}
    return {
        name: _known(fields[name], item) if isinstance(item, Mapping) and isinstance(fields[name], dict) else item
        for name, item in kept.items()
    }


def _count(fields: Mapping[str, Any]) -> int:
    """Number of fields at any depth."""
    return sum(_count(item) if isinstance(item, Mapping) else 1 for item in fields.values())


def _kind(item: Any) -> str:
    """JSON type of a value."""
    if isinstance(item, bool):
        return "boolean"
    return "number" if isinstance(item, int | float) else "string"


def _schema(fields: Mapping[str, Any]) -> dict[str, Any]:
    """JSON schema of known fields."""
    properties = {name: _schema(kind) if isinstance(kind, dict) else {"type": kind} for name, kind in fields.items()}
    return {"type": "object", "properties": properties}
