"""Append-only journals of JSON lines, for comparing afterwards what several processes did.

Every line is one write to the operating system, so that it survives the death of its process. It
ends with two checksums (CRC-32): that of the previous line, as the field `after`, and that of its
own preceding text, as the field `crc32`. A note of the last line (`journal_end`) lies next to the
journal. Lines that were cut or changed are skipped when reading, and counted, as are places where
lines are missing, be it at the end.
"""

import contextlib
import json
import pathlib
import re
import shutil
import threading
import time
import zlib
from collections.abc import Callable
from typing import Any, NamedTuple

from congrasp.common.errors import CongraspError, os_errors_as
from congrasp.common.io.files import user_folder
from congrasp.common.io.inputs import file_name, open_file
from congrasp.common.io.journal_end import EndWriter, JournalEnd, read_end
from congrasp.common.io.opening import open_to_append

AUDIT = "audit"
"""Folder of the journals in a run directory."""
MAX_NUMBER = 1 << 53
"""Exclusive bound of the integers in a journal, since JSON readers do not represent larger ones
exactly.
"""
_MAX_UNUSED_S = 30 * 86400.0
"""Time after which a journal in the user's folder is removed, since its last line."""
_CHECK = ', "crc32": "{}"}}\n'
_CHECK_BYTES = len(_CHECK.format("00000000"))
_CHECK_PATTERN = re.compile(_CHECK.format("([0-9a-f]{8})").encode())
_MAX_LINE_BYTES = 1 << 22


class Journal:
    """A journal opened for writing; thread-safe."""

    def __init__(self, path: pathlib.Path, warn: Callable[[str], None] = lambda text: None):
        """Opens a journal, appending to an existing file.

        Args:
          path: the file; its folder is created if needed.
          warn: called with one line when lines cannot be written; the process continues without
            them.

        Raises:
          CongraspError: the file cannot be opened.
        """
        self._path = path
        self._warn = warn
        self._lock = threading.Lock()
        with os_errors_as(f"The journal {path} cannot be opened"):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._cut, self._after = _end_of(path)
            self._file = open_to_append(path)
            self._end = EndWriter(path)
        self._lost = int(self._cut)
        self._refused = False

    def write(self, **entry: Any) -> None:
        """Appends a line; lines that the disk refuses are counted in the next written one, as
        `lost`.
        """
        with self._lock:
            lost = {"lost": self._lost} if self._lost else {}
            text, check = _line({**entry, **lost, "after": self._after})
            line = b"\n" * self._cut + text
            try:
                self._cut = self._file.write(line) < len(line)
                reason = "No space left" if self._cut else ""
            except OSError as error:
                self._cut = True
                reason = error.strerror or str(error)
            if reason and not self._refused:
                self._warn(
                    f"{self._path} could not be written ({reason}); what happens meanwhile is not "
                    f"in it."
                )
            if not reason:
                self._end.write(JournalEnd(self._after, check))
                self._after = check
            self._refused = bool(reason)
            self._lost = self._lost + 1 if reason else 0

    def close(self) -> None:
        """Closes the file."""
        with self._lock:
            self._file.close()
            self._end.close()


def user_journals(run_id: str) -> pathlib.Path:
    """Folder of the journals that actors of this user write on this machine for a run."""
    state = user_folder("XDG_STATE_HOME", ".local/state")
    return state / "congrasp" / AUDIT / file_name(run_id, "a run")


def user_journal(
    run_id: str, actor: str, warn: Callable[[str], None] = lambda text: None
) -> Journal | None:
    """Opens an actor's journal in the user's folder, and removes those of runs that have not been
    written for 30 days.

    Args:
      run_id: identifies the training.
      actor: name of the actor.
      warn: called with one line when the journal or a line of it cannot be written.

    Returns:
      The journal; None if it cannot be opened, for instance without a home.
    """
    folder = user_journals(run_id)
    try:
        journal = Journal(folder / f"{file_name(actor, 'an actor')}.jsonl", warn)
    except CongraspError as error:
        warn(f"{error} This actor writes no journal; set XDG_STATE_HOME, or pass --audit FILE.")
        return None
    with contextlib.suppress(OSError):
        _remove_old(folder.parent)
    return journal


def _remove_old(folder: pathlib.Path) -> None:
    """Removes the folders of runs whose journals have not been written for `_MAX_UNUSED_S`."""
    oldest = time.time() - _MAX_UNUSED_S
    for run in folder.iterdir():
        if run.is_symlink() or not run.is_dir():
            continue
        written = [path.stat().st_mtime for path in run.iterdir()]
        if max(written, default=run.stat().st_mtime) < oldest:
            shutil.rmtree(run, ignore_errors=True)


class JournalLines(NamedTuple):
    """Content of a journal."""

    entries: list[dict[str, Any] | None]
    """Intact lines in order; None marks damaged ones."""
    lost: int
    """Lines that are missing because the disk was full, or that were cut at the end."""
    damaged: int
    """Lines that were changed after they were written."""
    missing: int
    """Places where written lines are missing."""
    unchecked: int
    """Lines of older versions of congrasp, which lack the checksum of the previous line."""

    @property
    def intact(self) -> list[dict[str, Any]]:
        """The intact lines."""
        return [entry for entry in self.entries if entry is not None]


