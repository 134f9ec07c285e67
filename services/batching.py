"""Queries that arrive together are answered together: a bounded queue and one worker thread."""

import collections
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Generic, NamedTuple, TypeVar, cast

from common.errors import CongraspError

T = TypeVar("T")
R = TypeVar("R")


class Overloaded(CongraspError):
    """The queue is full; said at once, so that the caller can do something else within its deadline."""


class Late(CongraspError):
    """The query's deadline passed while it waited."""


class _Waiting(NamedTuple):
    item: object
    future: Future
    arrival: float
    deadline: float


class Batcher(Generic[T, R]):
    """Runs a function on batches of what callers submit.

    The worker takes what has arrived. It waits for more, `window` seconds at most, only until as many are there as
    were in the last batch: one lonely caller never waits, and many callers in step are answered in step.

    Args:
      run: the function of a batch and its queueing times in seconds; it returns one result or exception for each item.
      size: most items in one batch.
      window: seconds.
      depth: most items that wait; one more is refused with `Overloaded`.
    """

    def __init__(
        self,
        run: Callable[[Sequence[T], Sequence[float]], Sequence[R | Exception]],
        *,
        size: int,
        window: float,
        depth: int,
    ):
        self._run = run
        self._size = size
        self._window = window
        self._depth = depth
        self._queue: collections.deque[_Waiting] = collections.deque()
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._work, daemon=True, name="batcher")
        self._thread.start()

    def __len__(self) -> int:
        """Items that wait."""
        return len(self._queue)

    def submit(self, item: T, timeout: float) -> "Future[R]":
        """Queues an item that is worth answering for `timeout` seconds.

        Raises:
          Overloaded: `depth` items wait already.
        """
        now = time.monotonic()
        future: Future[R] = Future()
        with self._changed:
            if self._closed:
                raise CongraspError("The server is shutting down.")
            if len(self._queue) >= self._depth:
                raise Overloaded(f"Overloaded: {self._depth} queries wait already.", "Ask again later.")
            self._queue.append(_Waiting(item, future, now, now + timeout))
            self._changed.notify()
        return future

    def close(self, timeout: float = 2.0) -> None:
        """Refuses what waits and ends the worker."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(timeout)

    def _work(self) -> None:
        expected = 1
        while batch := self._collect(expected):
            expected = len(batch)
            now = time.monotonic()
            for waiting in batch:
                if waiting.deadline < now:
                    late = f"Too late: the query waited {1e3 * (now - waiting.arrival):.0f} ms, beyond its deadline."
                    waiting.future.set_exception(Late(late))
            batch = [waiting for waiting in batch if waiting.deadline >= now]
            if batch:
                self._answer(batch, now)
        for waiting in self._queue:
            waiting.future.set_exception(CongraspError("The server is shutting down."))

    def _answer(self, batch: list[_Waiting], now: float) -> None:
        try:
            results = self._run(
                [cast(T, waiting.item) for waiting in batch], [now - waiting.arrival for waiting in batch]
            )
        except Exception as error:
            results = [error] * len(batch)
        for waiting, result in zip(batch, results, strict=True):
            if isinstance(result, Exception):
                waiting.future.set_exception(result)
            else:
                waiting.future.set_result(result)

    def _collect(self, expected: int) -> list[_Waiting]:
        """The next batch; empty once closed."""
        with self._changed:
            while not self._queue and not self._closed:
                self._changed.wait()
            if self._closed:
                return []
            until = self._queue[0].arrival + self._window
            while len(self._queue) < expected and (rest := until - time.monotonic()) > 0 and not self._closed:
                self._changed.wait(rest)
            return [self._queue.popleft() for _ in range(min(self._size, len(self._queue)))]
