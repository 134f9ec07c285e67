"""Monitoring of a role: its log, in lines for users or one JSON object per line, and its
metrics.
"""

import contextlib
import dataclasses
import datetime
import json
import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal

from congrasp.common.errors import printable

LogFormat = Literal["text", "json"]
_logger = logging.getLogger("congrasp")


class JsonLines(logging.Formatter):
    """Records as JSON: time (ISO 8601, UTC), level, role, id, run, text, and additional fields."""

    def __init__(self, **process: str):
        """Adds the entries `process` (role, id, run) to every line."""
        super().__init__()
        self._process = process

    def format(self, record: logging.LogRecord) -> str:
        """Returns one line."""
        entry: dict[str, Any] = {
            "time": datetime.datetime.fromtimestamp(record.created, datetime.UTC).isoformat(
                timespec="milliseconds"
            ),
            "level": record.levelname.lower(),
            **self._process,
            "text": record.getMessage(),
        }
        if record.exc_info:
            entry["trace"] = self.formatException(record.exc_info)
        return json.dumps(entry | {"fields": getattr(record, "fields", {})})


class Lines(logging.Formatter):
    """Records as `level: text`, without the fields."""

    def format(self, record: logging.LogRecord) -> str:
        """Returns one line, followed by the trace of an error."""
        record.levelname = record.levelname.lower()
        record.msg = printable(record.getMessage())
        record.args = ()
        return super().format(record)


@contextlib.contextmanager
def logging_as(form: LogFormat, *, role: str, id: str, run: str) -> Iterator[None]:
    """Context that writes the log of this process to standard output, including warnings of
    libraries.

    A full disk loses lines, but does not end the process. After an exception a JSON log continues
    until `log_error`, for the lines of outer contexts.

    Args:
      form: text or JSON.
      role: role of the process.
      id: its name.
      run: name of its run.
    """
    root = logging.getLogger()
    handler = logging.StreamHandler(sys.stdout)
    formatter: logging.Formatter = Lines("%(levelname)s: %(message)s")
    if form == "json":
        formatter = JsonLines(role=role, id=id, run=run)
    handler.setFormatter(formatter)
    # By default a line that cannot be written prints a trace to stderr.
    handler.handleError = lambda record: None  # type: ignore[method-assign]
    root.addHandler(handler)
    _logger.setLevel(logging.INFO)
    with contextlib.ExitStack() as ending:
        ending.callback(root.removeHandler, handler)
        try:
            yield
        except Exception:
            if form == "json":
                ending.pop_all()  # keeps the handler
            raise


@dataclasses.dataclass(frozen=True)
class MonitoringOptions:
    """Options for monitoring a role; the string under a field is its help on the command line."""

    log_format: LogFormat = "text"
    """Lines of text, or one JSON object a line: time, level, role, id, run, text, fields."""
    metrics_port: int = 0
    """Port of a Prometheus endpoint, http://HOST:PORT/metrics; 0 for none."""
    metrics_host: str = "127.0.0.1"
    """Interface of the Prometheus endpoint. It has no authentication."""

    @contextlib.contextmanager
    def monitor(self, role: str, id: str, run: str, collector: Any) -> Iterator[None]:
        """Logs and, if a port is set, serves the collector's metrics while the block runs."""
        with logging_as(self.log_format, role=role, id=id, run=run), self.serve_metrics(collector):
            yield

    def serve_metrics(self, collector: Any) -> contextlib.AbstractContextManager[None]:
        """Context that serves a collector's metrics, if a port is set."""
        if not self.metrics_port:
            return contextlib.nullcontext()
        from congrasp.services.ops.metrics_endpoint import serve_metrics

        return serve_metrics(self.metrics_port, self.metrics_host, collector)


def log(level: str, text: str, fields: Mapping[str, float] | None = None) -> None:
    """Writes a line; levels: info, warning, error, fatal. Numbers that are not finite are dropped
    from the fields.
    """
    finite = {name: value for name, value in (fields or {}).items() if abs(value) < float("inf")}
    _logger.log(logging.getLevelNamesMapping()[level.upper()], text, extra={"fields": finite})


@contextlib.contextmanager
def announce_progress(
    what: str | Callable[[], str], first: float = 3.0, every: float = 10.0
) -> Iterator[None]:
    """Context that prints a task and its elapsed time to stderr, after `first` and then every
    `every` seconds.

    Args:
      what: name of the task, or a function that returns its current name.
      first: seconds until the first line.
      every: seconds between two lines.
    """
    done = threading.Event()
    start = time.monotonic()

    def print_lines() -> None:
        """Prints lines until the context ends."""
        pause_s = first
        while not done.wait(pause_s):
            task = what if isinstance(what, str) else what()
            print(f"{task}: {time.monotonic() - start:.0f} s so far.", file=sys.stderr, flush=True)
            pause_s = every

    threading.Thread(target=print_lines, daemon=True, name="progress").start()
    try:
        yield
    finally:
        done.set()


def log_error(text: str) -> bool:
    """Writes the error that ended a JSON log as its last line; returns False if there is no such
    log.
    """
    root = logging.getLogger()
    handlers = [handler for handler in root.handlers if isinstance(handler.formatter, JsonLines)]
    if handlers:
        log("error", text)
    for handler in handlers:
        root.removeHandler(handler)
    return bool(handlers)
