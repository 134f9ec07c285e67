"""Queries that arrive together are answered together: a bounded queue, a worker thread, and none for a lone query.

Peers take turns in the queue, and none may fill more than its part of it: one that asks without end delays the others
by one query of its own, and is refused when nobody else would be.
"""

import collections
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Generic, NamedTuple, TypeVar, cast

from common.errors import CongraspError, LateError, OverloadedError

T = TypeVar("T")
R = TypeVar("R")


class _Waiting(NamedTuple):
    """An item in the queue; times in seconds of the monotonic clock."""

    item: object
    peer: str
    future: Future
    arrival: float
    deadline: float


class Batcher(Generic[T, R]):
    """Runs a function on batches of what callers submit, one batch at a time.

    An item that finds nothing running and nobody waiting is run in the thread that submits it, since waking another
    costs a lone caller more than the work. Everything else waits for the worker, which takes what has arrived. It
    waits for more, `window` seconds at most, only until as many are there as were in the last batch: many callers in
    step are answered in step.

    Args:
      run: the function of a batch and its queueing times in seconds; it returns one result or exception for each item.
      size: most that the items of one batch may weigh together.
      window: seconds.
      depth: most items that wait; one more is refused with `OverloadedError`.
      share: most items of one peer that wait; by default `depth`.
      weigh: an item's weight, which is at most `size`.
    """

    def __init__(
        self,
        run: Callable[[Sequence[T], Sequence[float]], Sequence[R | Exception]],
        *,
        size: int,
        window: float,
        depth: int,
        share: int | None = None,
        weigh: Callable[[T], int] = lambda item: 1,
    ):
        self._run = run
        self._weigh = weigh
        self._size = size
        self._window = window
        self._depth = depth
        self._share = depth if share is None else share
        self._queues: collections.OrderedDict[str, collections.deque[_Waiting]] = collections.OrderedDict()
        self._changed = threading.Condition()
        self._running = False
        self._expected = 1
        self._closed = False
        self._thread = threading.Thread(target=self._work, daemon=True, name="batcher")
        self._thread.start()

    def check_room(self, peer: str) -> None:
        """Raises `OverloadedError` if nothing more of a peer may wait."""
        with self._changed:
            if len(self) >= self._depth:
                raise OverloadedError(f"Overloaded: {self._depth} queries wait already.", "Ask again later.")
            if len(self._queues.get(peer, ())) >= self._share:
                raise OverloadedError(f"Overloaded: {self._share} of your queries wait already.", "Ask again later.")

    def __len__(self) -> int:
        """Items that wait."""
        with self._changed:
            return sum(len(queue) for queue in self._queues.values())

    def submit(self, item: T, timeout: float, peer: str = "") -> "Future[R]":
        """Queues an item of a peer that is worth answering for `timeout` seconds.

        Raises:
          OverloadedError: `depth` items wait already, or `share` of this peer.
        """
        now = time.monotonic()
        waiting = _Waiting(item, peer, Future(), now, now + timeout)
        with self._changed:
            if self._closed:
                raise CongraspError("The server is shutting down.")
            alone = not self._running and not self._queues and self._expected == 1
            if alone:
                self._running = True
            else:
                self.check_room(peer)
                self._queues.setdefault(peer, collections.deque()).append(waiting)
                self._changed.notify()
        if alone:
            self._answer([waiting])
        return waiting.future

    def close(self, timeout: float = 2.0) -> None:
        """Refuses what waits and ends the worker."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(timeout)

    def _work(self) -> None:
        """Answers batches until the batcher is closed, in the worker."""
        while batch := self._collect():
            self._answer(batch)
        for waiting in (one for queue in self._queues.values() for one in queue):
            waiting.future.set_exception(CongraspError("The server is shutting down."))

    def _answer(self, batch: list[_Waiting]) -> None:
        """Runs a batch without what is late, and gives every item its outcome."""
        now = time.monotonic()
        for waiting in batch:
            if waiting.deadline < now:
                late = f"Too late: the query waited {1e3 * (now - waiting.arrival):.0f} ms, beyond its deadline."
                waiting.future.set_exception(LateError(late))
        batch = [waiting for waiting in batch if waiting.deadline >= now]
        try:
            items = [cast(T, waiting.item) for waiting in batch]
            results = self._run(items, [now - waiting.arrival for waiting in batch]) if batch else []
        except Exception as error:
            results = [error] * len(batch)
        with self._changed:
            self._running = False
            self._changed.notify()
        for waiting, result in zip(batch, results, strict=True):
            if isinstance(result, Exception):
                waiting.future.set_exception(result)
            else:
                waiting.future.set_result(result)

    def _collect(self) -> list[_Waiting]:
        """The next batch; empty once closed."""
        with self._changed:
            while (self._running or not self._queues) and not self._closed:
                if not self._changed.wait(self._window if self._expected > 1 else None):
                    self._expected = 1
            if self._closed:
                return []
            until = min(queue[0].arrival for queue in self._queues.values()) + self._window
            while len(self) < self._expected and (rest := until - time.monotonic()) > 0 and not self._closed:
                self._changed.wait(rest)
            batch, room = [], self._size
            while self._queues:
                peer, queue = next(iter(self._queues.items()))  # whose turn it is
                weight = self._weigh(cast(T, queue[0].item))
                if weight > room:
                    break
                batch.append(queue.popleft())
                room -= weight
                self._queues.move_to_end(peer)
                if not queue:
                    del self._queues[peer]
            self._running, self._expected = True, len(batch)
            return batch
