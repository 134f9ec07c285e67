"""Counts of a running decomposition, from files that its confined process writes."""

import itertools
import os
import pathlib
import re
from typing import NamedTuple

CUTTING = "Cutting into pieces"
JOINING = "Joining pieces"
_LOG = "log.txt"
_JOINS = "joins.txt"
_POOL = re.compile(rb"iter (\d+) ---- waiting pool: (\d+)")
"""CoACD's line at the start of an iteration: its number, and the number of parts to look at."""


class Count(NamedTuple):
    """Count of an activity."""

    activity: str
    done: int
    total: int
    """At present; more pieces may follow."""


def log_to(folder: pathlib.Path) -> None:
    """Sends the standard output of this process, also that of native code, to a file."""
    descriptor = os.open(folder / _LOG, os.O_WRONLY | os.O_CREAT)
    os.dup2(descriptor, 1)


def write_joins(folder: pathlib.Path, done: int, total: int) -> None:
    """Writes the number of joins that are made, and of all."""
    (folder / _JOINS).write_text(f"{done} {total}", encoding="utf-8")


def read_count(folder: pathlib.Path) -> Count:
    """Returns the count of the current activity; 0 of 0 before its first step."""
    joins = _content(folder / _JOINS).split()
    if len(joins) == 2:
        return Count(JOINING, int(joins[0]), int(joins[1]))
    done, total = pieces_in(_content(folder / _LOG))
    return Count(CUTTING, done, total)


def pieces_in(log: bytes) -> tuple[int, int]:
    """Returns the number of finished pieces and of all present pieces, by CoACD's log.

    In each iteration CoACD either finishes a part or cuts it into two parts, which wait for the
    next one.
    """
    pools = [(int(number), int(size)) for number, size in _POOL.findall(log)]
    finished = 0
    for (_, size), (next_number, next_size) in itertools.pairwise(pools):
        is_next_body = next_number == 0
        cut = 0 if is_next_body else next_size // 2
        finished += size - cut
    waiting = pools[-1][1] if pools else 0
    return finished, finished + waiting


def _content(file: pathlib.Path) -> bytes:
    """The content of a file; empty if there is none yet."""
    try:
        return file.read_bytes()
    except FileNotFoundError:
        return b""
