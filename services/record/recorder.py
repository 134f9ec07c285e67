"""Records the messages that a run publishes under `log/**`, in a separate thread, without blocking
the run.

Kinds of `congrasp/<run>/log/<kind>/<role>/<name>`: `metrics` (meta: time, update or version,
values), `event` (time, level, text), `version` (any scalars), `rollout` (some worlds of an actor's
rollout, opaque) and `episode` (see `services.record.scene`).

Sinks take the recorder's entries: MCAP files, live viewers and, for the metrics of learners,
TensorBoard and Weights & Biases.
"""

import collections
import contextlib
import dataclasses
import json
import pathlib
import secrets
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol

from foxglove_schemas_protobuf.Log_pb2 import Log

from congrasp.common.config import MetricWriter, RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import file_name
from congrasp.common.transport.base import Closing, Transport
from congrasp.common.transport.keys import Keys, check_name
from congrasp.common.wire.codec import Message, encode, finite
from congrasp.common.wire.messages import EVENT, LONGEST_TEXT, METRICS, validate
from congrasp.learner.hub.limits import certificate
from congrasp.services.record.scene import check_episode, duration, episode_entries
from congrasp.services.record.writer import (
    FLUSH_SECONDS,
    ROLLOUT_SCHEMA,
    Entry,
    JsonChannels,
    LogWriter,
    check_field,
    flatten,
    nest,
    opaque_channel,
    protobuf_channel,
)

Name = tuple[str, str]
"""Role and name of a publisher."""

_NAMES = 64  # names of one identity
_IDENTITIES = 1024
_IDLE = 60.0  # seconds after which a silent name may be replaced
# Bytes per second of an identity's entries, and their burst
_PER_SECOND, _MOST = (
    16 << 20,
    256 << 20,
)
_AHEAD = 60_000_000_000
"""Longest queue of an actor's episodes in ns; later ones are dropped."""
_TIMES = 2**62
"""Limit of times, ns since 1970."""
_LEVELS = {
    "debug": Log.DEBUG,
    "info": Log.INFO,
    "warning": Log.WARNING,
    "error": Log.ERROR,
    "fatal": Log.FATAL,
}
_TOPIC = "/metrics/learner/"


class LogBudget:
    """Budgets of the logs of one identity: number of names, and bytes per second. Not thread-safe.

    An identity is a role and, for actors, a certificate. The excess over a budget is dropped; the
    logs of others are not affected.
    """

    def __init__(
        self, on_forget: Callable[[Name], None], clock: Callable[[], float] = time.monotonic
    ):
        """Starts without names.

        Args:
          on_forget: called with a name that is replaced by another.
          clock: seconds, monotonic.
        """
        self._on_forget, self._clock = on_forget, clock
        self._heard: dict[Name, collections.OrderedDict[Name, float]] = {}
        self._bytes: dict[Name, tuple[float, float]] = {}

    def admit(self, who: Name) -> None:
        """Admits a message of a publisher.

        Raises:
          CongraspError: its identity has too many names, or has used up its bytes.
        """
        identity, now = _identity(who), self._clock()
        if identity not in self._heard and len(self._heard) >= _IDENTITIES:
            raise CongraspError(f"More than {_IDENTITIES} identities publish logs.")
        heard = self._heard.setdefault(identity, collections.OrderedDict())
        if who not in heard and len(heard) >= _NAMES:
            oldest = next(iter(heard))
            if heard[oldest] > now - _IDLE:
                raise CongraspError(f"More than {_NAMES} names of one certificate publish logs.")
            del heard[oldest]
            self._on_forget(oldest)
        heard[who] = now
        heard.move_to_end(who)
        if self._level(identity, now) <= 0:
            raise CongraspError(
                f"One certificate publishes more than {_PER_SECOND >> 20} MiB of logs a second."
            )

    def charge(self, who: Name, size: int) -> None:
        """Charges a publisher for recorded bytes."""
        identity, now = _identity(who), self._clock()
        self._bytes[identity] = self._level(identity, now) - size, now

    def _level(self, identity: Name, now: float) -> float:
        level, since = self._bytes.get(identity, (float(_MOST), now))
        return min(_MOST, level + (now - since) * _PER_SECOND)


def _identity(who: Name) -> Name:
    role, name = who
    return role, certificate(name) if role == "actor" else ""


