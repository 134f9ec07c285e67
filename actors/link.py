"""Actor side of the link: configuration, tickets, weights, and exactly-once delivery of rollouts.

`upload` assigns a rollout its identity (actor, incarnation, sequence), under which it is sent until
the learner replies, across restarts of the learner (`Uploads`). Sending happens in the background,
while the next rollout is produced; at most `window` rollouts are in transit, further ones wait in
`upload`.
"""

import contextlib
import itertools
import logging
import math
import queue
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any, Literal, NamedTuple

from congrasp.common.errors import CongraspError, RefusedError, TransportError
from congrasp.common.io.journal import Journal
from congrasp.common.transport.base import Closing, Transport
from congrasp.common.transport.keys import Keys, check_name
from congrasp.common.wire.codec import Message, SharedMessage, checksum

Outcome = Literal["accepted", "duplicate", "stale", "refused"]
"""Outcome of a rollout: `duplicate` if it had been accepted before, `stale` if it was too old."""
_BACKOFF = (0.1, 0.5)  # first and longest delay between two attempts, s
_SLOWEST = 100e3  # slowest link that is waited for, bytes/s
_LONGEST_TICK = 1.0  # s
_NOTICED = 2.0
"""Silence after which a line is logged, s."""
_NOTICE_AGAIN = 60.0
"""Time between two lines, s."""
_log = logging.getLogger(__name__)


class Patience:
    """Limit of the learner's silence, in seconds during which this process ran.

    An interval in which the process was frozen or starved counts as one second. `now` must
    therefore be called at least once a second.

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
                f"The learner has not answered for {self.limit:g} s: {error}",
                "Start the actor again later.",
            ) from None
        if silence > _NOTICED and now - self._noticed > _NOTICE_AGAIN:
            self._noticed = now
            limit = "" if math.isinf(self.limit) else f" for up to {self.limit:g} s"
            _log.warning("The learner does not answer; waiting%s: %s", limit, error)


class _Upload(NamedTuple):
    """A rollout in the queue."""

    message: Message
    outcome: "Future[Outcome]"


class Uploads:
    """Threads that send rollouts.

    Attributes:
      failure: the reason why sending has stopped, if it has; also set by the owner.
      journal: records the outcome of each rollout, if the owner sets it.
      free: acquired by the owner for each queued rollout; released when that rollout has its
        outcome.
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
        """
        self.failure: CongraspError | None = None
        self.journal: Journal | None = None
        self.free = threading.Semaphore(window)
        self.closed = threading.Event()
        self._transport, self._key, self._on_reply = transport, key, on_reply
        self._max_refusals, self._timeout, self._patience = max_refusals, request_timeout, patience
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
        # Repeating a query in transit would only fill a slow link; a dead link ends the query by
        # itself.
        timeout = min(
            self._timeout + sum(a.nbytes for a in message.arrays.values()) / _SLOWEST,
            self._patience.limit,
        )
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
                if outcome != "retry" and self.journal is not None:
                    who = {name: message.meta[name] for name in ("actor", "incarnation")}
                    answer = {
                        "answer": message.meta["sequence"],
                        "outcome": outcome,
                        "session_id": reply.meta["session_id"],
                    }
                    self.journal.write(**who, **answer)
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


_POLL = 0.2
_CONFIG_SECONDS = 1.0
"""Deadline of a request for the configuration, after which a stop is noticed, s."""
OpenJournal = Callable[[str], Journal | None]
"""run id -> the journal of this actor's rollouts in that run; None for none."""


class RunRestarted(CongraspError):
    """The learner started another training: read the configuration again and start over."""


class RunFinished(CongraspError):
    """The learner needs no more rollouts."""


class RunInfo(NamedTuple):
    """Properties of a run that an actor needs."""

    config: str
    """The run's configuration as JSON text."""
    run_id: str
    """Identifies the training."""
    schema: str
    """Required policy schema of rollouts."""
    arrays: tuple[str, ...]
    """Names of the required arrays of rollouts (`common.wire.messages.RECORDABLE`)."""


class Ticket(NamedTuple):
    """Permission to produce one rollout."""

    id: str
    version: int
    """Policy version of the learner when it was granted."""


