"""Where the time until a run's first update goes: stages of its start, timed as they happen, in whatever thread."""

import contextlib
import threading
import time
from collections.abc import Iterator
from typing import NamedTuple

import psutil


class Stage(NamedTuple):
    """Something that a start consists of; times in seconds since this process began."""

    name: str
    began: float
    ended: float


_BEGAN = psutil.Process().create_time()
_lock = threading.Lock()
_stages: dict[str, Stage] = {}


def since_start() -> float:
    """Seconds since this process began."""
    return time.time() - _BEGAN


@contextlib.contextmanager
def stage(name: str) -> Iterator[None]:
    """Times the block as the stage of this name, unless there was one: what comes later belongs to no start."""
    began = since_start()
    try:
        yield
    finally:
        with _lock:
            _stages.setdefault(name, Stage(name, began, since_start()))


def imported() -> None:
    """Notes that everything before now was imports."""
    with _lock:
        _stages.setdefault("imports", Stage("imports", 0.0, since_start()))


def stages() -> list[Stage]:
    """The stages so far, in the order in which they began; those of different threads overlap."""
    with _lock:
        return sorted(_stages.values(), key=lambda one: one.began)
