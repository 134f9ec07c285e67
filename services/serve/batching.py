"""Batches queries that arrive together: a bounded queue and a worker thread, which a single query bypasses.

Peers share the server's time: the one that has had least of it comes next, and each has a limited share of the queue.
The size of a batch follows from the seconds that each size takes. While several peers send queries, long ones are
answered in parts that take little longer than the shortest query, and in at most half of the time. A peer that floods
the server therefore delays another's query by about the time that this query takes itself, if there are free cores.
"""

import bisect
import dataclasses
import itertools
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from typing import Generic, NamedTuple, TypeVar

from congrasp.common.errors import CongraspError, LateError, OverloadedError

T = TypeVar("T")
R = TypeVar("R")


_RECENT = 1.0  # seconds in which a query counts as recent
_SLICE = 1.5  # longest batch of parts of long queries, in times of the shortest recent query


class Parts(NamedTuple, Generic[T, R]):
    """Splitting of an item into parts."""

    weigh: Callable[[T], int]
    """Returns an item's weight, at most that of the largest batch."""
    cut: Callable[[T, int, int], T]
    """(item, first, end) -> the part of weight `end` - `first`."""
    join: Callable[[T, list[R]], R | Exception]
    """(item, results of its parts in order) -> its result."""


@dataclasses.dataclass(eq=False)
class _Waiting(Generic[T, R]):
    """An item in the queue; times in seconds of the monotonic clock."""

    item: T
    peer: str
    weight: int
    future: "Future[R]"
    arrival: float
    deadline: float
    taken: int = 0
    """Weight of the parts that were in a batch."""
    results: list[R] = dataclasses.field(default_factory=list)
    """Results of those parts."""

    @property
    def left(self) -> int:
        """Weight of the further parts."""
        return self.weight - self.taken


class _Part(NamedTuple, Generic[T, R]):
    """Part of an item in a batch."""

    whole: _Waiting[T, R]
    item: T