class ActorLink(Closing):
    """An actor's connection to its learner, for use by one thread."""

    def __init__(  # noqa: PLR0913
        self,
        transport: Transport,
        run: str,
        actor: str,
        *,
        window: int = 1,
        max_refusals: int = 5,
        request_timeout: float = 10.0,
        patience: float = 300.0,
        journal: OpenJournal | None = None,
    ):
        """Announces the actor.

        Args:
          transport: a connected transport.
          run: name of the run.
          actor: the actor's name, unique in the run.
          window: most rollouts in transit.
          max_refusals: consecutive refused rollouts after which the link fails.
          request_timeout: deadline of a request in seconds, extended by the size of a rollout.
          patience: seconds without a reply after which the link fails.
          journal: opens the record of every rollout and its outcome, once the run is known.
        """
        self.keys = Keys(run)
        self.actor = actor
        self._ticket_key, self._weights_key = (
            self.keys.ticket(actor),
            self.keys.weights_for("actor", actor),
        )
        self.incarnation = secrets.token_hex(4)
        self._transport = transport
        self._timeout = request_timeout
        self._patience = Patience(patience)  # read often by the thread that receives announcements
        self._info: RunInfo | None = None
        self._learner = (-1, "")  # version and session last reported by the learner
        self._held_session = ""
        self._finished = False
        self._answered = self._patience.now()
        self._wanted = secrets.token_hex(8)  # the next ticket's id, kept until it is granted
        self._sequence = itertools.count()
        self._open_journal = journal
        self._journal: Journal | None = None
        self._news = threading.Event()
        self._uploads = Uploads(
            transport,
            self.keys.rollout(actor),
            self._note,
            window=window,
            max_refusals=max_refusals,
            request_timeout=request_timeout,
            patience=self._patience,
        )
        self._closed = self._uploads.closed
        self._announcements = transport.subscribe(self.keys.announcement, depth=1)
        transport.declare_alive(self.keys.alive("actor", actor, self.incarnation))
        threading.Thread(target=self._follow, daemon=True, name="announcements").start()

    def config(self, timeout: float) -> RunInfo:
        """Reads the run's configuration, opens the journal of the run, and follows it from now on.

        Raises:
          TransportError: the learner did not answer within `timeout` seconds.
        """
        reply = self._ask(self.keys.config, {}, self._patience.now() + timeout)
        config, run_id, schema = (str(reply.meta[name]) for name in ("config", "run_id", "schema"))
        self._info = RunInfo(config, run_id, schema, tuple(reply.meta["arrays"]))
        self._note(reply.meta)
        if self._open_journal is not None and self._journal is None:
            self._journal = self._open_journal(check_name("run", run_id))
            self._uploads.journal = self._journal
            self._write()
        self._uploads.start_over()
        return self._info

    def wait_for_config(self, stop: threading.Event) -> RunInfo | None:
        """Reads the run's configuration as soon as the learner answers; returns None if stopped.

        Raises:
          TransportError: the learner has been silent for too long.
          RefusedError: it refuses this actor.
        """
        while not stop.is_set():
            try:
                return self.config(_CONFIG_SECONDS)
            except RefusedError:
                raise
            except TransportError as error:
                self._patience.check(self._answered, error)
        return None

    def acquire_ticket(self, timeout: float) -> Ticket | None:
        """Waits for permission to produce a rollout; returns None if there is none within `timeout`
        seconds.

        An unreachable learner grants nothing.

        Raises:
          RunRestarted, RunFinished: see these classes.
          CongraspError: the learner refused too many rollouts, or has been silent for too long.
        """
        deadline = self._patience.now() + timeout
        while True:
            self._check()
            self._news.clear()
            try:
                reply = self._ask(self._ticket_key, self._identity(self._wanted), deadline)
            except RefusedError:
                raise
            except TransportError as error:
                self._patience.check(self._answered, error)
                return None
            self._note(reply.meta)
            self._check()
            if reply.meta["granted"]:
                ticket, self._wanted = self._wanted, secrets.token_hex(8)
                return Ticket(ticket, int(reply.meta["version"]))
            delay = min(float(reply.meta["retry_after"]), deadline - self._patience.now())
            if delay <= 0:
                return None
            self._news.wait(delay)

    def give_back(self, ticket: Ticket) -> None:
        """Returns a ticket that is not needed; if that fails, it expires."""
        request = Message(meta={**self._identity(ticket.id), "give_back": True})
        with contextlib.suppress(TransportError):
            self._transport.query(self._ticket_key, request, timeout=self._timeout)

    def weights(self, newer_than: int) -> Message | None:
        """Returns the latest policy bundle, or None if the caller has it already or the learner is
        unreachable.

        Sends no request unless the learner has announced another version.

        Args:
          newer_than: the version that the caller has; -1 for none.

        Raises:
          RunRestarted, RunFinished: see these classes.
          CongraspError: see `acquire_ticket`.
        """
        self._check()
        if newer_than >= 0 and (newer_than, self._held_session) == self._learner:
            return None
        session = self._learner[1]
        request = Message(meta={"newer_than": newer_than, "session_id": self._held_session})
        try:
            reply = self._transport.query(self._weights_key, request, timeout=self._timeout)
        except TransportError:
            return None
        if not reply.arrays:
            self._note(reply.meta)
            self._check()
            return None
        if self._info and reply.meta.get("run_id") != self._info.run_id:
            self._uploads.failure = _restarted(self._info.run_id, reply.meta.get("run_id"))
        self._check()
        self._held_session = session
        return reply

    def upload(self, rollout: Message, ticket: Ticket) -> "Future[Outcome]":
        """Queues a rollout for sending in the background; waits while `window` others are in
        transit.

        Args:
          rollout: arrays and meta entries `version`, `schema` and `steps`; the link adds the
            identity.
          ticket: ticket of the rollout.

        Returns:
          Future of its outcome.

        Raises:
          RunRestarted, RunFinished: see these classes; this rollout is not sent.
          CongraspError: the learner refused too many rollouts, or has been silent for too long.
        """
        self._check()
        if self._info is None:
            raise CongraspError("The link has no configuration yet.", "Call 'config' first.")
        while not self._uploads.free.acquire(timeout=_POLL):
            self._check()
        self._check()
        meta = {
            **rollout.meta,
            **self._identity(ticket.id),
            "sequence": next(self._sequence),
            "run_id": self._info.run_id,
        }
        message = SharedMessage(rollout.arrays, meta)
        if self._journal is not None:
            self._write(made=meta["sequence"], version=meta["version"], checksum=checksum(message))
        return self._uploads.put(message)

    def flush(self, timeout: float) -> bool:
        """Waits until every rollout has its outcome; False if that takes longer than `timeout`
        seconds.
        """
        return self._uploads.wait(timeout)

    def close(self) -> None:
        """Stops sending; rollouts without an outcome are abandoned. The transport stays open."""
        self._uploads.close()
        self._announcements.close()

    def _identity(self, ticket: str) -> dict[str, Any]:
        """Identity and ticket, as metadata entries of the actor's requests."""
        return {"actor": self.actor, "incarnation": self.incarnation, "ticket": ticket}

    def _check(self) -> None:
        """Raises the error that stops the link: a failure of the uploads, the end of the run, or
        its closing.
        """
        if self._uploads.failure:
            raise self._uploads.failure
        if self._finished:
            raise RunFinished("The run is finished.")
        if self._closed.is_set():
            raise CongraspError("The link is closed.")

    def _note(self, meta: Any) -> None:
        """Records the learner's state, which comes with every reply and announcement."""
        self._answered = self._patience.now()
        self._learner = int(meta["version"]), str(meta["session_id"])
        self._finished = bool(meta["finished"])
        if self._info and meta["run_id"] != self._info.run_id:
            self._uploads.failure = _restarted(self._info.run_id, meta["run_id"])

    def _follow(self) -> None:
        """Receives announcements in the background."""
        while not self._closed.is_set():
            self._patience.now()
            received = self._announcements.receive(_POLL)
            if received is None:
                self._closed.wait(0.01)  # a closed transport does not wait
                continue
            with contextlib.suppress(KeyError, TypeError, ValueError):  # invalid message
                self._note(received[1].meta)
                self._news.set()

    def _ask(self, key: str, meta: dict[str, Any], deadline: float) -> Message:
        """Sends a request until there is a reply, which may be a refusal."""
        delays = backoff()
        while True:
            rest = max(0.05, deadline - self._patience.now())
            try:
                return self._transport.query(
                    key, Message(meta=meta), timeout=min(self._timeout, rest)
                )
            except RefusedError:
                raise
            except TransportError:
                rest = deadline - self._patience.now()
                if rest <= 0 or self._closed.wait(min(next(delays), rest)):
                    raise

    def _write(self, **entry: Any) -> None:
        """Writes an entry into the journal, if there is one."""
        if self._journal is not None:
            self._journal.write(actor=self.actor, incarnation=self.incarnation, **entry)


def _restarted(before: str, now: Any) -> RunRestarted:
    """Error for a changed run id."""
    return RunRestarted(
        f"The learner started another training (run id {now} after {before}).",
        "The actor starts over.",
    )
