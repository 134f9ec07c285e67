"""Append-only journals of JSON lines, by which what several processes did can be compared afterwards.

Every line is one write to the operating system, so that it survives the death of its process. A line that was cut is
skipped when reading.
"""

import json
import pathlib
import threading
from collections.abc import Callable, Iterator
from typing import Any

from common.errors import CongraspError

AUDIT = "audit"
"""Folder of a run directory where its journals are."""


class Journal:
    """A journal that is being written; safe to use from several threads."""

    def __init__(self, path: pathlib.Path, warn: Callable[[str], None] = lambda text: None):
        """Opens a journal, or goes on with one.

        Args:
          path: the file; its folder is made.
          warn: called with one line when lines cannot be written; the process goes on without them.

        Raises:
          CongraspError: the file cannot be opened.
        """
        self._path, self._warn = path, warn
        self._lock = threading.Lock()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("ab", buffering=0)
        except OSError as error:
            raise CongraspError(f"The journal {path} cannot be opened: {error.strerror}.") from None
        self._corrupted = self._file.tell() > 0  # whoever wrote the last line may have been killed in it
        self._lost = 0

    def write(self, **entry: Any) -> None:
        """Adds a line; one that the disk refuses is counted in the next that it takes, as `lost`."""
        with self._lock:
            lost = {"lost": self._lost} if self._lost else {}
            line = b"\n" * self._corrupted + json.dumps({**entry, **lost}).encode() + b"\n"
            try:
                self._corrupted = self._file.write(line) < len(line)
                reason = "No space left" if self._corrupted else ""
            except OSError as error:
                self._corrupted, reason = True, error.strerror or str(error)
            if reason and not self._lost:
                self._warn(f"{self._path} could not be written ({reason}); what happens meanwhile is not in it.")
            self._lost = self._lost + 1 if reason else 0

    def close(self) -> None:
        """Closes the file."""
        with self._lock:
            self._file.close()


def read_journal(path: pathlib.Path) -> Iterator[dict[str, Any]]:
    """The lines of a journal that are whole; none if there is no such file."""
    if not path.exists():
        return
    with path.open("rb") as file:
        for line in file:
            try:
                entry = json.loads(line)
            except ValueError:
                continue
            if isinstance(entry, dict):
                yield entry