class Converter:
    """State across messages: fields of schemas, slots of actors, and the end of each actor's
    episode.

    All of it is bounded, separately for every identity (`LogBudget`).
    """

    def __init__(self) -> None:
        """Starts without messages."""
        self._json = JsonChannels()
        self._budget = LogBudget(self._forget)
        self._slots: dict[str, int] = {}
        self._ends: dict[str, int] = {}
        self._now = 0
        self._kinds: dict[str, Callable[[str, str, Message, int], Iterator[Entry]]] = {
            "metrics": self._metrics,
            "event": self._event,
            "version": self._version,
            "rollout": self._rollout,
            "episode": self._episode,
        }

    def __call__(self, key: str, message: Message, now: int) -> list[Entry]:
        """Converts one message that arrived at `now` (ns since 1970) to entries.

        Raises:
          CongraspError: it is not a valid log message, or exceeds its sender's budget.
        """
        if (
            now < self._now
        ):  # the clock was set back: what is still playing keeps its remaining time
            self._ends = {name: end - (self._now - now) for name, end in self._ends.items()}
        self._now = now
        *_, kind, role, name = ("", "", *key.split("/"))
        if kind not in self._kinds:
            raise CongraspError(f"{ascii(kind)[:60]} is not a kind of log message.")
        who = check_name("role", role), check_name("role", name)
        self._budget.admit(who)
        try:
            entries = list(
                self._kinds[kind](role, name, Message(message.arrays, finite(message.meta)), now)
            )
        except (LookupError, TypeError, ValueError, OverflowError, RecursionError) as error:
            raise CongraspError(
                f"It is not a valid {kind} message ({type(error).__name__})."
            ) from None
        self._budget.charge(who, sum(len(entry.data) for entry in entries))
        return entries

    def _forget(self, who: Name) -> None:
        """Drops the state of a silent publisher."""
        role, name = who
        for topic in (
            f"/metrics/{role}/{name}",
            f"/version/{role}/{name}",
            f"/episode/{name}/signals",
        ):
            self._json.forget(topic)
        self._slots.pop(name, None)
        self._ends.pop(name, None)

    def _metrics(self, role: str, name: str, message: Message, now: int) -> Iterator[Entry]:
        """Yields the numbers of an update or a rollout."""
        validate(_timed(message, now), METRICS)
        values = {check_field(key): float(value) for key, value in message.meta["values"].items()}
        yield self._json.entry(
            f"/metrics/{role}/{name}", now, {**_scalars(message.meta), "values": nest(values)}
        )

    def _version(self, role: str, name: str, message: Message, now: int) -> Iterator[Entry]:
        """Yields a published version."""
        yield self._json.entry(f"/version/{role}/{name}", now, _scalars(message.meta))

    def _event(self, role: str, name: str, message: Message, now: int) -> Iterator[Entry]:
        """Yields a line of the log."""
        validate(event := _timed(message, now), EVENT)
        level = _LEVELS.get(event.meta["level"].lower(), Log.UNKNOWN)
        log = Log(level=level, message=event.meta["text"], name=f"{role}/{name}")
        log.timestamp.FromNanoseconds(max(0, min(_TIMES, round(1e9 * float(event.meta["time"])))))
        yield Entry(protobuf_channel(f"/events/{role}/{name}", Log), now, log.SerializeToString())

    def _rollout(self, role: str, name: str, message: Message, now: int) -> Iterator[Entry]:
        """Yields a rollout unchanged."""
        yield Entry(opaque_channel(f"/rollout/{name}", ROLLOUT_SCHEMA), now, encode(message))

    def _episode(self, role: str, name: str, message: Message, now: int) -> Iterator[Entry]:
        """Yields an episode's scene, step by step."""
        check_episode(message)
        # An episode that arrives while the previous one is playing waits for its end.
        start = max(now, self._ends.get(name, 0))
        if start > now + _AHEAD:
            raise CongraspError(
                f"The previous episodes are still playing for {(start - now) / 1e9:.0f} s."
            )
        taken = set(self._slots.values())
        slot = self._slots.setdefault(
            name, next(i for i in range(len(taken) + 1) if i not in taken)
        )
        yield from episode_entries(name, message, start, slot, self._json)
        self._ends[name] = start + duration(message)


def _timed(message: Message, now: int) -> Message:
    """Returns the message with its time of arrival (ns) if it has no time."""
    return Message(message.arrays, {"time": now / 1e9, **message.meta})


