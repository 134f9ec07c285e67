"""`congrasp record`: a run as MCAP."""

import contextlib
import functools
import pathlib
import secrets
import time

from rich.console import Console

from congrasp.common.errors import CongraspError
from congrasp.common.transport import urls
from congrasp.common.transport.keys import Keys, process_name
from congrasp.common.transport.ports import LEARNER_URL
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
    """Record a run to MCAP, from this machine or another: metrics, events, versions, rollouts and episodes.

    Ctrl-C ends it and finishes the file. A slow or killed recorder never blocks the run, and its file is readable up to
    the last half second.

    Args:
      connect: The learner's endpoint, such as tcp/10.0.0.5:7447.
      run: Name of the run.
      out: Folder for the MCAP files.
      live: Also serve everything to the Foxglove app on this port of the loopback interface: ws://127.0.0.1:PORT.
      duration: Seconds after which to stop; by default on Ctrl-C.
      log_format: Text, or one JSON object per line: time, level, role, id, run, text, fields.
      certs: Folder of an observer's certificate (congrasp certs).

    Examples:
      congrasp record --connect tcp/127.0.0.1:7447 --run human
      congrasp record --run human --out recordings --live 8765
    """
    structured = log_format == "json"
    with logging_as(log_format, role="recorder", id=process_name("recorder"), run=run):
        return record_run(connect, run, out, live=live, duration=duration, structured=structured, certs=certs)


COMMAND = record


def record_run(
    connect: str,
    run: str,
    out: pathlib.Path,
    *,
    live: int | None = None,
    duration: float | None = None,
    structured: bool = False,
    certs: urls.Certs = None,
) -> int:
    """Records until `duration` seconds have passed, Ctrl-C is pressed or, without a live view, the disk fails.

    Args:
      connect: endpoint of the learner.
      run: name of the run.
      out: folder for the files.
      live: port of the live view, or None.
      duration: seconds, or None.
      structured: writes only to the log, without a progress line.
      certs: folder of an observer's certificate, or None.

    Returns:
      Zero.

    Raises:
      CongraspError: there is no connection, the live view cannot listen, or recording stopped.
    """
    console = Console(stderr=True, quiet=structured)
    warn = functools.partial(log, "warning") if structured else lambda text: console.print(f"congrasp: {text}")
    end = time.monotonic() + duration if duration is not None else None
    with contextlib.ExitStack() as stack:
        transport = stack.enter_context(urls.connect(connect, "observer", certs=certs, run=run))
        server = stack.enter_context(LiveServer(live)) if live is not None else None
        if server is not None:
            console.print(f"Live view: open ws://127.0.0.1:{server.port} in Foxglove.")
        sinks = [server] if server else []
        recorder = stack.enter_context(Recorder(transport, run, out, name="record", sinks=sinks, warn=warn))
        transport.declare_alive(Keys(run).alive("recorder", process_name("recorder"), secrets.token_hex(4)))
        try:
            with console.status(_state(recorder)) as status:
                while (end is None or time.monotonic() < end) and (server is not None or not recorder.error):
                    time.sleep(_REFRESH if end is None else max(0.0, min(_REFRESH, end - time.monotonic())))
                    status.update(_state(recorder))
        finally:
            recorder.close(_CLOSE)
            for file in recorder.files:
                if structured:
                    log("info", f"Wrote {file}.")
                else:
                    print(file)
            console.print(_state(recorder))
    if recorder.error:
        raise CongraspError(recorder.error, "Free space and restart the recorder, which begins a new file.")
    if not recorder.messages:
        console.print(f"No messages from the run '{run}'. Check its name; 'congrasp status' lists its processes.")
    return 0


def _state(recorder: Recorder) -> str:
    """Summary of the recording so far."""
    size = sum(file.stat().st_size for file in recorder.files if file.exists())
    return (
        f"{recorder.messages} messages recorded, {size / 1e6:.1f} MB; "
        f"lost {recorder.dropped}, damaged {recorder.damaged}"
    )
