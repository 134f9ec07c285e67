"""Batches queries that arrive together: a bounded queue and a worker thread, which a single query
bypasses.

Peers take turns in the queue, and each has a limited share of it, so that a flood from one does not
exclude the others. While several peers send queries, batches are small and the peers share each
equally, so that a long query, answered in parts, delays the others by no more than a small batch.
"""

import collections
import dataclasses
import math
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Generic, NamedTuple, TypeVar

from congrasp.common.errors import CongraspError, LateError, OverloadedError

T = TypeVar("T")
R = TypeVar("R")


_ALONE = 1.0  # seconds without a query of another peer until one counts as alone


class Parts(NamedTuple, Generic[T, R]):
    """Splitting of an item into parts."""

    most: int
    """Limit of a batch's weight while several peers, at most as many as this, send queries."""
    cut: Callable[[T, int, int], T]
    """(item, first, end) -> the part of weight `end` - `first`."""
    join: Callable[[T, list[R]], R | Exception]
    """(item, results of its parts in order) -> its result."""


@dataclasses.dataclass(eq=False)
class _Waiting(Generic[T, R]):
    """An item in the queue; times in seconds of the monotonic clock."""

    item: T
    weight: int
    future: "Future[R]"
    arrival: float
    deadline: float
    taken: int = 0
    """Weight of the parts that were in a batch."""
    results: list[R] = dataclasses.field(default_factory=list)
    """Results of those parts."""


class _Part(NamedTuple, Generic[T, R]):
    """Part of an item in a batch."""

    whole: _Waiting[T, R]
    item: T


