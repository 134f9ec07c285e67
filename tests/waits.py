"""Waits (`eventually` has no deadline but the suite's own, `timeout` in pyproject.toml), and a
clock that tests set.
"""

import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from typing import TypeVar

T = TypeVar("T")
A = TypeVar("A")


class Clock:
    """Seconds that pass when they are told to."""

    def __init__(self, now: float = 0.0):
        self.now = now

    def __call__(self) -> float:
        return self.now


def eventually(look: Callable[[], T], pause: float = 0.02) -> T:
    """What `look` returns, once that is something."""
    while not (result := look()):
        time.sleep(pause)
    return result


def together(call: Callable[[A], T], arguments: Iterable[A], seconds: float = 60.0) -> list[T]:
    """Results of calls at the same time; their threads are daemons, so that one that hangs ends
    with the tests.
    """

    def answer(future: Future[T], argument: A) -> None:
        try:
            future.set_result(call(argument))
        except BaseException as error:
            future.set_exception(error)

    calls = [(Future[T](), argument) for argument in arguments]
    for one in calls:
        threading.Thread(target=answer, args=one, daemon=True).start()
    return [future.result(seconds) for future, _ in calls]
