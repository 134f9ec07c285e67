"""Records the messages that a run publishes under `log/**`, in a separate thread, without blocking the run."""

import pathlib
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Protocol

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import file_name
from congrasp.common.transport.base import Transport
from congrasp.common.transport.keys import Keys
from congrasp.common.wire.codec import Message
from congrasp.services.record.channels import Entry
from congrasp.services.record.entries import Converter
from congrasp.services.record.writer import LogWriter

FLUSH_SECONDS = 0.5
"""Seconds between two flushes; a killed recorder loses no more than these."""


class Sink(Protocol):
    """Additional receiver of entries, such as a live viewer."""

    def write(self, entry: Entry) -> None:
        """Accepts an entry; must not block."""


class Recorder:
    """Subscribes to a run's logs and writes them to MCAP files.

    Attributes:
      messages: log messages recorded.
      damaged: messages that were invalid for their key, or over budget, and were dropped.
      error: reason why recording stopped; empty while it continues.
    """

    def __init__(
        self,
        transport: Transport,
        run: str,
        directory: pathlib.Path | None,
        *,
        name: str = "log",
        sinks: Sequence[Sink] = (),
        depth: int = 512,
        max_seconds: float = 600.0,
        warn: Callable[[str], None] = lambda text: print(f"congrasp: {text}", file=sys.stderr, flush=True),
    ):
        """Subscribes; `start` begins writing.

        Args:
          transport: any endpoint of the run; the caller closes it.
          run: name of the run.
          directory: folder for the files; None only serves the sinks.
          name: prefix of the files' names.
          sinks: additional receivers of every entry.
          depth: messages buffered if they arrive faster than they are written; beyond it the oldest are dropped.
          max_seconds: see `LogWriter`.
          warn: called with one line for each problem.
        """
        begin = file_name(name, "a recording")
        self._writer = LogWriter(directory, begin, run=run, max_seconds=max_seconds) if directory else None
        self._subscription = transport.subscribe(Keys(run).logs, depth=depth)
        self._sinks, self._warn = tuple(sinks), warn
        self._convert = Converter()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True, name="recorder")
        self.messages = self.damaged = 0
        self.error = ""

    @property
    def dropped(self) -> int:
        """Number of messages lost in transit, or because they arrived faster than they could be written."""
        return self._subscription.dropped

    @property
    def native_id(self) -> int | None:
        """Native id of the recorder's thread; None before it starts."""
        return self._thread.native_id

    @property
    def files(self) -> list[pathlib.Path]:
        """Files so far, the current one last."""
        return list(self._writer.files) if self._writer else []

    def start(self) -> "Recorder":
        """Starts recording; returns the recorder."""
        self._thread.start()
        return self

    def close(self, timeout: float = 5.0) -> None:
        """Writes received messages, finishes the file and ends the thread, within `timeout` seconds."""
        self._deadline = time.monotonic() + 0.8 * timeout
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(timeout)
        self._subscription.close()

    def __enter__(self) -> "Recorder":
        """Starts."""
        return self.start()

    def __exit__(self, *exc: object) -> None:
        """Closes."""
        self.close()

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
                error.strerror if isinstance(error, OSError) and error.strerror else f"{type(error).__name__}: {error}"
            )
            where = self._writer.files[-1] if self._writer.files else "the first file"
            self.error = (
                f"Recording stopped, because {where} could not be written ({reason}). Earlier messages are kept, "
                "and the run continues."
            )
            self._writer.abandon()
            self._warn(self.error)
