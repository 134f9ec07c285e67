"""Waits without a deadline but the suite's own (`timeout` in pyproject.toml), and a clock that tests set."""

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


class Clock:
    """Seconds that pass when they are told to."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def eventually(look: Callable[[], T], pause: float = 0.02) -> T:
    """What `look` returns, once that is something."""
    while not (found := look()):
        time.sleep(pause)
    return found
