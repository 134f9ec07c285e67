"""`congrasp record`: a run as MCAP."""

import pathlib

from congrasp.common.transport.ports import LEARNER_URL
from congrasp.services.ops.logs import LogFormat


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
    from congrasp.common.transport.keys import process_name
    from congrasp.services.ops.logs import logging_as
    from congrasp.services.record.process import record_run

    structured = log_format == "json"
    with logging_as(log_format, role="recorder", id=process_name("recorder"), run=run):
        return record_run(connect, run, out, live=live, duration=duration, structured=structured, certs=certs)


COMMAND = record