def _scalars(meta: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the entries of a message's metadata that are plain values of bounded length."""
    return {
        check_field(key): value
        for key, value in meta.items()
        if isinstance(value, bool | int | float | str) and len(str(value)) <= LONGEST_TEXT
    }


class Sink(Protocol):
    """Additional receiver of entries, such as a live viewer."""

    def write(self, entry: Entry) -> None:
        """Accepts an entry; must not block."""


class Recorder(Closing):
    """Subscribes to a run's logs and writes them to MCAP files.

    Attributes:
      messages: log messages recorded.
      damaged: messages that were invalid for their key, or over budget, and were dropped.
      error: reason why recording stopped; empty while it continues.
    """

    def __init__(  # noqa: PLR0913
        self,
        transport: Transport,
        run: str,
        directory: pathlib.Path | None,
        *,
        name: str = "log",
        sinks: Sequence[Sink] = (),
        depth: int = 512,
        max_seconds: float = 600.0,
        warn: Callable[[str], None] = lambda text: print(
            f"congrasp: {text}", file=sys.stderr, flush=True
        ),
    ):
        """Subscribes; `start` begins writing.

        Args:
          transport: any endpoint of the run; the caller closes it.
          run: name of the run.
          directory: folder for the files; None only serves the sinks.
          name: prefix of the files' names.
          sinks: additional receivers of every entry.
          depth: messages buffered if they arrive faster than they are written; beyond it the oldest
            are dropped.
          max_seconds: see `LogWriter`.
          warn: called with one line for each problem.
        """
        begin = file_name(name, "a recording")
        self._writer = (
            LogWriter(directory, begin, run=run, max_seconds=max_seconds) if directory else None
        )
        self._subscription = transport.subscribe(Keys(run).logs, depth=depth)
        self._sinks, self._warn = tuple(sinks), warn
        self._convert = Converter()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True, name="recorder")
        self.messages = self.damaged = 0
        self.error = ""

    @property
    def dropped(self) -> int:
        """Number of messages lost in transit, or because they arrived faster than they could be
        written.
        """
        return self._subscription.dropped

    @property
    def files(self) -> list[pathlib.Path]:
        """Files so far, the current one last."""
        return list(self._writer.files) if self._writer else []

    def start(self) -> "Recorder":
        """Starts recording; returns the recorder."""
        self._thread.start()
        return self

    def close(self, timeout: float = 5.0) -> None:
        """Writes received messages, finishes the file and ends the thread, within `timeout`
        seconds.
        """
        self._deadline = time.monotonic() + 0.8 * timeout
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(timeout)
        self._subscription.close()

    def __enter__(self) -> "Recorder":
        """Starts."""
        return self.start()

    def _work(self) -> None:
        """Receives, writes and flushes until it is stopped."""
        flushed = time.monotonic()
        while True:
            received = self._subscription.receive(0.0 if self._stop.is_set() else 0.1)
            if received is not None:
                self._take(*received)
            if time.monotonic() - flushed > FLUSH_SECONDS:
                self._on_disk(lambda writer: writer.flush())
                flushed = time.monotonic()
            if self._stop.is_set() and (received is None or time.monotonic() > self._deadline):
                break
        self._on_disk(lambda writer: writer.close())

    def _take(self, key: str, message: Message) -> None:
        """Converts and writes one message; an invalid one is counted and dropped."""
        try:
            entries = self._convert(key, message, time.time_ns())
        except Exception as error:  # this thread continues after any message from a peer
            self.damaged += 1
            if self.damaged == 1:
                what = f"a log message on {ascii(key)[:100]} was dropped: {str(error)[:300]}"
                self._warn(str(CongraspError(what)))
            return
        self.messages += 1
        for entry in entries:
            for sink in self._sinks:
                sink.write(entry)
        self._on_disk(lambda writer: writer.write(*entries))

    def _on_disk(self, action: Callable[[LogWriter], object]) -> None:
        """Runs an action of the writer; if it fails, recording stops and the run continues."""
        if self._writer is None or self.error:
            return
        try:
            action(self._writer)
        except Exception as error:
            reason = (
                error.strerror
                if isinstance(error, OSError) and error.strerror
                else f"{type(error).__name__}: {error}"
            )
            where = self._writer.files[-1] if self._writer.files else "the first file"
            self.error = (
                f"Recording stopped, because {where} could not be written ({reason}). Earlier "
                f"messages are kept, "
                "and the run continues."
            )
            self._writer.abandon()
            self._warn(self.error)


