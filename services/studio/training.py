"""State of a run while it trains: curves, events, counters, and newest episodes of actors.

It accepts log messages and the learner's status from any receiver, and is independent of network
and browser.
"""

import bisect
import collections
import dataclasses
import pathlib
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log

from congrasp.common.episode.episode import Episode
from congrasp.common.errors import CongraspError
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.transport.base import Transport
from congrasp.common.transport.keys import Keys
from congrasp.common.wire.codec import Message, decode
from congrasp.learner.run_directory import LOGS
from congrasp.services.ops import status as statuses
from congrasp.services.ops.logs import log
from congrasp.services.record.reader import (
    Record,
    is_episode,
    log_files,
    metrics_of,
    read_records,
)
from congrasp.services.record.writer import flatten
from congrasp.services.studio.recordings import Recordings
from congrasp.services.viz.plots import Panel, figures

FIRST = ("episode/success", "episode/return", "staleness_mean", "steps_per_second")
"""Curves that a page shows by default."""
_LAST = {"success": "episode/success", "steps_per_second": "steps_per_second"}
_REPORTED = ("version", "rollouts", "steps_per_second")
_READ = ("/metrics/", "/events/")
_EVENTS = 100
_TREND_EPISODES = 200
"""Episodes of an actor that its success covers."""
_STALE_S = 15.0
"""Time after which an actor that the learner no longer lists is removed."""
_POINTS_PER_SECTION = 3
"""Points of a thinned curve in each section: the lowest, the highest and the sharpest one."""


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
            sharpness = np.abs(np.diff(np.pad(values, 1, "edge"), 2))
            picked: list[int] = []
            for section in np.array_split(index, most // _POINTS_PER_SECTION):
                picked.append(section[values[section].argmin()])
                picked.append(section[values[section].argmax()])
                picked.append(section[sharpness[section].argmax()])
            index = np.unique(picked)
        return {
            "steps": [self.steps[i] for i in index],
            "values": [self.values[i] for i in index],
            "times": [self.times[i] for i in index],
        }


@dataclasses.dataclass
class Actor:
    """State of one actor, from its messages."""

    seen: float
    episode: Episode | None = None
    """Its newest episode."""
    episodes: int = 0
    recent: collections.deque[bool] = dataclasses.field(
        default_factory=lambda: collections.deque(maxlen=_TREND_EPISODES)
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

    def __init__(self, run: str, recordings: Recordings | None = None):
        """Begins without messages."""
        self.run = run
        self.recordings = recordings
        self.live = False
        self.damaged = 0
        self._lock = threading.Lock()
        self._curves: dict[str, Curve] = {}
        self._actors: dict[str, Actor] = {}
        self._events: collections.deque[dict[str, Any]] = collections.deque(maxlen=_EVENTS)
        self._status: Mapping[str, Any] | None = None
        self._disconnected = True
        self._loading = False
        self._labels: dict[str, dict[str, str]] = {}

    def take(self, key: str, message: Message, now: float) -> None:
        """Accepts one log message, as published under `log/**`; `now` in seconds since 1970."""
        try:
            *_, kind, role, name = key.split("/")
            with self._lock:
                if kind == "metrics":
                    self._metrics(role, name, message.meta, now)
                elif kind == "event":
                    text = str(message.meta["text"])
                    level = str(message.meta["level"])
                    self._event(float(message.meta.get("time", now)), level, text)
                elif kind == "episode":
                    self._episode(name, message, now)
        except (AttributeError, CongraspError, KeyError, TypeError, ValueError):
            self.damaged += 1

    def take_status(self, status: Mapping[str, Any] | None, now: float) -> None:
        """Accepts the learner's status; None while there is no response."""
        with self._lock:
            self._disconnected = status is None
            if status is None:
                return
            self._status = status
            listed = {role["id"] for role in status["roles"] if role["role"] == "actor"}
            for name in listed:
                self._actors.setdefault(name, Actor(now)).seen = now
            for name in self._actors.keys() - listed:
                if now - self._actors[name].seen > _STALE_S:
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
            for record in read_records(file, _is_read):
                _, kind, role, name = record.topic.split("/", 3)
                if kind == "episode":
                    newest[role] = record
                elif kind == "events":
                    self._take_event(record)
                else:
                    self._take_metrics(record, role, name)
        for name, record in newest.items():
            with self._lock:
                if name not in self._actors or self._actors[name].episode is None:
                    self._episode(name, decode(record.data), time.time())

    def _take_event(self, record: Record) -> None:
        """Stores a recorded line of the log."""
        event = Log.FromString(record.data)
        with self._lock:
            level = Log.Level.Name(event.level).lower()
            self._event(record.time / 1e9, level, event.message)

    def _take_metrics(self, record: Record, role: str, name: str) -> None:
        """Adds the recorded numbers of a learner's update or of an actor's rollout."""
        meta = metrics_of(record)
        with self._lock:
            flat = {**meta, "values": flatten(meta["values"])}
            self._metrics(role, name, flat, record.time / 1e9)

    def episode(self, actor: str) -> Episode:
        """The newest episode of an actor.

        Raises:
          CongraspError: none has been received.
        """
        with self._lock:
            state = self._actors.get(actor)
            if state is None or state.episode is None:
                raise CongraspError(
                    f"There is no episode of the actor '{actor}' yet.",
                    "Wait: actors publish an episode from time to time (--episode-every).",
                )
            return state.episode

    def view(self, names: Sequence[str] = (), points: int = 300) -> dict[str, Any]:
        """The state of the run for a page, as JSON, with the named curves."""
        with self._lock:
            phase = self._phase()
            status = self._status or {}
            return {
                "run": self.run,
                "phase": phase,
                "loading": self._loading,
                "last": self._last(),
                "version": status.get("version"),
                "rates": status.get("rates", {}),
                "queue": status.get("queue"),
                "counters": status.get("counters", {}),
                "warnings": status.get("warnings", []),
                "curves": self._thinned_curves(names or self._default_names(phase), points),
                "names": self._labels_of_all(),
                "constraints": self._success_by_constraint(),
                "actors": self._rows(),
                "events": list(self._events)[-20:][::-1],
            }

    def _default_names(self, phase: str) -> list[str]:
        """Curves that the page shows first: all of a run that has ended."""
        if phase in ("training", "disconnected"):
            return list(FIRST)
        return list(dict.fromkeys((*FIRST, *self._labels_of_all())))

    def _thinned_curves(
        self, names: Iterable[str], points: int
    ) -> dict[str, dict[str, list[float]]]:
        """The curves of these names that exist, with at most `points` each."""
        curves: dict[str, dict[str, list[float]]] = {}
        for name in names:
            if name in self._curves:
                curves[name] = self._curves[name].thinned(points)
        return curves

    def _success_by_constraint(self) -> dict[str, float]:
        """Newest success under each constraint that has a curve."""
        success: dict[str, float] = {}
        for constraint in CONSTRAINTS:
            curve = self._curves.get(f"success/{constraint.name}")
            if curve is not None:
                success[constraint.name] = curve.values[-1]
        return success

    def _rows(self) -> list[dict[str, Any]]:
        """List entries of the actors."""
        roles: dict[str, Mapping[str, Any]] = {}
        if self._status is not None:
            for role in self._status["roles"]:
                if role["role"] == "actor":
                    roles[role["id"]] = role
        return [self._row(name, roles.get(name)) for name in sorted(self._actors)]

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
        last: dict[str, float] = {}
        for name, metric in _LAST.items():
            if metric in self._curves:
                last[name] = self._curves[metric].values[-1]
        if self._curves:
            ends = [(curve.steps[-1], curve.times[-1]) for curve in self._curves.values()]
            last["update"], last["time"] = max(ends)
        return last

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
        episode = Episode.from_message(message)
        actor = self._actors.setdefault(name, Actor(now))
        actor.seen = now
        actor.episode = episode
        actor.episodes += 1
        actor.recent.append(episode.success)

    def _row(self, name: str, role: Mapping[str, Any] | None) -> dict[str, Any]:
        """List entry of an actor."""
        actor = self._actors[name]
        status = role or actor.last
        row: dict[str, Any] = {"id": name, "alive": role is not None, "episodes": actor.episodes}
        row |= {key: status.get(key) for key in ("version", "lag", "rollouts", "steps_per_second")}
        if actor.recent:
            row["success"] = sum(actor.recent) / len(actor.recent)
        if actor.episode is not None:
            row["object"] = actor.episode.object
            row["last"] = actor.episode.success
        return row


def labels_of(metrics: Iterable[str]) -> dict[str, dict[str, str]]:
    """Title, unit and group of each metric, in the order of the figures of `congrasp plot`."""
    any_values = (np.arange(2.0), np.arange(2.0))
    run = {f"learner/0/{name}": any_values for name in metrics}
    labels: dict[str, dict[str, str]] = {}
    for group, panels in figures({"": run}).values():
        for panel in panels:
            labels |= _labels_of_panel(panel, group)
    for name in sorted(metrics):
        if name not in labels:
            labels[name] = {"title": name, "unit": "", "group": "Details"}
    return labels


def _labels_of_panel(panel: Panel, group: str) -> dict[str, dict[str, str]]:
    """Title, unit and group of each metric of a panel."""
    labels = {}
    for name in panel.metrics:
        title = panel.title
        if len(panel.metrics) > 1:
            title = f"{panel.title}: {name.rpartition('_')[2]}"
        labels[name] = {"title": title, "unit": panel.unit, "group": group}
    return labels


def _is_read(topic: str) -> bool:
    """True for topics that `TrainingWindow.load` reads."""
    return topic.startswith(_READ) or is_episode(topic)


def open_window(run: str, recordings: pathlib.Path | None) -> TrainingWindow:
    """Opens the window on a run; a thread reads the recordings, which takes seconds for a long run.

    Args:
      run: name of the run; empty for the name of the recordings' folder.
      recordings: recordings of the run, if there are any.

    Raises:
      CongraspError: there is no folder or recording of this name.
    """
    if recordings is None:
        window = TrainingWindow(run)
    else:
        parts = [part for part in recordings.resolve().parts if part != LOGS]
        window = TrainingWindow(run or parts[-1], Recordings(recordings))
    threading.Thread(target=window.load, daemon=True, name="curves").start()
    return window


class Follower:
    """Feeds a window from a run, in two threads, until it is closed."""

    def __init__(self, transport: Transport, window: TrainingWindow, every: float = 1.0):
        """Subscribes and starts the threads; the caller still owns the transport."""
        self._transport = transport
        self._window = window
        self._every = every
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
                status = statuses.ask(self._transport, self._window.run)
            except CongraspError:
                status = None
            self._window.take_status(status, time.time())
            if self._stop.wait(self._every):
                return
