"""Files that are either the old ones or the new ones, whatever happens in between."""

import contextlib
import os
import pathlib

from congrasp.common.errors import CongraspError


def write_atomically(path: pathlib.Path, data: bytes) -> None:
    """Replaces a file's content: written beside it, flushed to the disk, renamed over it.

    Raises:
      CongraspError: naming the file, when it cannot be written; what was there before is intact.
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
            "Free space or choose another folder; an earlier file of that name is intact.",
        ) from None


def check_free(path: pathlib.Path, *, force: bool = False) -> None:
    """Raises a CongraspError where a command would overwrite a file, unless its user asked for that with --force."""
    if path.exists() and not force:
        raise CongraspError(f"{path} is there already.", "Name another with --out, or replace it with --force.")


def cache_folder(name: str) -> pathlib.Path:
    """The user's folder for what is kept of one subject; `XDG_CACHE_HOME` names another place for all of them."""
    return pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache") / "congrasp" / name


def sync_directory(path: pathlib.Path) -> None:
    """Makes renames inside a directory survive a power cut."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
