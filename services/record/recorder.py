"""Records the messages that a run publishes under `log/**`, in a separate thread, without blocking
the run.

Sinks take the recorder's entries: MCAP files, live viewers and, for the metrics of learners,
TensorBoard and Weights & Biases.
"""

import math
import pathlib
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Protocol

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import file_name
from congrasp.common.transport.base import Closing, Transport
from congrasp.common.transport.keys import Keys
from congrasp.common.wire.codec import Message
from congrasp.services.record.converter import Converter
from congrasp.services.record.writer import FLUSH_SECONDS, Entry, LogWriter

_POLL_S = 0.1
"""Longest wait for a message before the thread looks whether to flush or to stop."""
_CLOSING_SHARE = 0.8
"""Share of the time for closing in which received messages are written."""
_MAX_REASON_CHARACTERS = 300
"""Most characters of an error that a warning quotes."""


class Sink(Protocol):
    """Additional receiver of entries, such as a live viewer."""

    def write(self, entry: Entry) -> None:
        """Accepts an entry; must not block."""


def _print_warning(text: str) -> None:
    """Prints a warning."""
    print(f"congrasp: {text}", file=sys.stderr, flush=True)


class Recorder(Closing):
    """Subscribes to a run's logs and writes them to MCAP files.

    Attributes:
      messages: log messages recorded.
      damaged: messages that were dropped because they were invalid for their key, or over budget.
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
        warn: Callable[[str], None] = _print_warning,
    ):
        """Subscribes; `start` begins writing.

        Args:
          transport: any endpoint of the run; the caller closes it.
          run: name of the run.
          directory: folder for the files; with None there are none, and only the sinks get entries.
          name: prefix of the files' names.
          sinks: additional receivers of every entry.
          depth: messages buffered if they arrive faster than they are written; beyond it the oldest
            are dropped.
          max_seconds: see `LogWriter`.
          warn: called with one line for each problem.
        """
        prefix = file_name(name, "a recording")
        self._writer: LogWriter | None = None
        if directory:
            self._writer = LogWriter(directory, prefix, run=run, max_seconds=max_seconds)
        self._subscription = transport.subscribe(Keys(run).logs, depth=depth)
        self._sinks = tuple(sinks)
        self._warn = warn
        self._convert = Converter()
        self._stop = threading.Event()
        self._deadline = math.inf  # set by `close`; seconds of `time.monotonic`
        self._thread = threading.Thread(target=self._work, daemon=True, name="recorder")
        self.messages = 0
        self.damaged = 0
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
        if self._writer is None:
            return []
        return list(self._writer.files)

    def start(self) -> "Recorder":
        """Starts recording; returns the recorder."""
        self._thread.start()
        return self

    def close(self, timeout: float = 5.0) -> None:
        """Writes received messages, finishes the file and ends the thread, within `timeout`
        seconds.
        """
        # Before `_stop`, after which the thread reads it.
        self._deadline = time.monotonic() + _CLOSING_SHARE * timeout
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(timeout)
        self._subscription.close()

    def __enter__(self) -> "Recorder":
        """Starts."""
        return self.start()

    def _work(self) -> None:
        """Receives, writes and flushes until it is stopped."""
        last_flush = time.monotonic()
        while True:
            timeout = 0.0 if self._stop.is_set() else _POLL_S
            received = self._subscription.receive(timeout)
            if received is not None:
                self._take(*received)
            if time.monotonic() - last_flush > FLUSH_SECONDS:
                self._on_disk(lambda writer: writer.flush())
                last_flush = time.monotonic()
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
                reason = str(error)[:_MAX_REASON_CHARACTERS]
                text = f"a log message on {ascii(key)[:100]} was dropped: {reason}"
                self._warn(str(CongraspError(text)))
            return
        self.messages += 1
        for entry in entries:
            for sink in self._sinks:
                sink.write(entry)
        self._on_disk(lambda writer: writer.write(*entries))

    def _on_disk(self, action: Callable[[LogWriter], object]) -> None:
        """Calls `action` with the writer; if it fails, recording stops and the run continues."""
        if self._writer is None or self.error:
            return
        try:
            action(self._writer)
        except Exception as error:
            self._give_up(self._writer, error)

    def _give_up(self, writer: LogWriter, error: Exception) -> None:
        """Stops recording after an error of the writer."""
        reason = f"{type(error).__name__}: {error}"
        if isinstance(error, OSError) and error.strerror:
            reason = error.strerror
        where = str(writer.files[-1]) if writer.files else "the first file"
        self.error = (
            f"Recording stopped, because {where} could not be written ({reason}). Earlier "
            f"messages are kept, and the run continues."
        )
        writer.abandon()
        self._warn(self.error)
