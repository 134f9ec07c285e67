"""State of a run while it trains, and its recorded episodes: curves, events, counters, and newest
episodes of actors.

It accepts log messages and the learner's status from any receiver, and is independent of network
and browser.
"""

import bisect
import collections
import contextlib
import dataclasses
import pathlib
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log

from congrasp.common.errors import CongraspError, os_errors_as
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.transport.base import Transport
from congrasp.common.transport.keys import Keys
from congrasp.common.wire.codec import Message, decode
from congrasp.learner.run_directory import LOGS
from congrasp.services.ops import status as statuses
from congrasp.services.ops.logs import log
from congrasp.services.record.chunks import DamagedChunkError
from congrasp.services.record.mcap_messages import intact_summary, messages_between
from congrasp.services.record.reader import (
    Record,
    is_episode,
    log_files,
    metrics_of,
    read_records,
)
from congrasp.services.record.scene import EPISODE_SCHEMA
from congrasp.services.record.writer import flatten
from congrasp.services.viz.plots import figures

FIRST = ("episode/success", "episode/return", "staleness_mean", "steps_per_second")
"""Curves that a page shows by default."""
MOST = 60
"""Maximum number of episodes of one search: those nearest to the time."""
FARTHER = (1.0, 5.0, 25.0)
"""Factors on the time searched, tried in turn until there is an episode."""
_LAST = {"success": "episode/success", "steps_per_second": "steps_per_second"}
_REPORTED = ("version", "rollouts", "steps_per_second")
_READ = ("/metrics/", "/events/")
_EVENTS = 100
_TREND = 200  # episodes of an actor that its success covers
_STALE = 15.0  # seconds after which an actor that the learner no longer lists is removed


