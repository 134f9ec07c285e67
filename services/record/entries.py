"""Log messages as they travel (`congrasp/<run>/log/<kind>/<role>/<name>`), turned into what a recorder writes.

Kinds: `metrics` (meta: time, update or version, values), `event` (time, level, text), `version` (any scalars),
`rollout` (some worlds of an actor's rollout, opaque) and `episode` (see `services.record.scene`).
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from foxglove_schemas_protobuf.Log_pb2 import Log

from common.wire.codec import Message, encode, finite
from services.record.channels import ROLLOUT_SCHEMA, Entry, JsonChannels, nest, opaque_channel, protobuf_channel
from services.record.scene import duration, episode_entries

_LEVELS = {"debug": Log.DEBUG, "info": Log.INFO, "warning": Log.WARNING, "error": Log.ERROR, "fatal": Log.FATAL}


class Converter:
    """Remembers what spans messages: the schemas' fields, the actors' places, and when each actor's episode ends."""

    def __init__(self) -> None:
        """Nothing has come yet."""
        self._json = JsonChannels()
        self._slots: dict[str, int] = {}
        self._ends: dict[str, int] = {}
        self._kinds: dict[str, Callable[[str, str, Message, int], Iterator[Entry]]] = {
            "metrics": self._metrics,
            "event": self._event,
            "version": self._version,
            "rollout": self._rollout,
            "episode": self._episode,
        }

    def __call__(self, key: str, message: Message, now: int) -> list[Entry]:
        """Entries of one message that arrived at `now` (ns since 1970).

        Raises:
          Exception: of any kind, when it is not a whole log message.
        """
        *_, kind, role, name = key.split("/")
        plain = Message(message.arrays, finite(message.meta))
        return list(self._kinds[kind](role, name, plain, now))

    def _metrics(self, role: str, name: str, message: Message, now: int) -> Iterator[Entry]:
        """Numbers of an update or a rollout."""
        values = {key: float(value) for key, value in message.meta["values"].items()}
        yield self._json.entry(f"/metrics/{role}/{name}", now, {**_scalars(message.meta), "values": nest(values)})

    def _version(self, role: str, name: str, message: Message, now: int) -> Iterator[Entry]:
        """A published version."""
        yield self._json.entry(f"/version/{role}/{name}", now, _scalars(message.meta))

    def _event(self, role: str, name: str, message: Message, now: int) -> Iterator[Entry]:
        """A line of the log."""
        level = _LEVELS.get(str(message.meta["level"]).lower(), Log.UNKNOWN)
        log = Log(level=level, message=str(message.meta["text"]), name=f"{role}/{name}")
        log.timestamp.FromNanoseconds(round(1e9 * float(message.meta.get("time", now / 1e9))))
        yield Entry(protobuf_channel(f"/events/{role}/{name}", Log), now, log.SerializeToString())

    def _rollout(self, role: str, name: str, message: Message, now: int) -> Iterator[Entry]:
        """A rollout as it came."""
        yield Entry(opaque_channel(f"/rollout/{name}", ROLLOUT_SCHEMA), now, encode(message))

    def _episode(self, role: str, name: str, message: Message, now: int) -> Iterator[Entry]:
        """An episode's scene, step by step."""
        # An episode that comes while the one before it still plays waits for its end.
        start = max(now, self._ends.get(name, 0))
        slot = self._slots.setdefault(name, len(self._slots))
        yield from episode_entries(name, message, start, slot, self._json)
        self._ends[name] = start + duration(message)


def _scalars(meta: Mapping[str, Any]) -> dict[str, Any]:
    """What of a message's meta data is a plain value."""
    return {key: value for key, value in meta.items() if isinstance(value, bool | int | float | str)}
