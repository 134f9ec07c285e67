"""Background threads that send rollouts to the learner until each has its outcome."""

import math
import queue
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any, Literal, NamedTuple

from congrasp.actors.pace import UploadWindow
from congrasp.actors.patience import Patience, backoff
from congrasp.common.errors import CongraspError, RefusedError, TransportError
from congrasp.common.io.journal import Journal
from congrasp.common.transport.base import Transport
from congrasp.common.wire.codec import CompressedMessage, Message, encode

Outcome = Literal["accepted", "duplicate", "stale", "refused"]
"""Outcome of a rollout: `duplicate` if it had been accepted before, `stale` if it was too old."""
_COMPRESSED_BELOW_BYTES_S = 20e6
"""Speed of a link below which rollouts are compressed, bytes/s: a tenth of the compression's."""
_MIN_LINK_BYTES_S = 100e3
"""Speed of the slowest link that is waited for, bytes/s."""


class _Upload(NamedTuple):
    """A rollout in the queue."""

    message: Message
    outcome: "Future[Outcome]"


class Uploads:
    """Threads that send rollouts.

    Attributes:
      failure: the reason why sending has stopped, if it has; also set by the owner.
      journal: records the outcome of each rollout, if the owner sets it.
      window: entered by the owner for each queued rollout, which leaves it with its outcome.
      closed: set once sending has been stopped.
    """

    def __init__(
        self,
        transport: Transport,
        key: str,
        on_reply: Callable[[Mapping[str, Any]], None],
        *,
        window: UploadWindow,
        max_refusals: int,
        request_timeout: float,
        patience: Patience,
    ):
        """Starts the threads.

        Args:
          transport: a connected transport.
          key: key to which rollouts are sent.
          on_reply: called with the state of the learner, which comes with every reply.
          window: limits the rollouts in transit.
          max_refusals: consecutive refused rollouts after which sending stops.
          request_timeout: deadline of a query in seconds, extended by the rollout's size.
          patience: limit of the learner's silence.
        """
        self.failure: CongraspError | None = None
        self.journal: Journal | None = None
        self.window = window
        self.closed = threading.Event()
        self._transport = transport
        self._key = key
        self._on_reply = on_reply
        self._max_refusals = max_refusals
        self._timeout = request_timeout
        self._patience = patience
        self._refusals = 0
        self._bytes_per_s = math.inf
        self._queue: queue.SimpleQueue[_Upload | None] = queue.SimpleQueue()
        self._pending: set[Future[Outcome]] = set()
        for index in range(window.most):
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
        self.failure = None
        self._refusals = 0

    def wait(self, timeout: float) -> bool:
        """Waits until every rollout has its outcome; False if that takes longer than `timeout`
        seconds.
        """
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
        """Sends rollouts from the queue until it is closed; one thread of `window.most`."""
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
                self.window.leave()
        self._queue.put(None)

    def _deliver(self, message: Message) -> Outcome:
        """Sends one rollout until it has an outcome."""
        answered = self._patience.now()
        damaged = 0
        timeout = self._timeout_of(message)
        delays = backoff()
        size = sum(array.nbytes for array in message.arrays.values())
        if self._bytes_per_s < _COMPRESSED_BELOW_BYTES_S:
            message = CompressedMessage(message.arrays, message.meta)
            size = len(encode(message))
        while not self.closed.is_set():
            delay = next(delays)
            began = time.perf_counter()  # finer than `monotonic` on some systems
            try:
                reply = self._transport.query(self._key, message, timeout=timeout)
            except RefusedError as error:  # it arrived damaged, or the learner failed on it
                damaged += 1
                answered = self._patience.now()
                if damaged >= self._max_refusals:
                    return self._count_refusal(str(error))
            except TransportError as error:
                self._patience.check(answered, error)
            else:
                answered = self._patience.now()
                seconds = time.perf_counter() - began
                self.window.record(seconds)
                self._bytes_per_s = size / seconds
                outcome = self._outcome(message, reply.meta)
                if outcome is not None:
                    return outcome
                delays = backoff()
                delay = float(reply.meta["retry_after"])
            self.closed.wait(delay)
        raise TransportError("The link was closed before the rollout was acknowledged.")

    def _timeout_of(self, message: Message) -> float:
        """Deadline of the query of a rollout, s.

        Repeating a query in transit would only fill a slow link; a dead link ends the query by
        itself.
        """
        size = sum(array.nbytes for array in message.arrays.values())
        return min(self._timeout + size / _MIN_LINK_BYTES_S, self._patience.limit)

    def _outcome(self, message: Message, reply: Mapping[str, Any]) -> Outcome | None:
        """Returns the outcome of a rollout by the learner's reply, and records it; None if the
        learner asks to send it again.
        """
        self._on_reply(reply)
        if self.failure:
            raise self.failure
        if reply["outcome"] == "retry":
            return None
        outcome: Outcome = reply["outcome"]
        if self.journal is not None:
            self.journal.write(
                actor=message.meta["actor"],
                incarnation=message.meta["incarnation"],
                answer=message.meta["sequence"],
                outcome=outcome,
                session_id=reply["session_id"],
            )
        if outcome == "refused":
            return self._count_refusal(str(reply["why"]))
        self._refusals = 0
        return outcome

    def _count_refusal(self, why: str) -> Outcome:
        """Counts a refusal; too many in a row make the uploads fail."""
        self._refusals += 1
        if self._refusals >= self._max_refusals:
            self.failure = CongraspError(
                f"The learner refused {self._refusals} rollouts in a row: {why}",
                "Start the actor with the learner's version of congrasp.",
            )
        return "refused"
