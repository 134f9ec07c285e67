"""Converts the messages that a run publishes under `log/**` to entries of a recording.

`services.record` describes the kinds of messages, and the topics of the entries.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from foxglove_schemas_protobuf.Log_pb2 import Log

from congrasp.common.episode.episode import Episode
from congrasp.common.errors import CongraspError
from congrasp.common.transport.keys import check_name
from congrasp.common.wire.codec import Message, encode, finite
from congrasp.common.wire.messages import EVENT, LONGEST_TEXT, METRICS, validate
from congrasp.services.record.budget import LogBudget, Publisher
from congrasp.services.record.episode_entries import duration, raw_entry, scene_entries
from congrasp.services.record.writer import (
    ROLLOUT_SCHEMA,
    Entry,
    JsonChannels,
    check_field,
    nest,
    opaque_channel,
    protobuf_channel,
)

_MAX_WAIT_NS = 60_000_000_000
"""Longest time, ns, that an episode waits for the end of the actor's previous ones; it is dropped
if it had to wait longer."""
_MAX_TIME_NS = 2**62
"""Latest time of an event, ns since 1970."""
_LEVELS = {
    "debug": Log.DEBUG,
    "info": Log.INFO,
    "warning": Log.WARNING,
    "error": Log.ERROR,
    "fatal": Log.FATAL,
}


class Converter:
    """Converts messages one by one; its state grows with the publishers.

    The state consists of the fields of schemas, the places of actors in the scene, and the end of
    each actor's last episode. It is bounded separately for every identity (`LogBudget`).
    """

    def __init__(self) -> None:
        """Starts without messages."""
        self._json = JsonChannels()
        self._budget = LogBudget(self._forget)
        self._slots: dict[str, int] = {}
        """Place of each actor in the row of actors, by its name."""
        self._ends: dict[str, int] = {}
        """End of each actor's last episode, ns since 1970, by its name."""
        self._now = 0
        """Time of the last message, ns since 1970."""
        self._kinds: dict[str, Callable[[str, str, Message, int], Iterator[Entry]]] = {
            "metrics": self._metrics,
            "event": self._event,
            "version": self._version,
            "rollout": self._rollout,
            "episode": self._episode,
        }

    def __call__(self, key: str, message: Message, now: int) -> list[Entry]:
        """Converts one message to entries.

        Args:
          key: the key on which it was published.
          message: the message.
          now: time of its arrival, ns since 1970.

        Raises:
          CongraspError: it is not a valid log message, or exceeds its sender's budget.
        """
        if now < self._now:
            # The clock was set back: what is still playing keeps its remaining time.
            setback = self._now - now
            self._ends = {name: end - setback for name, end in self._ends.items()}
        self._now = now
        padded = ["", "", *key.split("/")]  # a key of fewer than three words has no known kind
        kind, role, name = padded[-3:]
        if kind not in self._kinds:
            raise CongraspError(f"{ascii(kind)[:60]} is not a kind of log message.")
        check_name("role", role)
        check_name("process", name)
        publisher = Publisher(role, name)
        self._budget.admit(publisher)
        convert = self._kinds[kind]
        try:
            message = Message(message.arrays, finite(message.meta))  # JSON has no NaN
            entries = list(convert(role, name, message, now))
        except (LookupError, TypeError, ValueError, OverflowError, RecursionError) as error:
            raise CongraspError(
                f"It is not a valid {kind} message ({type(error).__name__})."
            ) from None
        self._budget.charge(publisher, sum(len(entry.data) for entry in entries))
        return entries

    def _forget(self, publisher: Publisher) -> None:
        """Drops the state of a silent publisher."""
        role, name = publisher
        self._json.forget(f"/metrics/{role}/{name}")
        self._json.forget(f"/version/{role}/{name}")
        self._json.forget(f"/episode/{name}/signals")
        self._slots.pop(name, None)
        self._ends.pop(name, None)

    def _metrics(self, role: str, name: str, message: Message, now: int) -> Iterator[Entry]:
        """Yields the numbers of an update or a rollout."""
        validate(_timed(message, now), METRICS)
        values = {check_field(key): float(value) for key, value in message.meta["values"].items()}
        content = {**_scalars(message.meta), "values": nest(values)}
        yield self._json.entry(f"/metrics/{role}/{name}", now, content)

    def _version(self, role: str, name: str, message: Message, now: int) -> Iterator[Entry]:
        """Yields a published version."""
        yield self._json.entry(f"/version/{role}/{name}", now, _scalars(message.meta))

    def _event(self, role: str, name: str, message: Message, now: int) -> Iterator[Entry]:
        """Yields a line of the log."""
        event = _timed(message, now)
        validate(event, EVENT)
        level = _LEVELS.get(event.meta["level"].lower(), Log.UNKNOWN)
        log = Log(level=level, message=event.meta["text"], name=f"{role}/{name}")
        nanoseconds = round(1e9 * float(event.meta["time"]))
        log.timestamp.FromNanoseconds(max(0, min(_MAX_TIME_NS, nanoseconds)))
        yield Entry(protobuf_channel(f"/events/{role}/{name}", Log), now, log.SerializeToString())

    def _rollout(self, role: str, name: str, message: Message, now: int) -> Iterator[Entry]:
        """Yields a rollout unchanged."""
        yield Entry(opaque_channel(f"/rollout/{name}", ROLLOUT_SCHEMA), now, encode(message))

    def _episode(self, role: str, name: str, message: Message, now: int) -> Iterator[Entry]:
        """Yields an episode's scene, step by step."""
        episode = Episode.from_message(message)
        # An episode that arrives while the previous one is playing waits for its end.
        start = max(now, self._ends.get(name, 0))
        if start > now + _MAX_WAIT_NS:
            raise CongraspError(
                f"The previous episodes are still playing for {(start - now) / 1e9:.0f} s."
            )
        slot = self._slot(name)
        yield raw_entry(name, message, start)
        yield from scene_entries(name, episode, start, slot, self._json)
        self._ends[name] = start + duration(episode)

    def _slot(self, name: str) -> int:
        """Position of an actor in the row of actors; a new one takes the first that is free."""
        if name not in self._slots:
            taken = set(self._slots.values())
            free = set(range(len(taken) + 1)) - taken
            self._slots[name] = min(free)
        return self._slots[name]


def _timed(message: Message, now: int) -> Message:
    """Returns the message with its time of arrival (ns) if it has no time."""
    return Message(message.arrays, {"time": now / 1e9, **message.meta})


def _scalars(meta: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the entries of a message's metadata that are plain values of bounded length."""
    scalars = {}
    for key, value in meta.items():
        if isinstance(value, bool | int | float | str) and len(str(value)) <= LONGEST_TEXT:
            scalars[check_field(key)] = value
    return scalars
