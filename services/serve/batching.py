"""Batches queries that arrive together: a bounded queue and a worker thread, which a single query
bypasses.

Clients share the queue fairly (`fair_queue`), so that a flood from one does not exclude the others.
While several peers send queries, batches are small and the clients share each equally, so that a
long query, answered in parts, delays the others by no more than a small batch.
"""

import contextlib
import dataclasses
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, InvalidStateError
from typing import Generic, NamedTuple, TypeVar

from congrasp.common.errors import CongraspError, LateError, OverloadedError
from congrasp.common.transport.fair_queue import FairQueue
from congrasp.common.transport.senders import Peer

T = TypeVar("T")
R = TypeVar("R")


_ANYONE = Peer()
ALONE_S = 1.0
"""Time without a query of another peer after which a peer counts as alone."""


class Splitting(NamedTuple, Generic[T, R]):
    """Splitting of items into parts, while several peers share the batches."""

    weight_limits: tuple[int, ...]
    """Ascending limits of a batch's weight. The first one applies that is at least the number of
    peers ahead in the queue, so that each of them gets a weight of one or more."""
    cut: Callable[[T, int, int], T]
    """(item, first, end) -> the part of weight `end` - `first`."""
    join: Callable[[list[R]], R | None]
    """Results of all parts in order -> the item's result; None if they do not match, in which case
    the item runs again as a whole."""
    run_again: Callable[[T, float], R | Exception]
    """(item, its time in the queue in seconds) -> its result or error."""


@dataclasses.dataclass(eq=False)
class _Waiting(Generic[T, R]):
    """An item in the queue; times in seconds of the monotonic clock."""

    item: T
    weight: int
    future: "Future[R]"
    arrival: float
    deadline: float
    taken: int = 0
    """Weight of the parts that a batch has taken; the others are still queued."""
    results: list[R] = dataclasses.field(default_factory=list)
    """Results of the parts that have run."""


class _Part(NamedTuple, Generic[T, R]):
    """An item in a batch, or a part of one."""

    whole: _Waiting[T, R]
    """The queued item."""
    item: T
    """The item itself, or the part of it that `Splitting.cut` returned."""


