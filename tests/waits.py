"""Waits without a deadline but the suite's own (`timeout` in pyproject.toml): a busy machine takes its time."""

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


def eventually(look: Callable[[], T], pause: float = 0.02) -> T:
    """What `look` returns, once that is something."""
    while not (found := look()):
        time.sleep(pause)
    return found
