"""Note of a journal's last line in a small file next to it, by which a journal without its end is
recognised.

The file is overwritten in place after each line, which needs no space on a full disk. A process
that is killed between the two leaves a note of the line before the last.
"""

import contextlib
import pathlib
import re
from typing import NamedTuple

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import read_file
from congrasp.common.io.opening import open_to_update

SUFFIX = ".end"
"""Suffix of the note's name, after that of the journal."""
_FORM = "{after:8s} {check:8s}\n"
_PATTERN = re.compile(rb"([0-9a-f]{8}| {8}) ([0-9a-f]{8})\n")
_LARGEST = 1 << 10


class JournalEnd(NamedTuple):
    """The last line that was written, by checksums."""

    after: str
    """Checksum of the line before it; empty for the first line."""
    check: str
    """Checksum of the line."""


def read_end(journal: pathlib.Path) -> JournalEnd | None:
    """Reads the note of a journal; None if there is none, as in older versions of congrasp."""
    try:
        text = read_file(_path(journal), _LARGEST)
    except CongraspError:
        return None
    match = _PATTERN.fullmatch(text)
    if match is None:
        return None
    return JournalEnd(match[1].decode().strip(), match[2].decode())


class EndWriter:
    """Writes the note of one journal; not thread-safe."""

    def __init__(self, journal: pathlib.Path):
        """Opens the note, and creates it if needed.

        Raises:
          CongraspError: the name belongs to a link.
          OSError: it cannot be opened.
        """
        self._file = open_to_update(_path(journal))

    def write(self, end: JournalEnd) -> None:
        """Replaces the note; on a disk that fails, the old one remains."""
        with contextlib.suppress(OSError):
            self._file.seek(0)
            self._file.write(_FORM.format(after=end.after, check=end.check).encode())

    def close(self) -> None:
        """Closes the file."""
        self._file.close()


def _path(journal: pathlib.Path) -> pathlib.Path:
    return journal.with_name(journal.name + SUFFIX)