class MetricWriters:
    """A sink of `services.record.recorder.Recorder` for learners' metrics; a failed writer is not
    used again.
    """

    def __init__(self, writers: Mapping[str, "_TensorBoard | _WeightsAndBiases"]):
        """Creates a sink with writers by name."""
        self._writers = dict(writers)

    def write(self, entry: Entry) -> None:
        """Accepts an entry; entries that are not metrics of a learner are ignored."""
        if not entry.channel.topic.startswith(_TOPIC):
            return
        message = json.loads(entry.data)
        values = {name: float(value) for name, value in flatten(message["values"]).items()}
        step = int(message.get("update", message.get("version", 0)))
        learner = entry.channel.topic.removeprefix(_TOPIC)
        self._each(lambda writer: writer.write(learner, 1e-9 * entry.time, step, values))

    def close(self) -> None:
        """Finishes every writer."""
        self._each(lambda writer: writer.close())

    def _each(self, action: Callable[[Any], None]) -> None:
        for name, writer in list(self._writers.items()):
            try:
                action(writer)
            except Exception as error:  # a failed writer must not end the training
                del self._writers[name]
                text = (
                    f"congrasp: {name} receives no more metrics ({type(error).__name__}: {error}); "
                    f"the run continues."
                )
                print(text, file=sys.stderr, flush=True)


class _TensorBoard:
    """Event files, one folder per learner; written synchronously, so that there is no thread to
    wait for.
    """

    def __init__(self, folder: pathlib.Path):
        self._folder = folder
        self._files: dict[str, Any] = {}

    def write(self, learner: str, seconds: float, step: int, values: Mapping[str, float]) -> None:
        """Writes the scalars of an update."""
        from tensorboardX.proto.event_pb2 import Event, SessionLog
        from tensorboardX.proto.summary_pb2 import Summary

        file = self._files.get(learner)
        if file is None:
            file = self._files[learner] = self._begin(learner)
            # A resumed run repeats steps: TensorBoard purges those of an earlier file from here on.
            file.write_event(
                Event(wall_time=seconds, step=step, session_log=SessionLog(status=SessionLog.START))
            )
        summary = Summary(
            value=[Summary.Value(tag=name, simple_value=value) for name, value in values.items()]
        )
        file.write_event(Event(wall_time=seconds, step=step, summary=summary))
        file.flush()

    def _begin(self, learner: str) -> Any:
        from tensorboardX.event_file_writer import EventsWriter

        folder = self._folder / f"learner-{learner}"
        folder.mkdir(parents=True, exist_ok=True)
        return EventsWriter(str(folder / "events"), f".{secrets.token_hex(4)}")

    def close(self) -> None:
        """Finishes."""
        for file in self._files.values():
            file.close()


class _WeightsAndBiases:
    """A run of Weights & Biases; offline it is stored in the run's folder and uploaded with `wandb
    sync`.
    """

    def __init__(self, folder: pathlib.Path, run: str, config: Mapping[str, Any], *, offline: bool):
        import wandb

        settings = wandb.Settings(console="off", silent=True, x_disable_stats=True, init_timeout=20)
        self._run = wandb.init(
            project="congrasp",
            name=run,
            group=run,
            dir=str(folder),
            config=dict(config),
            mode="offline" if offline else "online",
            settings=settings,
        )
        self._run.define_metric("*", step_metric="update")

    def write(self, learner: str, seconds: float, step: int, values: Mapping[str, float]) -> None:
        """Writes the scalars of an update."""
        prefix = "" if learner == "0" else f"learner-{learner}/"
        self._run.log(
            {**{f"{prefix}{name}": value for name, value in values.items()}, "update": step}
        )

    def close(self) -> None:
        """Finishes."""
        import wandb

        self._run.finish()
        wandb.teardown()  # waits for the process that writes the file


@contextlib.contextmanager
def recorded(
    transport: Transport,
    config: RunConfig,
    run_dir: pathlib.Path,
    logs: pathlib.Path,
    names: Sequence[MetricWriter],
) -> Iterator[Recorder]:
    """Context that records a run, and passes its metrics to writers.

    Args:
      transport: an endpoint of the run.
      config: the run's configuration.
      run_dir: the run's folder; TensorBoard's files go to `tensorboard` in it, those of Weights &
        Biases to `wandb`.
      logs: folder of the recordings.
      names: names of the writers.

    Raises:
      ModuleNotFoundError: a writer's package is not installed.
    """
    writers: dict[str, _TensorBoard | _WeightsAndBiases] = {}
    for name in dict.fromkeys(names):
        if name == "tensorboard":
            writers[name] = _TensorBoard(run_dir / name)
        else:
            offline = name == "wandb-offline"
            writers[name] = _WeightsAndBiases(
                run_dir, config.name, dataclasses.asdict(config), offline=offline
            )
    combined = MetricWriters(writers)
    with (
        contextlib.closing(combined),
        Recorder(transport, config.name, logs, sinks=[combined]) as recorder,
    ):
        yield recorder
