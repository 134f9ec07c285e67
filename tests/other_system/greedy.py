"""Functions for confined processes that exceed a limit."""

import pathlib
import time


def allocate(folder: pathlib.Path) -> int:
    """Takes 600 MB of memory and keeps it for a minute."""
    data = bytearray(600 << 20)
    data[:: 1 << 12] = b"1" * len(data[:: 1 << 12])
    time.sleep(60)
    return len(data)


def compute(folder: pathlib.Path) -> None:
    """Computes for a minute."""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        pass
