"""Atomic file writes, by which a reader finds the old content or the new one; caches of results
between runs.
"""

import contextlib
import errno
import functools
import hashlib
import logging
import os
import pathlib
from collections.abc import Iterator
from types import ModuleType
from typing import TYPE_CHECKING, BinaryIO

from congrasp.common.errors import CongraspError
from congrasp.common.io.opening import temporary_file
from congrasp.common.io.spelling import check_spelling
from congrasp.common.runtime import platforms

if TYPE_CHECKING:  # commands that read no message start without NumPy
    from congrasp.common.wire.codec import Message

_log = logging.getLogger(__name__)

_NO_SYNC = (
    errno.EINVAL,
    errno.ENOTSUP,
    errno.EOPNOTSUPP,
    errno.ENOSYS,
    errno.EBADF,
    errno.EACCES,
    errno.EPERM,
    errno.EISDIR,
)
"""Errors of file systems that cannot flush a folder: there is nothing more to be done."""


def write_atomically(path: pathlib.Path, data: bytes) -> None:
    """Replaces a file's content atomically: writes a temporary file, flushes it to disk and renames
    it.

    Raises:
      CongraspError: the file cannot be written; earlier content is intact.
    """
    with replacement(path) as file:
        file.write(data)


@contextlib.contextmanager
def replacement(path: pathlib.Path) -> Iterator[BinaryIO]:
    """Context with a new file, which replaces `path` at the end unless an error is raised.

    The file has a random name until then, so that no planted link leads the data elsewhere.

    Args:
      path: the file to replace; its folder is created if needed.

    Yields:
      The file, opened for writing.

    Raises:
      CongraspError: the file cannot be written, and earlier content is intact; or its name and that
        of an existing file differ in case only, on a file system that does not distinguish them.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        check_spelling(path)
        with temporary_file(path) as (temporary, file):
            yield file
            file.flush()
            sync_file(file.fileno())
            file.close()
            platforms.replace(temporary, path)
    except OSError as error:
        raise _unwritten(path, error) from None
    try:
        sync_directory(path.parent)
    except OSError as error:
        raise CongraspError(
            f"{path} was written, but its folder could not be flushed to disk: {error.strerror}.",
            "Check the disk.",
        ) from None


def _unwritten(path: pathlib.Path, error: OSError) -> CongraspError:
    """Returns the error of a file that was not written; it mentions an earlier file if there is
    one.
    """
    remedy = "Free space or choose another folder."
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        remedy = "Choose another folder."
    if os.path.lexists(path):
        remedy += " An earlier file of that name is intact."
    return CongraspError(f"{path} could not be written: {error.strerror}.", remedy)


def check_free(path: pathlib.Path, *, force: bool = False) -> None:
    """Raises a CongraspError if a command would overwrite a file without --force."""
    if path.exists() and not force:
        raise CongraspError(
            f"{path} exists already.", "Pass another path with --out, or --force to replace it."
        )


def check_output(option: str, path: pathlib.Path, *, is_folder: bool) -> None:
    """Raises a CongraspError if an output cannot be created, or exists with the wrong type.

    Args:
      option: the command's option, for the message.
      path: path of the output.
      is_folder: True for an output folder, False for an output file.
    """
    if is_folder and path.exists() and not path.is_dir():
        raise CongraspError(
            f"{option} is the file {path}.", "Pass a folder, which need not exist yet."
        )
    if not is_folder and path.is_dir():
        raise CongraspError(f"{option} is the folder {path}.", "Pass a file, such as one in it.")
    folders = list(path.absolute().parents)
    if is_folder:
        folders.insert(0, path)
    parent = next(folder for folder in folders if os.path.lexists(folder))
    if not parent.is_dir():
        raise CongraspError(
            f"{option} is {path}, but {parent} is a file or a broken link.",
            "Pass another path.",
        )
    if not os.access(parent, os.W_OK | os.X_OK):
        raise CongraspError(
            f"{option} is {path}, but {parent} cannot be written.", "Pass a path in another folder."
        )


def user_folder(variable: str, default: str) -> pathlib.Path:
    """Returns a folder of the user, named by a variable of the XDG specification, or else the
    default in the home.

    A relative path in the variable is ignored, as the specification says. Without a home, as for a
    user id without an entry, it is a folder that does not exist and cannot be created.
    """
    try:
        folder = pathlib.Path(os.environ.get(variable, "")).expanduser()
        if folder.is_absolute():
            return folder
        return pathlib.Path.home() / default
    except RuntimeError:
        return pathlib.Path(os.devnull, default)


def cache_folder(name: str) -> pathlib.Path:
    """Returns the user's cache folder for one subject; `XDG_CACHE_HOME` overrides the parent
    folder.

    It may be read-only or absent: the first call then logs that, and writers must ignore it.
    """
    folder = user_folder("XDG_CACHE_HOME", ".cache") / "congrasp"
    can_cache(folder, "XDG_CACHE_HOME")
    return folder / name


@functools.cache
def can_cache(folder: pathlib.Path, setting: str) -> bool:
    """True if files can be written to a cache; otherwise the first call logs why, and the setting
    that moves it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        check_output("the cache", folder, is_folder=True)
    except (OSError, CongraspError):
        _log.warning(
            "Nothing can be cached in %s, so that it is computed again each time. Set %s.",
            folder,
            setting,
        )
        return False
    return True


def sync_directory(path: pathlib.Path) -> None:
    """Makes renames inside a directory durable across a power failure, where its file system can.

    Raises:
      OSError: the disk failed.
    """
    if not platforms.HAS_FOLDER_FLUSH:
        return
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except OSError as error:
        if error.errno in _NO_SYNC:
            return
        raise
    try:
        sync_file(descriptor)
    finally:
        os.close(descriptor)


def sync_file(descriptor: int) -> None:
    """Flushes an open file or folder to disk, where its file system can.

    Raises:
      OSError: the disk failed.
    """
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _NO_SYNC:
            raise


@functools.cache
def source_digest(*packages: ModuleType) -> str:
    """Returns sixteen hex digits of all source and data in these packages; a change invalidates
    cache entries.
    """
    digest = hashlib.sha256()
    for package in packages:
        for folder in map(pathlib.Path, package.__path__):
            for file in sorted([*folder.rglob("*.py"), *folder.rglob("*.json")]):
                digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def read_kept(path: pathlib.Path) -> "Message | None":
    """Reads a cached message if it exists and is intact, and marks it as used now."""
    from congrasp.common.wire.codec import decode

    try:
        message = decode(path.read_bytes(), max_bytes=path.stat().st_size)
        os.utime(path)
    except (OSError, CongraspError):
        return None
    return message


def keep(path: pathlib.Path, message: "Message", most: int) -> None:
    """Writes a message to the cache, and removes all but the `most` last used files of its folder.

    A full disk or a folder without write permission is ignored: the next run recomputes the entry.
    """
    from congrasp.common.wire.codec import encode

    with contextlib.suppress(CongraspError, OSError):
        write_atomically(path, encode(message))
        files = sorted(path.parent.glob(f"*{path.suffix}"), key=lambda file: file.stat().st_mtime)
        for unused in files[:-most]:
            unused.unlink(missing_ok=True)
