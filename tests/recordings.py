"""Recordings on disk."""

import pathlib

from mcap.writer import MCAP0_MAGIC


def is_complete(path: pathlib.Path) -> bool:
    """True if the file was finished; false if its writer was killed."""
    data = path.read_bytes()
    return len(data) > 2 * len(MCAP0_MAGIC) and data.endswith(MCAP0_MAGIC)
