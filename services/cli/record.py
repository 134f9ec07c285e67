"""`congrasp record`: a run as MCAP."""

import contextlib
import math
import pathlib
import secrets
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from rich.console import Console

from congrasp.common.errors import CongraspError
from congrasp.common.transport import urls
from congrasp.common.transport.keys import Keys, process_name
from congrasp.common.transport.ports import LEARNER_URL
from congrasp.services.ops.lifetime import Stop, on_signal
from congrasp.services.ops.logs import LogFormat, log, logging_as

if TYPE_CHECKING:
    from congrasp.services.record.recorder import Recorder

_REFRESH_S = 0.5
"""Interval of the displayed summary."""
_CLOSE_TIMEOUT_S = 2.5
"""Longest wait for messages that are not yet written."""


def record(
    connect: str = LEARNER_URL,
    run: str = "quickstart",
    out: pathlib.Path = pathlib.Path("recordings"),
    live: int | None = None,
    duration: float | None = None,
    log_format: LogFormat = "text",
    certs: pathlib.Path | None = None,
) -> int:
    """Record the metrics, events, versions, rollouts and episodes of a run to MCAP, on this or
    another machine.

    Ctrl-C stops the recorder and completes the file. A slow or killed recorder never blocks the
    run. If it is killed, its file is readable except for the last half second.

    Args:
      connect: Endpoint of the learner, such as tcp/10.0.0.5:7447.
      run: Name of the run.
      out: Folder for the MCAP files.
      live: Port of the loopback interface at which the Foxglove app can follow the run live:
        ws://127.0.0.1:PORT.
      duration: Seconds after which the recorder stops; by default it stops on Ctrl-C.
      log_format: Format of log lines: text, or JSON objects with time, level, role, id, run, text
        and fields.
      certs: Folder of an observer's certificate (congrasp certs).

    Examples:
      congrasp record --connect tcp/127.0.0.1:7447 --run human
      congrasp record --run human --out recordings --live 8765
    """
    from congrasp.services.record.live import LiveServer
    from congrasp.services.record.recorder import Recorder

    output = _Output(log_format == "json")
    with contextlib.ExitStack() as stack:
        name = process_name("recorder")
        stack.enter_context(logging_as(log_format, role="recorder", id=name, run=run))
        # Connected before signals are handled: Ctrl-C interrupts the attempts
        transport = stack.enter_context(urls.connect(connect, "observer", certs=certs, run=run))
        stop = stack.enter_context(on_signal())
        sinks = []
        if live is not None:
            server = stack.enter_context(LiveServer(live))
            sinks.append(server)
            output.console.print(f"Live view: open ws://127.0.0.1:{server.port} in Foxglove.")
        recorder = stack.enter_context(
            Recorder(transport, run, out, name="record", sinks=sinks, warn=output.warn)
        )
        transport.declare_alive(Keys(run).alive("recorder", name, secrets.token_hex(4)))
        try:
            with output.console.status(_summary(recorder)) as status:
                _wait(recorder, duration, stop, always=bool(sinks), update=status.update)
        finally:
            recorder.close(_CLOSE_TIMEOUT_S)
            for file in recorder.files:
                output.print_file(file)
            output.console.print(_summary(recorder))
        if recorder.error:
            raise CongraspError(
                recorder.error, "Free space and restart the recorder, which begins a new file."
            )
        if not recorder.messages:
            output.console.print(
                f"No messages from the run '{run}'. Check its name; 'congrasp status' lists its "
                f"processes."
            )
        reason = f"--duration {duration} s is over"
        if stop.is_set():
            reason = stop.reason
        output.print_end(reason)
        return stop.exit_code


class _Output:
    """Messages of the command: text on standard error, or structured log lines."""

    def __init__(self, structured: bool):
        """Opens the console, which prints nothing if the output is structured."""
        self.console = Console(stderr=True, quiet=structured)
        self._structured = structured

    def warn(self, text: str) -> None:
        """Reports a problem of the recording."""
        if self._structured:
            log("warning", text)
        else:
            self.console.print(f"congrasp: {text}", markup=False)

    def print_file(self, file: pathlib.Path) -> None:
        """Reports a written file; as text, its path is printed to standard output."""
        if self._structured:
            log("info", f"Wrote {file}.")
        else:
            print(file)

    def print_end(self, reason: str) -> None:
        """Reports why the recorder ends."""
        text = f"The recorder ends: {reason}."
        if self._structured:
            log("info", text)
        else:
            self.console.print(text)


def _wait(
    recorder: "Recorder",
    duration: float | None,
    stop: Stop,
    *,
    always: bool,
    update: Callable[[str], None],
) -> None:
    """Waits for the end of a recording: its duration, a signal or, unless `always`, an error.

    Args:
      recorder: the recorder.
      duration: longest wait, s; None: no limit.
      stop: set by a signal.
      always: True if the recorder is useful after an error, because it also serves a live view.
      update: shows the summary of the recording.
    """
    end = math.inf if duration is None else time.monotonic() + duration
    while not stop.is_set() and time.monotonic() < end:
        if recorder.error and not always:
            return
        remaining = max(0.0, end - time.monotonic())
        stop.wait(min(_REFRESH_S, remaining))
        update(_summary(recorder))


def _summary(recorder: "Recorder") -> str:
    """Numbers of messages and bytes so far."""
    size = sum(file.stat().st_size for file in recorder.files if file.exists())
    return (
        f"{recorder.messages} messages recorded, {size / 1e6:.1f} MB; "
        f"lost {recorder.dropped}, damaged {recorder.damaged}"
    )


COMMAND = record
