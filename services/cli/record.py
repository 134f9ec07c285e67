"""`congrasp record`: a run as MCAP."""

import contextlib
import math
import pathlib
import secrets
import time
from collections.abc import Callable

from rich.console import Console

from congrasp.common.errors import CongraspError
from congrasp.common.transport import urls
from congrasp.common.transport.keys import Keys, process_name
from congrasp.common.transport.ports import LEARNER_URL
from congrasp.services.ops.lifetime import Stop, on_signal
from congrasp.services.ops.logs import LogFormat, log, logging_as
from congrasp.services.record.live import LiveServer
from congrasp.services.record.recorder import Recorder

_REFRESH, _CLOSE = 0.5, 2.5  # seconds


def record(
    connect: str = LEARNER_URL,
    run: str = "quickstart",
    out: pathlib.Path = pathlib.Path("recordings"),
    live: int | None = None,
    duration: float | None = None,
    log_format: LogFormat = "text",
    certs: pathlib.Path | None = None,
) -> int:
    """Record a run to MCAP, from this machine or another: metrics, events, versions, rollouts and
    episodes.

    Ctrl-C ends it and finishes the file. A slow or killed recorder never blocks the run, and its
    file is readable up to the last half second.

    Args:
      connect: The learner's endpoint, such as tcp/10.0.0.5:7447.
      run: Name of the run.
      out: Folder for the MCAP files.
      live: Also serve everything to the Foxglove app on this port of the loopback interface:
        ws://127.0.0.1:PORT.
      duration: Seconds after which to stop; by default on Ctrl-C.
      log_format: Text, or one JSON object per line: time, level, role, id, run, text, fields.
      certs: Folder of an observer's certificate (congrasp certs).

    Examples:
      congrasp record --connect tcp/127.0.0.1:7447 --run human
      congrasp record --run human --out recordings --live 8765
    """
    structured = log_format == "json"
    console = Console(stderr=True, quiet=structured)

    def warn(text: str) -> None:
        """Reports a problem of the recording."""
        if structured:
            log("warning", text)
        else:
            console.print(f"congrasp: {text}", markup=False)

    with contextlib.ExitStack() as stack:
        name = process_name("recorder")
        stack.enter_context(logging_as(log_format, role="recorder", id=name, run=run))
        # Ctrl-C interrupts the connection attempts
        transport = stack.enter_context(urls.connect(connect, "observer", certs=certs, run=run))
        stop = stack.enter_context(on_signal())
        sinks = [] if live is None else [stack.enter_context(LiveServer(live))]
        for server in sinks:
            console.print(f"Live view: open ws://127.0.0.1:{server.port} in Foxglove.")
        recorder = stack.enter_context(
            Recorder(transport, run, out, name="record", sinks=sinks, warn=warn)
        )
        transport.declare_alive(Keys(run).alive("recorder", name, secrets.token_hex(4)))
        try:
            with console.status(_state(recorder)) as status:
                _wait(recorder, duration, stop, always=bool(sinks), update=status.update)
        finally:
            recorder.close(_CLOSE)
            for file in recorder.files:
                if structured:
                    log("info", f"Wrote {file}.")
                else:
                    print(file)
            console.print(_state(recorder))
        if recorder.error:
            raise CongraspError(
                recorder.error, "Free space and restart the recorder, which begins a new file."
            )
        if not recorder.messages:
            console.print(
                f"No messages from the run '{run}'. Check its name; 'congrasp status' lists its "
                f"processes."
            )
        reason = stop.reason if stop.is_set() else f"--duration {duration} s is over"
        if structured:
            log("info", f"The recorder ends: {reason}.")
        else:
            console.print(f"The recorder ends: {reason}.")
        return stop.exit_code


def _wait(
    recorder: Recorder,
    duration: float | None,
    stop: Stop,
    *,
    always: bool,
    update: Callable[[str], None],
) -> None:
    """Waits for the end of a recording: its duration, a signal or, unless `always`, an error."""
    end = math.inf if duration is None else time.monotonic() + duration
    while not stop.is_set() and time.monotonic() < end:
        if recorder.error and not always:
            return
        stop.wait(max(0.0, min(_REFRESH, end - time.monotonic())))
        update(_state(recorder))


def _state(recorder: Recorder) -> str:
    """Summary of the recording so far."""
    size = sum(file.stat().st_size for file in recorder.files if file.exists())
    return (
        f"{recorder.messages} messages recorded, {size / 1e6:.1f} MB; "
        f"lost {recorder.dropped}, damaged {recorder.damaged}"
    )


COMMAND = record