class Batcher(Generic[T, R]):
    """Runs a function on batches of submitted items, one batch at a time.

    If nothing is running or queued, an item runs in the submitting thread, since waking another
    costs a single caller more than the work. All others wait for the worker, which takes the queued
    items. It waits at most `window` seconds until there are as many as in the last batch, so that
    synchronous callers stay synchronous.

    Args:
      run: function of a batch and its queueing times in seconds; returns one result or exception
        for each item.
      size: limit of the weight of a batch.
      window: longest wait for further items, s.
      depth: limit of the queue; further items are refused with `OverloadedError`.
      share: limit of one peer's queued items; by default `depth`.
      weigh: returns an item's weight, at most `size`.
      parts: splitting of items; None runs each as a whole.
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
        parts: Parts[T, R] | None = None,
    ):
        self._run = run
        self._weigh, self._parts = weigh, parts
        self._size = size
        self._window = window
        self._depth = depth
        self._share = depth if share is None else share
        self._queues: collections.OrderedDict[str, collections.deque[_Waiting[T, R]]] = (
            collections.OrderedDict()
        )
        # Peer, and the time at which it counts as alone
        self._latest, self._several_until = (
            "",
            -math.inf,
        )
        self._changed = threading.Condition()
        self._running = False
        self._expected = 1
        self._closed = False
        self._thread = threading.Thread(target=self._work, daemon=True, name="batcher")
        self._thread.start()

    def check_room(self, peer: str) -> None:
        """Raises an `OverloadedError` if the peer may not queue another item."""
        with self._changed:
            if len(self) >= self._depth:
                raise OverloadedError(
                    f"Overloaded: {self._depth} queries are queued.", "Try again later."
                )
            if len(self._queues.get(peer, ())) >= self._share:
                raise OverloadedError(
                    f"Overloaded: {self._share} of your queries are queued.", "Try again later."
                )

    def __len__(self) -> int:
        """Number of queued items."""
        with self._changed:
            return sum(len(queue) for queue in self._queues.values())

    def submit(self, item: T, timeout: float, peer: str = "") -> "Future[R]":
        """Queues an item of a peer with a deadline of `timeout` seconds.

        Raises:
          OverloadedError: `depth` items are queued already, or `share` of this peer.
          CongraspError: the queue is closed.
        """
        now = time.monotonic()
        waiting: _Waiting[T, R] = _Waiting(item, self._weigh(item), Future(), now, now + timeout)
        with self._changed:
            if self._closed:
                raise CongraspError("The server is shutting down.")
            if peer != self._latest:
                self._several_until, self._latest = (
                    (now + _ALONE) if self._latest else -math.inf,
                    peer,
                )
            alone = not self._running and not self._queues and self._expected == 1
            alone = alone and waiting.weight <= self._limits()[0]
            if alone:
                self._running = True
            else:
                self.check_room(peer)
                self._queues.setdefault(peer, collections.deque()).append(waiting)
                self._changed.notify()
        if alone:
            self._answer([_Part(waiting, item)])
        return waiting.future

    def close(self, timeout: float = 2.0) -> None:
        """Refuses queued items and ends the worker."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(timeout)

    def _work(self) -> None:
        """Runs batches until the batcher is closed; runs in the worker thread."""
        while batch := self._collect():
            self._answer(batch)
        for waiting in (one for queue in self._queues.values() for one in queue):
            waiting.future.set_exception(CongraspError("The server is shutting down."))

    def _answer(self, batch: list[_Part[T, R]]) -> None:
        """Runs a batch without late items, and resolves every item once all its parts have run."""
        now = time.monotonic()
        for waiting, _ in batch:
            if waiting.deadline < now:
                late = (
                    f"Too late: the query was queued for {1e3 * (now - waiting.arrival):.0f} ms, "
                    f"beyond its deadline."
                )
                self._fail(waiting, LateError(late))
        batch = [part for part in batch if part.whole.deadline >= now]
        results: Sequence[R | Exception]
        try:
            queued = [now - part.whole.arrival for part in batch]
            results = self._run([part.item for part in batch], queued) if batch else []
        except Exception as error:
            results = [error] * len(batch)
        with self._changed:
            self._running = False
            self._changed.notify()
        for (waiting, item), result in zip(batch, results, strict=True):
            if (
                self._parts is not None
                and item is not waiting.item
                and not isinstance(result, Exception)
            ):
                waiting.results.append(result)
                if waiting.taken < waiting.weight:
                    continue
                result = self._parts.join(waiting.item, waiting.results)
            if isinstance(result, Exception):
                self._fail(waiting, result)
            else:
                waiting.future.set_result(result)

    def _collect(self) -> list[_Part[T, R]]:
        """Returns the next batch; empty once closed."""
        with self._changed:
            while (self._running or not self._queues) and not self._closed:
                if not self._changed.wait(self._window if self._expected > 1 else None):
                    self._expected = 1
            if self._closed:
                return []
            until = min(queue[0].arrival for queue in self._queues.values()) + self._window
            while (
                len(self) < self._expected
                and (rest := until - time.monotonic()) > 0
                and not self._closed
            ):
                self._changed.wait(rest)
            batch = self._take()
            self._running, self._expected = True, len(batch)
            return batch

    def _limits(self) -> tuple[int, int]:
        """Limits of a batch's weight and of one peer's weight in it; the caller holds the lock."""
        if self._parts is None or time.monotonic() >= self._several_until:
            return self._size, self._size
        room = self._parts.most if len(self._queues) <= self._parts.most else self._size
        return room, max(1, room // max(1, len(self._queues)))

    def _take(self) -> list[_Part[T, R]]:
        """Takes a batch from the queue, one item or part of each peer in turn; the caller holds the
        lock.
        """
        batch: list[_Part[T, R]] = []
        room, most = self._limits()
        turns = collections.Counter[str]()
        while waiting := [peer for peer in self._queues if turns[peer] < most]:
            peer = waiting[0]  # the peer whose turn it is
            queue = self._queues[peer]
            first = queue[0]
            weight = first.weight - first.taken
            if most < self._size:
                weight = min(weight, most - turns[peer], room)
            if weight > room or not room:
                break
            batch.append(self._part(first, weight))
            turns[peer] += weight
            room -= weight
            self._queues.move_to_end(peer)
            if first.taken == first.weight:
                queue.popleft()
            if not queue:
                del self._queues[peer]
        return batch

    def _part(self, waiting: _Waiting[T, R], weight: int) -> _Part[T, R]:
        """Takes a part of this weight from an item."""
        item, first = waiting.item, waiting.taken
        waiting.taken += weight
        if weight < waiting.weight and self._parts is not None:
            item = self._parts.cut(item, first, waiting.taken)
        return _Part(waiting, item)

    def _fail(self, waiting: _Waiting[T, R], error: Exception) -> None:
        """Resolves an item with an error, and drops its further parts."""
        with self._changed:
            for peer, queue in self._queues.items():
                if waiting in queue:
                    queue.remove(waiting)
                    if not queue:
                        del self._queues[peer]
                    break
        waiting.future.set_exception(error)
