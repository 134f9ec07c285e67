"""Claims of folders by processes, for file systems without locks."""

import json
import os
import pathlib
import socket

import psutil

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import parse_json, read_file
from congrasp.common.io.opening import create_new, random_name
from congrasp.common.runtime import platforms

_LARGEST = 1 << 12
_CLOCK = 2.0  # seconds by which two readings of a process's start may differ


class Claim:
    """A file that says which process uses a folder, for file systems without locks.

    It is created exclusively, and remains after a kill. The next process on the same machine then
    replaces it; from another machine nothing shows whether its owner still runs.
    """

    def __init__(self, path: pathlib.Path):
        """Creates the file.

        Args:
          path: the file.

        Raises:
          CongraspError: another process may use the folder, or the file cannot be created.
        """
        self._path = path
        self._text = json.dumps(_identity(os.getpid())).encode()
        if not self._create():
            self._remove_stale()
            if not self._create():
                raise self._in_use("another process")

    def check(self) -> None:
        """Creates the file again if it was removed.

        Raises:
          CongraspError: another process may use the folder now.
        """
        try:
            text = read_file(self._path, _LARGEST)
        except CongraspError:
            text = b""
        if text != self._text and not self._create():
            raise self._in_use("another process")

    def close(self) -> None:
        """Removes the file, unless another process has replaced it."""
        try:
            if read_file(self._path, _LARGEST) == self._text:
                self._path.unlink()
        except (OSError, CongraspError):
            return

    def _create(self) -> bool:
        """Creates the file; returns False if it exists."""
        try:
            with create_new(self._path) as file:
                file.write(self._text)
        except FileExistsError:
            return False
        except OSError as error:
            raise CongraspError(
                f"{self._path} could not be written: {error.strerror}.",
                "Choose a folder on another file system.",
            ) from None
        return True

    def _remove_stale(self) -> None:
        """Removes the file of a process of this machine that has ended.

        Raises:
          CongraspError: its process runs, or may run.
        """
        try:
            text = read_file(self._path, _LARGEST)
            owner = parse_json(text, str(self._path))
        except CongraspError:
            raise self._in_use("another process") from None
        if not isinstance(owner, dict) or owner.get("host") != socket.gethostname():
            raise self._in_use(_described(owner))
        process = owner.get("process")
        if not isinstance(process, int) or _is_running(owner, process):
            raise self._in_use(_described(owner))
        self._take_away(text)

    def _take_away(self, text: bytes) -> None:
        """Removes the file if it still has this text: another process may replace it meanwhile."""
        aside = self._path.with_name(random_name(self._path.name))
        try:
            platforms.replace(self._path, aside)
            if read_file(aside, _LARGEST) == text:
                aside.unlink()
            else:
                platforms.replace(aside, self._path)
        except (OSError, CongraspError):
            raise self._in_use("another process") from None

    def _in_use(self, owner: str) -> CongraspError:
        """Error of a claim of another process."""
        return CongraspError(
            f"{self._path.parent} is in use by {owner}, according to {self._path.name} (its file "
            f"system has no locks).",
            f"Stop that process. If it has ended, remove {self._path}.",
        )


def _identity(process: int) -> dict[str, object]:
    """Machine, id and start of a process."""
    started = psutil.Process(process).create_time()
    return {"host": socket.gethostname(), "process": process, "started": started}


def _is_running(owner: dict[str, object], process: int) -> bool:
    """True if the process of a claim runs, and its id was not given to a later one."""
    if process == os.getpid():
        return False
    started = owner.get("started")
    try:
        begun = psutil.Process(process).create_time()
    except psutil.NoSuchProcess:
        return False
    except psutil.Error:
        return True
    return not isinstance(started, float) or abs(begun - started) < _CLOCK


def _described(owner: object) -> str:
    """A claim's process in words."""
    if not isinstance(owner, dict):
        return "another process"
    return f"process {owner.get('process')!r} on {owner.get('host')!r}"
