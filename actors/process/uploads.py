"""Rollouts in transit to the learner: each is sent until it has an outcome, across restarts of the learner."""

import itertools
import logging
import math
import queue
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any, Literal, NamedTuple

from congrasp.common.errors import CongraspError, RefusedError, TransportError
from congrasp.common.io.journal import Journal
from congrasp.common.transport.base import Transport
from congrasp.common.wire.codec import Message

Outcome = Literal["accepted", "duplicate", "stale", "refused"]
"""Outcome of a rollout: `duplicate` if it had been accepted before, `stale` if it was too old."""
_BACKOFF = (0.1, 0.5)  # first and longest delay between two attempts, s
_SLOWEST = 100e3  # slowest link that is waited for, bytes/s
_LONGEST_TICK = 1.0  # s
_NOTICED, _NOTICE_AGAIN = 5.0, 60.0  # silence after which a line is logged, and time between two lines, s
_log = logging.getLogger(__name__)


class Patience:
    """Limit of the learner's silence, in seconds during which this process ran.

    An interval in which the process was frozen or starved counts as one second. `now` must therefore be called at least
    once a second.

    Attributes:
      limit: longest silence, s.
    """

    def __init__(self, limit: float):
        """Starts to count."""
        self.limit = limit
        self._lock = threading.Lock()
        self._seconds, self._read = 0.0, time.monotonic()
        self._noticed = -math.inf

    def now(self) -> float:
        """Returns the seconds so far."""
        with self._lock:
            now = time.monotonic()
            self._seconds += min(now - self._read, _LONGEST_TICK)
            self._read = now
            return self._seconds

    def check(self, answered: float, error: TransportError) -> None:
        """Logs a silence of the learner, at most once a minute.

        Args:
          answered: time of its last reply, by `now`.
          error: error of the latest query.

        Raises:
          TransportError: the silence exceeds the limit.
        """
        now = self.now()
        silence = now - answered
        if silence > self.limit:
            raise TransportError(
                f"The learner has not answered for {self.limit:g} s: {error}", "Start the actor again later."
            ) from None
        if silence > _NOTICED and now - self._noticed > _NOTICE_AGAIN:
            self._noticed = now
            _log.warning("The learner does not answer; waiting for up to %g s: %s", self.limit, error)


class _Upload(NamedTuple):
    """A rollout in the queue."""

    message: Message
    outcome: "Future[Outcome]"


class Uploads:
    """Threads that send rollouts.

    Attributes:
      failure: the reason why sending has stopped, if it has; also set by the owner.
      free: acquired by the owner for each queued rollout; released when that rollout has its outcome.
      closed: set once sending has been stopped.
    """

    def __init__(
        self,
        transport: Transport,
        key: str,
        on_reply: Callable[[Mapping[str, Any]], None],
        *,
        window: int,
        max_refusals: int,
        request_timeout: float,
        patience: Patience,
        journal: Journal | None,
    ):
        """Starts the threads.

        Args:
          transport: a connected transport.
          key: key to which rollouts are sent.
          on_reply: called with the state of the learner, which comes with every reply.
          window: most rollouts in transit.
          max_refusals: consecutive refused rollouts after which sending stops.
          request_timeout: deadline of a query in seconds, extended by the rollout's size.
          patience: limit of the learner's silence.
          journal: records the outcome of each rollout.
        """
        self.failure: CongraspError | None = None
        self.free = threading.Semaphore(window)
        self.closed = threading.Event()
        self._transport, self._key, self._on_reply = transport, key, on_reply
        self._max_refusals, self._timeout, self._patience = max_refusals, request_timeout, patience
        self._journal = journal
        self._refusals = 0
        self._queue: queue.SimpleQueue[_Upload | None] = queue.SimpleQueue()
        self._pending: set[Future[Outcome]] = set()
        for index in range(window):
            threading.Thread(target=self._send_all, daemon=True, name=f"upload-{index}").start()

    def put(self, message: Message) -> "Future[Outcome]":
        """Sends a rollout in the background; returns a future of its outcome."""
        outcome = Future[Outcome]()
        self._pending.add(outcome)
        outcome.add_done_callback(self._pending.discard)
        self._queue.put(_Upload(message, outcome))
        return outcome

    def start_over(self) -> None:
        """Clears failure and refusals."""
        self.failure, self._refusals = None, 0

    def wait(self, timeout: float) -> bool:
        """Waits until every rollout has its outcome; False if that takes longer than `timeout` seconds."""
        deadline = time.monotonic() + timeout
        for outcome in list(self._pending):
            try:
                outcome.exception(max(0.0, deadline - time.monotonic()))
            except TimeoutError:
                return False
        return True

    def close(self) -> None:
        """Stops sending; rollouts without an outcome are abandoned."""
        self.closed.set()
        self._queue.put(None)

    def _send_all(self) -> None:
        """Sends rollouts from the queue until it is closed; one thread of `window`."""
        while (upload := self._queue.get()) is not None:
            message, outcome = upload
            try:
                outcome.set_result(self._deliver(message))
            except CongraspError as error:
                self.failure = self.failure or error
                outcome.set_exception(error)
            except Exception as error:  # an invalid reply: the thread must not die silently
                self.failure = CongraspError(f"The learner's reply is not valid: {error!r}.")
                outcome.set_exception(self.failure)
            finally:
                self.free.release()
        self._queue.put(None)

    def _deliver(self, message: Message) -> Outcome:
        """Sends one rollout until it has an outcome."""
        answered = self._patience.now()
        damaged = 0
        # Repeating a query in transit would only fill a slow link; a dead link ends the query by itself.
        timeout = min(self._timeout + sum(a.nbytes for a in message.arrays.values()) / _SLOWEST, self._patience.limit)
        delays = backoff()
        while not self.closed.is_set():
            delay = next(delays)
            try:
                reply = self._transport.query(self._key, message, timeout=timeout)
            except RefusedError as error:  # it arrived damaged, or the learner failed on it
                damaged += 1
                answered = self._patience.now()
                if damaged >= self._max_refusals:
                    return self._refused(str(error))
            except TransportError as error:
                self._patience.check(answered, error)
            else:
                answered = self._patience.now()
                self._on_reply(reply.meta)
                if self.failure:
                    raise self.failure
                outcome = reply.meta["outcome"]
                if outcome != "retry" and self._journal is not None:
                    who = {name: message.meta[name] for name in ("actor", "incarnation")}
                    answer = {
                        "answer": message.meta["sequence"],
                        "outcome": outcome,
                        "session_id": reply.meta["session_id"],
                    }
                    self._journal.write(**who, **answer)
                if outcome == "refused":
                    return self._refused(str(reply.meta["why"]))
                if outcome != "retry":
                    self._refusals = 0
                    return outcome
                delays = backoff()
                delay = float(reply.meta["retry_after"])
            self.closed.wait(delay)
        raise TransportError("The link was closed before the rollout was acknowledged.")

    def _refused(self, why: str) -> Outcome:
        """Counts a refusal; too many in a row make the uploads fail."""
        self._refusals += 1
        if self._refusals >= self._max_refusals:
            self.failure = CongraspError(
                f"The learner refused {self._refusals} rollouts in a row: {why}",
                "Start the actor with the learner's version of congrasp.",
            )
        return "refused"


def backoff() -> "itertools.chain[float]":
    """Seconds to wait after the first, second, ... failed attempt."""
    first, longest = _BACKOFF
    growing: Callable[[int], float] = lambda index: min(longest, first * 2**index)  # noqa: E731
    return itertools.chain(map(growing, range(10)), itertools.repeat(longest))
