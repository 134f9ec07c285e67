"""Caches between runs of results that depend only on their inputs: a folder for each subject."""

import contextlib
import functools
import hashlib
import os
import pathlib
from types import ModuleType

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically
from congrasp.common.wire.codec import Message, decode, encode


@functools.cache
def source_digest(*packages: ModuleType) -> str:
    """Returns sixteen hex digits of all source and data in these packages; a change invalidates cache entries."""
    digest = hashlib.sha256()
    for folder in (folder for package in packages for folder in package.__path__):
        for file in sorted(file for kind in ("*.py", "*.json") for file in pathlib.Path(folder).rglob(kind)):
            digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def read_kept(path: pathlib.Path) -> Message | None:
    """Reads a cached message if it exists and is intact, and marks it as used now."""
    try:
        message = decode(path.read_bytes(), max_bytes=path.stat().st_size)
        os.utime(path)
    except (OSError, CongraspError):
        return None
    return message


def keep(path: pathlib.Path, message: Message, most: int) -> None:
    """Writes a message to the cache, and removes all but the `most` last used files of its folder.

    A full disk or a folder without write permission is ignored: the next run recomputes the entry.
    """
    with contextlib.suppress(CongraspError, OSError):
        write_atomically(path, encode(message))
        files = sorted(path.parent.glob(f"*{path.suffix}"), key=lambda file: file.stat().st_mtime)
        for old in files[:-most]:
            old.unlink(missing_ok=True)
