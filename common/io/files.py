"""Atomic file writes, by which a reader finds the old content or the new one; caches of results
between runs.
"""

import contextlib
import functools
import hashlib
import logging
import os
import pathlib
from types import ModuleType
from typing import TYPE_CHECKING

from congrasp.common.errors import CongraspError

if TYPE_CHECKING:  # commands that read no message start without NumPy
    from congrasp.common.wire.codec import Message

_log = logging.getLogger(__name__)


def write_atomically(path: pathlib.Path, data: bytes) -> None:
    """Replaces a file's content atomically: writes a temporary file, flushes it to disk and renames
    it.

    Raises:
      CongraspError: the file cannot be written; earlier content is intact.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        sync_directory(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise CongraspError(
            f"{path} could not be written: {error.strerror}.",
            "Free space or choose another folder. An earlier file of that name is intact.",
        ) from None


def check_free(path: pathlib.Path, *, force: bool = False) -> None:
    """Raises a CongraspError if a command would overwrite a file without --force."""
    if path.exists() and not force:
        raise CongraspError(
            f"{path} exists already.", "Pass another path with --out, or --force to replace it."
        )


def check_output(option: str, path: pathlib.Path, *, is_folder: bool) -> None:
    """Raises a CongraspError if a path can be neither a new file nor a new folder, or is the other
    one of these.
    """
    if path.exists() and path.is_dir() != is_folder:
        found, remedy = (
            ("file", "Pass a folder; it need not exist.")
            if is_folder
            else ("folder", "Pass a file in it.")
        )
        raise CongraspError(f"{option} is the {found} {path}.", remedy)
    places = [path] * is_folder + list(path.absolute().parents)
    parent = next(place for place in places if os.path.lexists(place))
    if not parent.is_dir():
        raise CongraspError(
            f"{option} is {path}, but {parent} is a file or a link to nothing.",
            "Pass another path.",
        )
    if not os.access(parent, os.W_OK | os.X_OK):
        raise CongraspError(
            f"{option} is {path}, but {parent} cannot be written.", "Pass a path in another folder."
        )


def user_folder(variable: str, default: str) -> pathlib.Path:
    """Returns a folder of the user, named by a variable of the XDG specification, or else the
    default in the home.

    Without a home, as for a user id without an entry, it is a folder that does not exist and cannot
    be created.
    """
    try:
        return pathlib.Path(os.environ.get(variable) or pathlib.Path.home() / default)
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
    """Makes renames inside a directory durable across a power failure."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@functools.cache
def source_digest(*packages: ModuleType) -> str:
    """Returns sixteen hex digits of all source and data in these packages; a change invalidates
    cache entries.
    """
    digest = hashlib.sha256()
    for folder in (folder for package in packages for folder in package.__path__):
        for file in sorted(
            file for kind in ("*.py", "*.json") for file in pathlib.Path(folder).rglob(kind)
        ):
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
        for old in files[:-most]:
            old.unlink(missing_ok=True)
