"""Opens files for writing in folders where others can plant links.

A new file is created exclusively. An existing one is opened only if it is a regular file with one
name, so that no symbolic link, hard link or pipe leads the data elsewhere.
"""

import contextlib
import errno
import io
import os
import pathlib
import secrets
import stat
from collections.abc import Iterator
from typing import BinaryIO, cast

from congrasp.common.errors import CongraspError
from congrasp.common.io.spelling import check_spelling
from congrasp.common.runtime.platforms import BYTES, NO_FOLLOW, NO_WAIT

_ATTEMPTS = 100
_COMMON = BYTES | NO_FOLLOW


def create_new(path: pathlib.Path, mode: int = 0o666) -> BinaryIO:
    """Creates a file for writing.

    Args:
      path: the file.
      mode: permissions, which the process's umask reduces.

    Raises:
      FileExistsError: the name is taken, be it by a link to nothing.
      OSError: the file cannot be created.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | _COMMON
    return os.fdopen(os.open(path, flags, mode), "wb")


def open_to_append(path: pathlib.Path) -> BinaryIO:
    """Opens a file at its end, without a buffer, and creates it if needed.

    Raises:
      CongraspError: the name belongs to a link or to something else than a file.
      OSError: the file cannot be opened.
    """
    return _open_existing(path, os.O_RDWR | os.O_APPEND | os.O_CREAT)


def open_to_update(path: pathlib.Path) -> BinaryIO:
    """Opens a file at its start, without a buffer, and creates it if needed; its content stays.

    Raises:
      CongraspError: see `open_to_append`.
      OSError: the file cannot be opened.
    """
    return _open_existing(path, os.O_RDWR | os.O_CREAT)


def _open_existing(path: pathlib.Path, flags: int) -> BinaryIO:
    """Opens or creates a regular file that has one name."""
    check_spelling(path)
    try:
        descriptor = os.open(path, flags | _COMMON | NO_WAIT, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise CongraspError(f"{path} is a symbolic link.", "Remove it.") from None
        if error.errno in (errno.ENXIO, errno.EISDIR):
            raise _irregular(path) from None
        raise
    try:
        _check_file(path, os.fstat(descriptor))
    except CongraspError:
        os.close(descriptor)
        raise
    return cast(BinaryIO, io.FileIO(descriptor, "r+"))


def _check_file(path: pathlib.Path, status: os.stat_result) -> None:
    """Raises a CongraspError unless a file is regular and has one name."""
    if stat.S_ISCHR(status.st_mode):  # such as /dev/null, which only an administrator creates
        return
    if not stat.S_ISREG(status.st_mode):
        raise _irregular(path)
    if status.st_nlink > 1:
        raise CongraspError(
            f"{path} is a hard link, so that writing to it would also change another file.",
            "Replace it by a copy.",
        )


def _irregular(path: pathlib.Path) -> CongraspError:
    """Error of a name that belongs to a folder, a pipe or a device."""
    return CongraspError(f"{path} is not a regular file.", "Remove or rename it.")


@contextlib.contextmanager
def temporary_file(
    path: pathlib.Path, suffix: str = ".tmp"
) -> Iterator[tuple[pathlib.Path, BinaryIO]]:
    """Context with a new file of a random name in the folder of `path`.

    At the end the file is closed, and removed unless it was renamed.

    Args:
      path: the file that it will replace.
      suffix: end of its name.

    Yields:
      Its path, and the file; flush it before renaming.

    Raises:
      OSError: it cannot be created.
    """
    temporary, file = _create_random(path, suffix)
    try:
        with file:
            yield temporary, file
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _create_random(path: pathlib.Path, suffix: str) -> tuple[pathlib.Path, BinaryIO]:
    """Creates a file under an unused random name."""
    for _ in range(_ATTEMPTS):
        temporary = path.with_name(random_name(path.name, suffix))
        with contextlib.suppress(FileExistsError):
            return temporary, create_new(temporary)
    raise OSError(errno.EEXIST, "No temporary name is unused", str(path.parent))


def random_name(name: str, suffix: str = ".tmp") -> str:
    """Returns a hidden name that cannot be foreseen; a long one is cut."""
    return f".{name[:120]}.{secrets.token_hex(8)}{suffix}"
