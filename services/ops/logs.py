"""Logs of a role: lines for people, or one JSON object a line for a log collector."""

import contextlib
import datetime
import json
import logging
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from typing import Any, Literal

LogFormat = Literal["text", "json"]
_logger = logging.getLogger("congrasp")


class JsonLines(logging.Formatter):
    """Records as JSON: time (ISO 8601, UTC), level, role, id, run, text, and the fields that go with the text."""

    def __init__(self, **who: str):
        """The entries `who` are in every line."""
        super().__init__()
        self._who = who

    def format(self, record: logging.LogRecord) -> str:
        """One line."""
        entry: dict[str, Any] = {
            "time": datetime.datetime.fromtimestamp(record.created, datetime.UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            **self._who,
            "text": record.getMessage(),
        }
        if record.exc_info:
            entry["trace"] = self.formatException(record.exc_info)
        return json.dumps(entry | {"fields": getattr(record, "fields", {})})


class Lines(logging.Formatter):
    """Records as `level: text`, with the fields left out."""

    def format(self, record: logging.LogRecord) -> str:
        """One line, and the trace of an error in others."""
        record.levelname = record.levelname.lower()
        return super().format(record)


@contextlib.contextmanager
def logging_as(form: LogFormat, *, role: str, id: str, run: str) -> Iterator[None]:
    """Writes the log of this process to the standard output while the block runs, libraries' warnings among it.

    A full disk under the output costs the lines, and not the process.
    """
    root, handler = logging.getLogger(), logging.StreamHandler(sys.stdout)
    handler.setFormatter(
        JsonLines(role=role, id=id, run=run) if form == "json" else Lines("%(levelname)s: %(message)s")
    )
    handler.handleError = lambda record: None  # type: ignore[method-assign]
    root.addHandler(handler)
    _logger.setLevel(logging.INFO)
    yield
    # After an exception the handler stays: `log_error` may still write why.
    root.removeHandler(handler)


def log(level: str, text: str, fields: Mapping[str, float] | None = None) -> None:
    """Writes a line; levels: info, warning, error, fatal. Numbers that are not finite are left out of the fields."""
    finite = {name: value for name, value in (fields or {}).items() if abs(value) < float("inf")}
    _logger.log(logging.getLevelNamesMapping()[level.upper()], text, extra={"fields": finite})


@contextlib.contextmanager
def announced(what: str, first: float = 3.0, every: float = 10.0) -> Iterator[None]:
    """Prints what takes long, and for how long already, after `first` and then every `every` seconds (to stderr)."""
    done, began = threading.Event(), time.monotonic()

    def tell() -> None:
        """Prints until it is done."""
        pause = first
        while not done.wait(pause):
            print(f"{what}: {time.monotonic() - began:.0f} s so far.", file=sys.stderr, flush=True)
            pause = every

    threading.Thread(target=tell, daemon=True, name="announced").start()
    try:
        yield
    finally:
        done.set()


def log_error(text: str) -> bool:
    """Writes why the process ends if its lines are JSON; whether they are."""
    structured = any(isinstance(handler.formatter, JsonLines) for handler in logging.getLogger().handlers)
    if structured:
        log("error", text)
    return structured
