"""Queries that arrive together are answered together: a bounded queue, a worker thread, and none for a lone query.

Peers take turns in the queue, and none may fill more than its part of it: one that asks without end is refused when
nobody else would be. While several peers ask, a long query is answered in parts, one in each batch: it delays the
others by one part.
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
    """How an item is run in parts."""

    most: int
    """What all that one peer has in a batch may weigh while there are several peers."""
    cut: Callable[[T, int, int], T]
    """(item, first, end) -> what weighs `end` - `first` of it."""
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
    """Weight of the parts that have been in a batch."""
    results: list[R] = dataclasses.field(default_factory=list)
    """Of those parts."""


class _Part(NamedTuple, Generic[T, R]):
    """What a batch holds of an item."""

    whole: _Waiting[T, R]
    item: T


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
      parts: how items are run in parts; without it each is run whole.
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
        self._queues: collections.OrderedDict[str, collections.deque[_Waiting[T, R]]] = collections.OrderedDict()
        self._latest, self._several_until = "", -math.inf  # peer, and when it will count as alone
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
        waiting: _Waiting[T, R] = _Waiting(item, self._weigh(item), Future(), now, now + timeout)
        with self._changed:
            if self._closed:
                raise CongraspError("The server is shutting down.")
            if peer != self._latest:
                self._several_until, self._latest = (now + _ALONE) if self._latest else -math.inf, peer
            alone = not self._running and not self._queues and self._expected == 1
            alone = alone and waiting.weight <= self._turn()
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

    def _answer(self, batch: list[_Part[T, R]]) -> None:
        """Runs a batch without what is late, and gives every item its outcome once all its parts have run."""
        now = time.monotonic()
        for waiting, _ in batch:
            if waiting.deadline < now:
                late = f"Too late: the query waited {1e3 * (now - waiting.arrival):.0f} ms, beyond its deadline."
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
            if self._parts is not None and item is not waiting.item and not isinstance(result, Exception):
                waiting.results.append(result)
                if waiting.taken < waiting.weight:
                    continue
                result = self._parts.join(waiting.item, waiting.results)
            if isinstance(result, Exception):
                self._fail(waiting, result)
            else:
                waiting.future.set_result(result)

    def _collect(self) -> list[_Part[T, R]]:
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
            batch = self._take()
            self._running, self._expected = True, len(batch)
            return batch

    def _turn(self) -> int:
        """What one peer may have in a batch."""
        return self._parts.most if self._parts and time.monotonic() < self._several_until else self._size

    def _take(self) -> list[_Part[T, R]]:
        """Takes a batch from the queue, one item or part of each peer after the other; the caller holds the lock."""
        batch: list[_Part[T, R]] = []
        room, most = self._size, self._turn()
        turns = collections.Counter[str]()
        while waiting := [peer for peer in self._queues if turns[peer] < most]:
            peer = waiting[0]  # whose turn it is
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
        """Takes so much of an item."""
        item, first = waiting.item, waiting.taken
        waiting.taken += weight
        if weight < waiting.weight and self._parts is not None:
            item = self._parts.cut(item, first, waiting.taken)
        return _Part(waiting, item)

    def _fail(self, waiting: _Waiting[T, R], error: Exception) -> None:
        """Gives an item an error, and runs no further part of it."""
        with self._changed:
            for peer, queue in self._queues.items():
                if waiting in queue:
                    queue.remove(waiting)
                    if not queue:
                        del self._queues[peer]
                    break
        waiting.future.set_exception(error)