@dataclasses.dataclass
class Curve:
    """A metric over the updates of a run; after a return to a checkpoint, later values replace
    earlier ones.
    """

    steps: list[float] = dataclasses.field(default_factory=list)
    values: list[float] = dataclasses.field(default_factory=list)
    times: list[float] = dataclasses.field(default_factory=list)
    """Seconds since 1970."""

    def add(self, step: float, value: float, time: float) -> None:
        """Adds a point, and removes those at the same or a later step."""
        if self.steps and step <= self.steps[-1]:
            first = bisect.bisect_left(self.steps, step)
            del self.steps[first:], self.values[first:], self.times[first:]
        self.steps.append(step)
        self.values.append(value)
        self.times.append(time)

    def thinned(self, most: int) -> dict[str, list[float]]:
        """At most `most` points for a page: of each section the lowest, the highest and the
        sharpest one.
        """
        index = np.arange(len(self.steps))
        if len(index) > most:
            values = np.array(self.values)
            sudden = np.abs(np.diff(np.pad(values, 1, "edge"), 2))
            parts = np.array_split(index, most // 3)
            index = np.unique(
                [
                    [p[values[p].argmin()], p[values[p].argmax()], p[sudden[p].argmax()]]
                    for p in parts
                ]
            )
        return {
            name: [getattr(self, name)[i] for i in index] for name in ("steps", "values", "times")
        }


@dataclasses.dataclass
class Actor:
    """State of one actor, from its messages."""

    seen: float
    episode: Message | None = None
    """Its newest episode."""
    episodes: int = 0
    recent: collections.deque[bool] = dataclasses.field(
        default_factory=lambda: collections.deque(maxlen=_TREND)
    )
    """Success of its last episodes."""
    last: dict[str, float] = dataclasses.field(default_factory=dict)
    """Version, rollouts and steps per second of its last report."""


class TrainingWindow:
    """Accepts messages from any thread, and provides their state to a page.

    Attributes:
      live: True if the run is followed; False if it is only read from its recordings.
      damaged: number of messages whose content did not match their key.
      recordings: recorded episodes of the run, or None.
    """

    def __init__(self, run: str, recordings: "Recordings | None" = None):
        """Begins without messages."""
        self.run, self.recordings, self.live, self.damaged = run, recordings, False, 0
        self._lock = threading.Lock()
        self._curves: dict[str, Curve] = {}
        self._actors: dict[str, Actor] = {}
        self._events: collections.deque[dict[str, Any]] = collections.deque(maxlen=_EVENTS)
        self._status: Mapping[str, Any] | None = None
        self._disconnected, self._loading = True, False
        self._labels: dict[str, dict[str, str]] = {}

    def take(self, key: str, message: Message, now: float) -> None:
        """Accepts one log message, as published under `log/**`; `now` in seconds since 1970."""
        try:
            *_, kind, role, name = key.split("/")
            with self._lock:
                if kind == "metrics":
                    self._metrics(role, name, message.meta, now)
                elif kind == "event":
                    text, level = str(message.meta["text"]), str(message.meta["level"])
                    self._event(float(message.meta.get("time", now)), level, text)
                elif kind == "episode":
                    self._episode(name, message, now)
        except (AttributeError, KeyError, TypeError, ValueError):
            self.damaged += 1

    def take_status(self, found: Mapping[str, Any] | None, now: float) -> None:
        """Accepts the learner's status; None while there is no response."""
        with self._lock:
            self._disconnected = found is None
            if found is None:
                return
            self._status = found
            listed = {role["id"] for role in found["roles"] if role["role"] == "actor"}
            for name in listed:
                self._actors.setdefault(name, Actor(now)).seen = now
            for name in [name for name, actor in self._actors.items() if name not in listed]:
                if now - self._actors[name].seen > _STALE:
                    del self._actors[name]

    def load(self) -> None:
        """Reads curves and events from the recordings, and the last report and newest episode of
        every actor.

        Logs a warning if they cannot be read.
        """
        if self.recordings is None:
            return
        self._loading = True
        try:
            self._read(self.recordings.path)
        except CongraspError as error:
            log("warning", str(error))
        finally:
            self._loading = False

    def _read(self, path: pathlib.Path) -> None:
        """Does the work of `load`."""
        newest: dict[str, Record] = {}
        for file in log_files(path):
            for record in read_records(
                file, lambda topic: topic.startswith(_READ) or is_episode(topic)
            ):
                _, kind, role, name = record.topic.split("/", 3)
                if kind == "events":
                    event = Log.FromString(record.data)
                    with self._lock:
                        self._event(
                            record.time / 1e9, Log.Level.Name(event.level).lower(), event.message
                        )
                    continue
                if kind == "episode":
                    newest[role] = record
                    continue
                meta = metrics_of(record)
                with self._lock:
                    self._metrics(
                        role, name, {**meta, "values": flatten(meta["values"])}, record.time / 1e9
                    )
        for name, record in newest.items():
            with self._lock:
                if name not in self._actors or self._actors[name].episode is None:
                    self._episode(name, decode(record.data), time.time())

    def episode(self, actor: str) -> Message:
        """The newest episode of an actor.

        Raises:
          CongraspError: none has been received.
        """
        with self._lock:
            known = self._actors.get(actor)
            if known is None or known.episode is None:
                raise CongraspError(
                    f"There is no episode of the actor '{actor}' yet.",
                    "Wait: actors send one from time to time.",
                )
            return known.episode

    def view(self, names: Sequence[str] = (), points: int = 300) -> dict[str, Any]:
        """The state of the run for a page, as JSON, with the named curves."""
        with self._lock:
            found, roles = self._status, {}
            if found is not None:
                roles = {role["id"]: role for role in found["roles"] if role["role"] == "actor"}
            phase = self._phase()
            first = (
                FIRST if phase in ("training", "disconnected") else (*FIRST, *self._labels_of_all())
            )
            wanted = [name for name in names or dict.fromkeys(first) if name in self._curves]
            return {
                "run": self.run,
                "phase": phase,
                "loading": self._loading,
                "last": self._last(),
                "version": None if found is None else found["version"],
                "rates": {} if found is None else found["rates"],
                "queue": None if found is None else found["queue"],
                "counters": {} if found is None else found["counters"],
                "warnings": [] if found is None else found["warnings"],
                "curves": {name: self._curves[name].thinned(points) for name in wanted},
                "names": self._labels_of_all(),
                "constraints": {
                    constraint.name: self._curves[f"success/{constraint.name}"].values[-1]
                    for constraint in CONSTRAINTS
                    if f"success/{constraint.name}" in self._curves
                },
                "actors": [self._row(name, roles.get(name)) for name in sorted(self._actors)],
                "events": list(self._events)[-20:][::-1],
            }

    def _phase(self) -> str:
        """Phase of the run: training, finished, disconnected, or recorded (read from its recordings
        alone).
        """
        if self._status is not None and self._status["finished"]:
            return "finished"
        if not self.live and self._status is None:
            return "recorded"
        return "disconnected" if self._disconnected else "training"

    def _last(self) -> dict[str, float]:
        """Update and time (seconds since 1970) of the newest point, and the newest success and
        throughput.
        """
        found = {
            name: self._curves[curve].values[-1]
            for name, curve in _LAST.items()
            if curve in self._curves
        }
        ends = [(curve.steps[-1], curve.times[-1]) for curve in self._curves.values()]
        return found | (dict(zip(("update", "time"), max(ends), strict=True)) if ends else {})

    def _labels_of_all(self) -> dict[str, dict[str, str]]:
        """Title, unit and group of each curve, in the order of the figures."""
        if self._labels.keys() != self._curves.keys():
            self._labels = labels_of(self._curves)
        return self._labels

    def _event(self, time: float, level: str, text: str) -> None:
        """Stores a line of the log."""
        self._events.append({"time": time, "level": level, "text": text})

    def _metrics(self, role: str, name: str, meta: Mapping[str, Any], now: float) -> None:
        """Adds the numbers of a learner's update or of an actor's rollout."""
        when = float(meta.get("time", now))
        values = {key: float(value) for key, value in meta["values"].items()}
        if role == "actor":
            actor = self._actors.setdefault(name, Actor(now))
            actor.seen = now
            reported = {"version": float(meta.get("version", 0)), **values}
            actor.last = {key: reported[key] for key in _REPORTED if key in reported}
            return
        if role != "learner" or name != "0":
            return  # every rank of a learner publishes the same
        step = float(meta.get("update", meta.get("version", 0)))
        for key, value in values.items():
            if np.isfinite(value):
                self._curves.setdefault(key, Curve()).add(step, value, when)

    def _episode(self, name: str, message: Message, now: float) -> None:
        """Stores an actor's newest episode."""
        if "link_position" not in message.arrays or "success" not in message.meta:
            raise ValueError("not an episode")
        actor = self._actors.setdefault(name, Actor(now))
        actor.seen, actor.episode, actor.episodes = now, message, actor.episodes + 1
        actor.recent.append(bool(message.meta["success"]))

    def _row(self, name: str, role: Mapping[str, Any] | None) -> dict[str, Any]:
        """List entry of an actor."""
        actor = self._actors[name]
        status = role or actor.last
        row: dict[str, Any] = {"id": name, "alive": role is not None, "episodes": actor.episodes}
        row |= {key: status.get(key) for key in ("version", "lag", "rollouts", "steps_per_second")}
        if actor.recent:
            row["success"] = sum(actor.recent) / len(actor.recent)
        if actor.episode is not None:
            row["object"] = actor.episode.meta.get("object")
            row["last"] = bool(actor.episode.meta["success"])
        return row


def labels_of(metrics: Iterable[str]) -> dict[str, dict[str, str]]:
    """Title, unit and group of each metric, in the order of the figures of `congrasp plot`."""
    any_values = np.arange(2.0), np.arange(2.0)
    found = {}
    for group, panels in figures(
        {"": {f"learner/0/{name}": any_values for name in metrics}}
    ).values():
        for panel in panels:
            for name in panel.metrics:
                title = (
                    panel.title
                    if len(panel.metrics) == 1
                    else f"{panel.title}: {name.rpartition('_')[2]}"
                )
                found[name] = {"title": title, "unit": panel.unit, "group": group}
    return found | {
        n: {"title": n, "unit": "", "group": "Details"} for n in sorted(metrics) if n not in found
    }


def opened_window(run: str, recordings: pathlib.Path | None) -> TrainingWindow:
    """Returns the window on a run, which reads its recordings in the background: that takes seconds
    for a long run.

    Args:
      run: name of the run; empty for that of the recordings' folder.
      recordings: recordings of the run, if there are any.

    Raises:
      CongraspError: there is no folder or recording of this name.
    """
    parts = [part for part in recordings.resolve().parts if part != LOGS] if recordings else [""]
    window = TrainingWindow(run or parts[-1], Recordings(recordings) if recordings else None)
    threading.Thread(target=window.load, daemon=True, name="curves").start()
    return window


class Follower:
    """Feeds a window from a run, in two threads, until it is closed."""

    def __init__(self, transport: Transport, window: TrainingWindow, every: float = 1.0):
        """Subscribes and starts the threads; the caller still owns the transport."""
        self._transport, self._window, self._every = transport, window, every
        window.live = True
        self._stop = threading.Event()
        self._subscription = transport.subscribe(Keys(window.run).logs, depth=1024)
        self._threads = [
            threading.Thread(target=work, daemon=True) for work in (self._receive, self._ask)
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Ends the threads."""
        self._stop.set()
        self._subscription.close()
        for thread in self._threads:
            thread.join(2.0)

    def _receive(self) -> None:
        """Passes log messages to the window until it is closed."""
        while not self._stop.is_set():
            received = self._subscription.receive(0.5)
            if received is not None:
                self._window.take(*received, time.time())

    def _ask(self) -> None:
        """Queries the learner's status periodically."""
        while True:
            try:
                found = statuses.ask(self._transport, self._window.run)
            except CongraspError:
                found = None
            self._window.take_status(found, time.time())
            if self._stop.wait(self._every):
                return


class Recordings:
    """The episodes in a folder of recordings, found by their time.

    Episodes of the last search stay in memory, for the player.
    """

    def __init__(self, path: pathlib.Path):
        """Reads nothing until the first search, because files may appear and grow.

        Raises:
          CongraspError: there is no folder or recording of this name.
        """
        remedy = "Name a run's folder, or its recordings."
        if not path.exists():
            raise CongraspError(f"There is no file or folder {path}.", remedy)
        if not path.is_dir() and ".mcap" not in path.suffixes:
            raise CongraspError(f"{path} is no recording (*.mcap).", remedy)
        self.path = path
        self._lock = threading.Lock()
        self._found: dict[str, Message] = {}

    def around(self, time: float, seconds: float) -> tuple[float, list[dict[str, Any]]]:
        """Episodes that were recorded around a time, in the order of their times.

        Args:
          time: seconds since 1970.
          seconds: largest distance from it; the search widens by `FARTHER` while it finds none.

        Returns:
          The distance searched (s), and the list entry of each episode; its `id` is for `episode`.

        Raises:
          CongraspError: there are no recordings, or a file cannot be read.
        """
        files = log_files(self.path)
        for farther in FARTHER:
            begin, end = (int(1e9 * (time + sign * farther * seconds)) for sign in (-1, 1))
            found = [item for file in files for item in _within(file, begin, end)]
            if found:
                break
        found = sorted(found, key=lambda item: abs(item[0] - 1e9 * time))[:MOST]
        kept = {
            f"{when}{topic}": decode(data)
            for when, topic, data in sorted(found, key=lambda item: item[0])
        }
        with self._lock:
            self._found = kept
        return farther * seconds, [_recorded(key, message) for key, message in kept.items()]

    def episode(self, key: str) -> Message:
        """An episode of the last search.

        Raises:
          CongraspError: the last search did not find it.
        """
        with self._lock:
            if key not in self._found:
                raise CongraspError(
                    "This episode is not among those found last.", "Click the curve again."
                )
            return self._found[key]


def _recorded(key: str, message: Message) -> dict[str, Any]:
    """List entry of an episode."""
    time, _, topic = key.partition("/")
    return {
        "id": key,
        "time": int(time) / 1e9,
        "actor": topic.split("/")[1],
        "object": message.meta.get("object"),
        "version": message.meta.get("version"),
        "success": bool(message.meta.get("success")),
    }


def _within(file: pathlib.Path, begin: int, end: int) -> list[tuple[int, str, bytes]]:
    """Time (ns), topic and bytes of a file's raw episodes between two times."""
    if (found := _by_index(file, begin, end)) is not None:
        return found
    return [
        (record.time, record.topic, record.data)
        for record in read_records(file, is_episode)
        if record.schema == EPISODE_SCHEMA and begin <= record.time <= end
    ]


def _by_index(file: pathlib.Path, begin: int, end: int) -> list[tuple[int, str, bytes]] | None:
    """Does the work of `_within` by the index of a finished file; None if it is unfinished, or
    damaged where read.
    """
    with (
        os_errors_as(f"{file} cannot be read"),
        contextlib.suppress(DamagedChunkError),
        file.open("rb") as stream,
    ):
        if (summary := intact_summary(stream)) is None or (
            statistics := summary.statistics
        ) is None:
            return None
        if statistics.message_start_time > end or statistics.message_end_time < begin:
            return []
        topics = [
            channel.topic for channel in summary.channels.values() if is_episode(channel.topic)
        ]
        messages = messages_between(stream, summary, topics, begin, end)
        return [
            (message.log_time, channel.topic, message.data)
            for schema, channel, message in messages
            if schema is not None and schema.name == EPISODE_SCHEMA
        ]
    return None
