"""Atomic file writes: a reader finds the old content or the new one."""

import contextlib
import os
import pathlib

from congrasp.common.errors import CongraspError


def write_atomically(path: pathlib.Path, data: bytes) -> None:
    """Replaces a file's content atomically: writes a temporary file, flushes it to disk and renames it.

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
        raise CongraspError(f"{path} exists already.", "Pass another path with --out, or --force to replace it.")


def cache_folder(name: str) -> pathlib.Path:
    """Returns the user's cache folder for one subject; `XDG_CACHE_HOME` overrides the parent folder."""
    return pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache") / "congrasp" / name


def sync_directory(path: pathlib.Path) -> None:
    """Makes renames inside a directory durable across a power failure."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