def read_journal(
    path: pathlib.Path, is_entry: Callable[[dict[str, Any]], bool] = lambda entry: True
) -> JournalLines:
    """Reads a journal of arbitrary content.

    Args:
      path: the file.
      is_entry: predicate for valid lines of this kind of journal; others count as damaged.

    Raises:
      CongraspError: the file cannot be read.
    """
    entries: list[dict[str, Any] | None] = []
    lost = damaged = missing = unchecked = 0
    damaged_run = 0  # damaged lines since the last intact one
    before = ""
    cut = False
    end = read_end(path)  # first, since a running process writes more lines meanwhile
    checks = set[str]()
    with os_errors_as(f"The journal {path} cannot be read"), open_file(path) as file:
        while line := file.readline(_MAX_LINE_BYTES):
            if not line.strip(b"\n"):
                continue
            cut = not line.endswith(b"\n")
            entry, check = _parse(line)
            if entry is None or not is_entry(entry):
                damaged_run += 1
                entries.append(None)
                continue
            after = entry.pop("after", None)
            unchecked += after is None
            if after not in (None, before) and not damaged_run:
                missing += 1
                entries.append(None)
            before = check
            checks.add(check)
            # The disk took a part of the first line that it refused: `lost` counts that one, too.
            refused = min(number(entry.pop("lost", 0)), MAX_NUMBER)
            lost += refused
            damaged += max(0, damaged_run - bool(refused))
            damaged_run = 0
            entries.append(entry)
    cut = cut and damaged_run > 0
    missing += not entries or _lacks_end(end, checks, is_cut=cut)
    return JournalLines(
        entries=entries,
        lost=lost + cut,
        damaged=damaged + damaged_run - cut,
        missing=missing,
        unchecked=unchecked,
    )


def _lacks_end(end: JournalEnd | None, checks: set[str], *, is_cut: bool) -> bool:
    """True if the last line that was written is missing; one that is cut counts as lost instead."""
    if end is None or end.check in checks:
        return False
    return not (is_cut and (end.after in checks or not end.after))


def number(value: Any) -> int:
    """Returns the value if it is a count, else 0."""
    return value if type(value) is int and 0 <= value < MAX_NUMBER else 0


def has_fields(entry: dict[str, Any], **types: type) -> bool:
    """True if an entry has these fields with these types; integers only below `MAX_NUMBER`."""
    return all(is_value(entry.get(name), kind) for name, kind in types.items())


def is_rows(value: Any, *types: type) -> bool:
    """True if a value is a list of rows whose columns have these types."""
    return isinstance(value, list) and all(_is_row(row, types) for row in value)


def _is_row(value: Any, types: tuple[type, ...]) -> bool:
    """True if a value is a list of one value of each type."""
    if not isinstance(value, list) or len(value) != len(types):
        return False
    return all(map(is_value, value, types))


def is_value(value: Any, kind: type) -> bool:
    """True if a value of a JSON line has the type; integers only below `MAX_NUMBER`."""
    return type(value) is kind and not (isinstance(value, int) and abs(value) >= MAX_NUMBER)


def _end_of(path: pathlib.Path) -> tuple[bool, str]:
    """True if a journal ends within a line (its writer was killed in it, or the disk took a part of
    it), and the checksum of its last line; empty if there is none."""
    if not path.exists():
        return False, _continued("", {""}, read_end(path))
    last = ""
    is_cut = False
    checks = set[str]()
    with open_file(path) as file:
        while line := file.readline(_MAX_LINE_BYTES):
            is_cut = not line.endswith(b"\n")
            check = _CHECK_PATTERN.fullmatch(line[-_CHECK_BYTES:])
            if is_cut or check is None:
                continue
            last = check[1].decode()
            checks.add(last)
    noted = read_end(path)
    if is_cut:
        if _lacks_end(noted, checks, is_cut=True):
            return True, _continued("", checks, noted)
        return True, ""
    return False, _continued(last, checks, noted)


def _continued(last: str, checks: set[str], noted: JournalEnd | None) -> str:
    """Checksum that the next line follows: that of the noted line if it was removed from the end.

    The reader then sees that lines are missing.

    Args:
      last: checksum of the last line.
      checks: checksums of all lines.
      noted: the note, if there is one.
    """
    if noted is None or noted.check in checks:
        return last
    return noted.check


def _line(entry: dict[str, Any]) -> tuple[bytes, str]:
    """A line, and its checksum."""
    text = json.dumps(entry)[:-1]
    check = f"{zlib.crc32(text.encode()):08x}"
    return (text + _CHECK.format(check)).encode(), check


def _parse(line: bytes) -> tuple[dict[str, Any] | None, str]:
    """Entry of a line, None if it is invalid or its checksum differs, and the checksum of the
    line's text.
    """
    check = f"{zlib.crc32(line[:-_CHECK_BYTES]):08x}"
    try:
        entry = json.loads(line)
    except (ValueError, RecursionError):
        return None, check
    is_intact = line.endswith(_CHECK.format(check).encode())
    if not is_intact or not isinstance(entry, dict) or not entry.pop("crc32", None):
        return None, check
    return entry, check