class Batcher(Generic[T, R]):
    """Runs a function on batches of submitted items, one batch at a time.

    If nothing is running or queued, an item runs in the submitting thread, since waking another
    costs a single caller more than the work. All others wait for the worker, which takes the queued
    items. It waits at most `window` seconds until there are as many as in the last batch, so that
    synchronous callers stay synchronous.

    An error of `run`, or of joining an item's parts, fails the items of the batch; the worker
    continues.

    Args:
      run: function of a batch and its queueing times in seconds; returns one result or exception
        for each item.
      size: limit of the weight of a batch.
      window: longest wait for further items, s.
      depth: limit of the queue (`FairQueue`); items in excess fail with `OverloadedError`.
      peer_limit: limit of one peer's queued items; by default only `depth` limits them.
      weigh: returns an item's weight, at most `size`.
      splitting: splits items into parts; None runs each as a whole.
    """

    def __init__(
        self,
        run: Callable[[Sequence[T], Sequence[float]], Sequence[R | Exception]],
        *,
        size: int,
        window: float,
        depth: int,
        peer_limit: int | None = None,
        weigh: Callable[[T], int] = lambda item: 1,
        splitting: Splitting[T, R] | None = None,
    ):
        self._run = run
        self._weigh = weigh
        self._splitting = splitting
        self._size = size
        self._window = window
        self._depth = depth
        self._peer_limit = peer_limit or depth + 1
        self._queue: FairQueue[_Waiting[T, R]] = FairQueue(depth, self._peer_limit)
        self._latest_peer: Peer | None = None
        self._several_peers_until = -math.inf  # monotonic time at which the latest is alone
        self._changed = threading.Condition()  # guards all attributes from here and the queue
        self._running = False
        self._expected = 1  # items of the last batch
        self._closed = False
        self._thread = threading.Thread(target=self._work, daemon=True, name="batcher")
        self._thread.start()

    def check_room(self, peer: Peer) -> None:
        """Raises an `OverloadedError` if the peer may not queue another item."""
        with self._changed:
            if self._queue.is_at_share(peer):
                raise OverloadedError(
                    f"Overloaded: {self._peer_limit} of your queries are queued.",
                    "Try again later.",
                )
            if not self._queue.has_room(peer):
                raise self._queue_full_error()

    def _queue_full_error(self) -> OverloadedError:
        """Error of an item that has no place in the full queue."""
        return OverloadedError(f"Overloaded: {self._depth} queries are queued.", "Try again later.")

    def __len__(self) -> int:
        """Number of queued items."""
        with self._changed:
            return len(self._queue)

    def submit(self, item: T, timeout: float, peer: Peer = _ANYONE) -> "Future[R]":
        """Queues an item of a peer with a deadline of `timeout` seconds.

        Its future fails with an `OverloadedError` if the item loses its place to another client's.

        Raises:
          OverloadedError: there is no room for this peer's item.
          CongraspError: the queue is closed.
        """
        now = time.monotonic()
        waiting: _Waiting[T, R] = _Waiting(item, self._weigh(item), Future(), now, now + timeout)
        evicted = None
        with self._changed:
            if self._closed:
                raise CongraspError("The server is shutting down.")
            self._note_peer(peer, now)
            runs_here = self._is_idle() and waiting.weight <= self._batch_limit()
            if runs_here:
                self._running = True
            else:
                self.check_room(peer)
                evicted = self._queue.add(waiting, peer)
                self._changed.notify()
        if evicted is not None:
            _resolve(evicted.future, self._queue_full_error())
        if runs_here:
            self._run_batch([_Part(waiting, item)])
        return waiting.future

    def _note_peer(self, peer: Peer, now: float) -> None:
        """Notes the peer of the latest item, which decides whether several send items; the caller
        holds the lock.
        """
        if peer == self._latest_peer:
            return
        if self._latest_peer is not None:
            self._several_peers_until = now + ALONE_S
        self._latest_peer = peer

    def _is_idle(self) -> bool:
        """True if nothing runs, is queued or is expected to arrive at once."""
        return not self._running and not len(self._queue) and self._expected == 1

    def close(self, timeout: float = 2.0) -> None:
        """Refuses queued items and ends the worker."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(timeout)

    def _work(self) -> None:
        """Runs batches until the batcher is closed; runs in the worker thread."""
        while batch := self._collect():
            self._run_batch(batch)
        for waiting in self._queue:
            _resolve(waiting.future, CongraspError("The server is shutting down."))

    def _run_batch(self, batch: list[_Part[T, R]]) -> None:
        """Runs a batch without late items, and resolves every item once all its parts have run.

        No error leaves it, since that would end the worker and leave futures unresolved.
        """
        now = time.monotonic()
        in_time = []
        for part in batch:
            if part.whole.deadline >= now:
                in_time.append(part)
            else:
                self._fail(part.whole, _late(now - part.whole.arrival))
        results = self._results(in_time, now)
        with self._changed:
            self._running = False
            self._changed.notify()
        for part, result in zip(in_time, results, strict=True):
            self._finish(part, result)

    def _results(self, batch: list[_Part[T, R]], now: float) -> Sequence[R | Exception]:
        """Results of a batch that begins now, or the error of all its items."""
        if not batch:
            return []
        items = [part.item for part in batch]
        queued = [now - part.whole.arrival for part in batch]
        try:
            results = self._run(items, queued)
        except Exception as error:
            return [error] * len(batch)
        if len(results) != len(batch):
            mismatch = RuntimeError(f"A batch of {len(batch)} items has {len(results)} results.")
            return [mismatch] * len(batch)
        return results

    def _finish(self, part: _Part[T, R], result: R | Exception) -> None:
        """Resolves an item with the result of a part, unless further parts have to run."""
        waiting = part.whole
        if waiting.future.done():  # a part was running when the item lost its place
            return
        is_whole = part.item is waiting.item
        if self._splitting is not None and not is_whole and not isinstance(result, Exception):
            waiting.results.append(result)
            if waiting.taken < waiting.weight:
                return
            result = _join_results(self._splitting, waiting)
        if isinstance(result, Exception):
            self._fail(waiting, result)
        else:
            _resolve(waiting.future, result)

    def _collect(self) -> list[_Part[T, R]]:
        """Returns the next batch; empty once closed."""
        with self._changed:
            while (self._running or not len(self._queue)) and not self._closed:
                if not self._changed.wait(self._window if self._expected > 1 else None):
                    self._expected = 1
            self._wait_for_expected()
            if self._closed:
                return []
            batch = self._take()
            self._running = True
            self._expected = len(batch)
            return batch

    def _wait_for_expected(self) -> None:
        """Waits until there are as many items as in the last batch, or the oldest one has waited
        for the window; the caller holds the lock.
        """
        while len(self._queue) < self._expected and not self._closed:
            oldest = min(waiting.arrival for waiting in self._queue)
            rest = oldest + self._window - time.monotonic()
            if rest <= 0.0:
                return
            self._changed.wait(rest)

    def _is_shared(self) -> bool:
        """True if several peers share batches; the caller holds the lock."""
        return self._splitting is not None and time.monotonic() < self._several_peers_until

    def _batch_limit(self) -> int:
        """Limit of the next batch's weight; the caller holds the lock."""
        if self._splitting is None or not self._is_shared():
            return self._size
        peers = self._queue.peers_ahead
        return next(
            (limit for limit in self._splitting.weight_limits if limit >= peers), self._size
        )

    def _weight_by_peer(self, batch_limit: int) -> dict[Peer, int]:
        """Weight that each peer may have in a batch, in the order of their turns: accounts share
        the batch equally, and the peers of an account its part. The caller holds the lock.
        """
        peers = self._queue.in_turn()
        if not self._is_shared():
            return dict.fromkeys(peers, self._size)
        of_account = max(1, batch_limit // max(1, self._queue.accounts))
        return {peer: max(1, of_account // self._queue.peers_of(peer.account)) for peer in peers}

    def _take(self) -> list[_Part[T, R]]:
        """Takes a batch from the queue, one item or part of each peer in turn; the caller holds the
        lock.
        """
        batch: list[_Part[T, R]] = []
        is_shared = self._is_shared()
        rest_of_batch = self._batch_limit()
        rest_of_peer = self._weight_by_peer(rest_of_batch)
        while turns := self._turns(rest_of_peer):
            for peer in turns:
                waiting = self._queue.first(peer)
                weight = waiting.weight - waiting.taken
                if is_shared:
                    weight = min(weight, rest_of_peer[peer], rest_of_batch)
                if weight > rest_of_batch or not rest_of_batch:
                    return batch
                batch.append(self._take_part(waiting, weight))
                rest_of_peer[peer] -= weight
                rest_of_batch -= weight
                self._queue.end_turn(peer)
                if waiting.taken == waiting.weight:
                    self._queue.pop(peer)
        return batch

    def _turns(self, rest_of_peer: Mapping[Peer, int]) -> list[Peer]:
        """Peers with a queued item that may still add weight to the batch, in the order of their
        turns.
        """
        return [peer for peer in self._queue.in_turn() if rest_of_peer[peer] > 0]

    def _take_part(self, waiting: _Waiting[T, R], weight: int) -> _Part[T, R]:
        """Takes the next part of this weight from an item."""
        first = waiting.taken
        waiting.taken += weight
        if weight < waiting.weight and self._splitting is not None:
            return _Part(waiting, self._splitting.cut(waiting.item, first, waiting.taken))
        return _Part(waiting, waiting.item)

    def _fail(self, waiting: _Waiting[T, R], error: Exception) -> None:
        """Resolves an item with an error, and drops its further parts."""
        with self._changed:
            self._queue.discard(waiting)
        _resolve(waiting.future, error)


def _join_results(splitting: Splitting[T, R], waiting: _Waiting[T, R]) -> R | Exception:
    """Joins the results of an item's parts, or runs it again if they do not match and its deadline
    has not passed; returns errors.
    """
    try:
        joined = splitting.join(waiting.results)
        if joined is not None:
            return joined
        now = time.monotonic()
        queue_s = now - waiting.arrival
        if waiting.deadline < now:
            return _late(queue_s)
        return splitting.run_again(waiting.item, queue_s)
    except Exception as error:
        return error


def _late(queue_s: float) -> LateError:
    """Error of an item whose deadline passed in the queue, where it was for `queue_s` seconds."""
    return LateError(
        f"Too late: the query was queued for {1e3 * queue_s:.0f} ms, beyond its deadline."
    )


def _resolve(future: "Future[R]", outcome: R | Exception) -> None:
    """Resolves a future, unless its item lost its place meanwhile, which resolved it."""
    with contextlib.suppress(InvalidStateError):
        if isinstance(outcome, Exception):
            future.set_exception(outcome)
        else:
            future.set_result(outcome)