class Batcher(Generic[T, R]):
    """Runs a function on batches of submitted items, one batch at a time.

    If nothing is running or queued, an item runs in the submitting thread, since waking another costs a single caller
    more than the work. All others wait for the worker, which takes the queued items. It waits at most `window` seconds
    until there are as many as in the last batch, so that synchronous callers stay synchronous.

    Args:
      run: function of a batch and its queueing times in seconds; returns one result or exception for each item.
      seconds: weights of batches, and the seconds that each takes; a smaller batch takes as long as the next of them.
      window: longest wait for further items, s.
      depth: limit of the queue. A further item displaces the longest one, or is refused with `OverloadedError`.
      share: limit of one peer's queued items; by default `depth`.
      parts: splitting of items; None for items that each weigh 1.
    """

    def __init__(
        self,
        run: Callable[[Sequence[T], Sequence[float]], Sequence[R | Exception]],
        *,
        seconds: Mapping[int, float],
        window: float,
        depth: int,
        share: int | None = None,
        parts: Parts[T, R] | None = None,
    ):
        self._run = run
        self._parts = parts
        self._seconds, self._sizes = seconds, sorted(seconds)
        self._window = window
        self._depth = depth
        self._share = depth if share is None else share
        self._queues: dict[str, deque[_Waiting[T, R]]] = {}
        self._had: dict[str, float] = {}  # weight that each peer has had, on the scale of `_turn`
        self._turn = 0.0  # of the peer that came last: the least that a peer counts as having had
        self._latest, self._several_until = "", -math.inf  # peer, and the time at which it counts as alone
        self._shortest, self._shortest_until = 0, -math.inf  # weight of a recent item, and the time until it is recent
        self._rested = -math.inf  # time at which the next part of a long item may run
        self._changed = threading.Condition()
        self._running = False
        self._expected = 1
        self._closed = False
        self._thread = threading.Thread(target=self._work, daemon=True, name="batcher")
        self._thread.start()

    def check_room(self, peer: str) -> None:
        """Raises an `OverloadedError` if the peer may not queue another item, however short."""
        with self._changed:
            self._longest_above(1)
            if len(self._queues.get(peer, ())) >= self._share:
                raise OverloadedError(f"Overloaded: {self._share} of your queries are queued.", "Try again later.")

    def __len__(self) -> int:
        """Number of queued items."""
        with self._changed:
            return sum(map(len, self._queues.values()))

    def submit(self, item: T, timeout: float, peer: str = "") -> "Future[R]":
        """Queues an item of a peer with a deadline of `timeout` seconds.

        Raises:
          OverloadedError: `share` items of this peer are queued, or `depth` items that are no longer than this one.
        """
        now, weight = time.monotonic(), self._parts.weigh(item) if self._parts else 1
        waiting: _Waiting[T, R] = _Waiting(item, peer, weight, Future(), now, now + timeout)
        with self._changed:
            if self._closed:
                raise CongraspError("The server is shutting down.")
            self.check_room(peer)
            displaced = self._longest_above(weight)
            if displaced is not None:
                self._drop(displaced)
            if peer != self._latest:
                self._several_until, self._latest = (now + _RECENT) if self._latest else -math.inf, peer
            if weight <= self._shortest or now >= self._shortest_until:
                self._shortest, self._shortest_until = weight, now + _RECENT
            idle = not self._running and self._expected == 1 and (not self._queues or self._rest() > 0)
            self._queues.setdefault(peer, deque()).append(waiting)
            idle &= not self._rest()
            batch = self._take() if idle else []
            self._running |= idle
            if not idle:
                self._changed.notify()
        if displaced is not None:
            shorter = OverloadedError(f"Overloaded: {self._depth} shorter queries are queued.", "Try again later.")
            displaced.future.set_exception(shorter)
        if batch:
            self._answer(batch)
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
        for waiting in self._items():
            waiting.future.set_exception(CongraspError("The server is shutting down."))

    def _answer(self, batch: list[_Part[T, R]]) -> None:
        """Runs a batch without late items, and resolves every item once all its parts have run."""
        now = time.monotonic()
        for waiting, _ in batch:
            if waiting.deadline < now:
                late = (
                    f"Too late: the query was queued for {1e3 * (now - waiting.arrival):.0f} ms, beyond its deadline."
                )
                self._fail(waiting, LateError(late))
        batch = [part for part in batch if part.whole.deadline >= now]
        results: Sequence[R | Exception]
        try:
            queued = [now - part.whole.arrival for part in batch]
            results = self._run([part.item for part in batch], queued) if batch else []
        except Exception as error:
            results = [error] * len(batch)
        ended = time.monotonic()
        with self._changed:
            self._running = False
            if any(part.whole.weight > self._shortest for part in batch):
                self._rested = ended + (ended - now)
            self._changed.notify()
        for (waiting, item), result in zip(batch, results, strict=True):
            if self._parts is not None and item is not waiting.item and not isinstance(result, Exception):
                waiting.results.append(result)
                if waiting.left:
                    continue
                result = self._parts.join(waiting.item, waiting.results)
            if isinstance(result, Exception):
                self._fail(waiting, result)
            else:
                waiting.future.set_result(result)

    def _collect(self) -> list[_Part[T, R]]:
        """Returns the next batch; empty once closed."""
        with self._changed:
            while not self._closed:
                if self._running or not self._queues:
                    if not self._changed.wait(self._window if self._expected > 1 else None):
                        self._expected = 1
                elif (rest := self._rest()) > 0:
                    self._changed.wait(rest)
                else:
                    break
            if self._closed:
                return []
            until = min(one.arrival for one in self._items()) + self._window
            while len(self) < self._expected and (rest := until - time.monotonic()) > 0 and not self._closed:
                self._changed.wait(rest)
            batch = self._take()
            self._running, self._expected = True, len(batch)
            return batch

    def _items(self) -> Iterator[_Waiting[T, R]]:
        """Yields the queued items."""
        return itertools.chain.from_iterable(self._queues.values())

    def _rest(self) -> float:
        """Seconds until the next batch, if only long items of several peers are queued; the caller holds the lock."""
        now = time.monotonic()
        due = now >= self._several_until or any(one.left <= self._shortest for one in self._items())
        return 0.0 if due else max(0.0, self._rested - now)

    def _room(self) -> int:
        """Weight of the next batch: of the size that answers the queued short items soonest on average.

        All items count as short while one peer is alone. Otherwise those do that are no longer than the shortest recent
        one, and the size may also be the largest that takes little longer than that one. The caller holds the lock.
        """
        alone = time.monotonic() >= self._several_until
        short = sum(one.left for one in self._items() if alone or one.left <= self._shortest)
        room = min(self._sizes, key=lambda size: self._seconds[size] * (math.ceil(short / size) + 1))
        if alone:
            return room
        slice_seconds = _SLICE * self._seconds[self._sizes[bisect.bisect_left(self._sizes, self._shortest)]]
        return max(room, *(size for size in self._sizes if self._seconds[size] <= slice_seconds))

    def _rank(self, peer: str) -> tuple[float, int, float]:
        """Order of the peers: that which has had least, with the shorter item, that came first."""
        first = self._queues[peer][0]
        return max(self._turn, self._had.get(peer, 0.0)), first.left, first.arrival

    def _take(self) -> list[_Part[T, R]]:
        """Takes a batch from the queue; the caller holds the lock."""
        batch: list[_Part[T, R]] = []
        room = self._room()
        while self._queues and room:
            peer = min(self._queues, key=self._rank)
            waiting = self._queues[peer][0]
            weight = min(waiting.left, room)
            self._turn = self._rank(peer)[0]
            self._had[peer] = self._turn + weight
            room -= weight
            batch.append(self._part(waiting, weight))
            if not waiting.left:
                self._drop(waiting)
        if len(self._had) > 2 * self._depth:
            self._had = {peer: had for peer, had in self._had.items() if peer in self._queues}
        return batch

    def _part(self, waiting: _Waiting[T, R], weight: int) -> _Part[T, R]:
        """Takes a part of this weight from an item."""
        item, first = waiting.item, waiting.taken
        waiting.taken += weight
        if weight < waiting.weight and self._parts is not None:
            item = self._parts.cut(item, first, waiting.taken)
        return _Part(waiting, item)

    def _longest_above(self, weight: int) -> _Waiting[T, R] | None:
        """Item to displace from a full queue by one of this weight; None if the queue is not full.

        Raises:
          OverloadedError: no queued item is longer.
        """
        if len(self) < self._depth:
            return None
        untouched = [one for one in self._items() if not one.taken and one.weight > weight]
        if not untouched:
            raise OverloadedError(f"Overloaded: {self._depth} queries are queued.", "Try again later.")
        return max(untouched, key=lambda one: one.weight)

    def _drop(self, waiting: _Waiting[T, R]) -> None:
        """Removes an item from the queue; the caller holds the lock."""
        queue = self._queues[waiting.peer]
        queue.remove(waiting)
        if not queue:
            del self._queues[waiting.peer]

    def _fail(self, waiting: _Waiting[T, R], error: Exception) -> None:
        """Resolves an item with an error, and drops its further parts."""
        with self._changed:
            if waiting in self._queues.get(waiting.peer, ()):
                self._drop(waiting)
        waiting.future.set_exception(error)
