"""Records what a run publishes under `log/**`, in a thread of its own, and never holds the run up."""

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
"""A killed recorder loses at most this much."""


class Sink(Protocol):
    """Where else entries go, such as a live viewer."""

    def write(self, entry: Entry) -> None:
        """Takes an entry; must not block."""


class Recorder:
    """Subscribes to a run's logs and writes them to MCAP files.

    Attributes:
      messages: log messages recorded.
      damaged: messages that were not what their key says, or too many, and were left out.
      error: why recording stopped; empty while it continues.
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
        """Subscribes; `start` begins to write.

        Args:
          transport: any endpoint of the run; it stays the caller's.
          run: name of the run.
          directory: where files go; None records nothing (for sinks alone).
          name: how the files' names begin.
          sinks: who else is given every entry.
          depth: messages kept when they come faster than they are written; then the oldest are dropped.
          max_seconds: see `LogWriter`.
          warn: takes a line about what goes wrong.
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
        """Messages lost: on the way, or because they came faster than they could be written."""
        return self._subscription.dropped

    @property
    def native_id(self) -> int | None:
        """The kernel's number of the recorder's thread; None before it starts."""
        return self._thread.native_id

    @property
    def files(self) -> list[pathlib.Path]:
        """The files so far, the one being written last."""
        return list(self._writer.files) if self._writer else []

    def start(self) -> "Recorder":
        """Begins to record; returns the recorder."""
        self._thread.start()
        return self

    def close(self, timeout: float = 5.0) -> None:
        """Writes what has arrived, finishes the file and ends the thread, within `timeout` seconds."""
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
        """Receives, writes and flushes until it is told to stop."""
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
        """Converts and writes one message; one that is not what its key says is counted and left out."""
        try:
            entries = self._convert(key, message, time.time_ns())
        except Exception as error:  # whatever a peer sends, this thread continues
            self.damaged += 1
            if self.damaged == 1:
                what = f"a log message on {ascii(key)[:100]} was left out: {str(error)[:300]}"
                self._warn(str(CongraspError(what)))
            return
        self.messages += 1
        for entry in entries:
            for sink in self._sinks:
                sink.write(entry)
        self._on_disk(lambda writer: writer.write(*entries))

    def _on_disk(self, action: Callable[[LogWriter], object]) -> None:
        """Does something with the writer; when that fails, recording stops and the run continues."""
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
                f"Recording stopped, {where} could not be written ({reason}); "
                "what was recorded before is kept and the run goes on."
            )
            self._writer.abandon()
            self._warn(self.error)
