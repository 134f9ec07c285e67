"""Timing of the stages of a run's start, up to its first update, in any thread."""

import contextlib
import threading
import time
from collections.abc import Iterator
from typing import NamedTuple

import psutil


class Stage(NamedTuple):
    """A stage of the start; times in seconds since this process began."""

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
    """Times the block as the stage of this name, unless the stage exists: later calls do not belong to the start."""
    began = since_start()
    try:
        yield
    finally:
        with _lock:
            _stages.setdefault(name, Stage(name, began, since_start()))


def imported() -> None:
    """Records everything up to now as the stage of imports."""
    with _lock:
        _stages.setdefault("imports", Stage("imports", 0.0, since_start()))


def stages() -> list[Stage]:
    """Stages so far, ordered by their start; those of different threads overlap."""
    with _lock:
        return sorted(_stages.values(), key=lambda one: one.began)
