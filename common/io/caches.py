"""What is kept between runs because it follows from its inputs alone: folders by subject, files by content."""

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
    """Sixteen hex digits of all source in these packages: what they made and is kept ends with their next change."""
    digest = hashlib.sha256()
    for folder in (folder for package in packages for folder in package.__path__):
        for file in sorted(pathlib.Path(folder).rglob("*.py")):
            digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def read_kept(path: pathlib.Path) -> Message | None:
    """A kept message, if it is there and whole; it counts as used now."""
    try:
        message = decode(path.read_bytes(), max_bytes=path.stat().st_size)
        os.utime(path)
    except (OSError, CongraspError):
        return None
    return message


def keep(path: pathlib.Path, message: Message, most: int) -> None:
    """Writes a message, and removes all but the `most` files of its folder that were used last.

    A disk that is full, or a folder that cannot be written to, costs the next run some time and no more.
    """
    with contextlib.suppress(CongraspError, OSError):
        write_atomically(path, encode(message))
        files = sorted(path.parent.glob(f"*{path.suffix}"), key=lambda file: file.stat().st_mtime)
        for old in files[:-most]:
            old.unlink(missing_ok=True)
