"""Actor side of the link: configuration, tickets, weights, and exactly-once delivery of rollouts.

`upload` assigns a rollout its identity (actor, incarnation, sequence), under which it is sent until
the learner replies, across restarts of the learner (`actors.uploads`). Sending happens in the
background, while the next rollout is produced; a limited number of rollouts is in transit, further
ones wait in `upload`.

Over a slow network, tickets and weights are requested in the background, too, before they are
needed (`actors.pace`). A rollout is then produced with a policy that is at least as new as its
ticket requires. The learner promises that such a rollout is not too old when it is used, if it
arrives before those of later tickets; the actor adds the updates that have passed meanwhile.
"""

import collections
import contextlib
import functools
import itertools
import secrets
import threading
import time
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, wait
from typing import Any, NamedTuple, TypeVar

from congrasp.actors.pace import Pace, UploadWindow
from congrasp.actors.patience import Patience, backoff
from congrasp.actors.uploads import Outcome, Uploads
from congrasp.common.errors import CongraspError, RefusedError, TransportError
from congrasp.common.io.journal import Journal
from congrasp.common.transport.base import Closing, Transport
from congrasp.common.transport.keys import Keys, check_name
from congrasp.common.wire.codec import Message, SharedMessage, checksum

_POLL_S = 0.2
_CONFIG_TIMEOUT_S = 1.0
"""Deadline of a request for the configuration, after which a stop is noticed."""
_NO_ANSWER_YET = "The learner has not answered yet, perhaps because it is starting"
_TICKET_TIMEOUT_S = 60.0
"""Deadline of a ticket that is requested in the background."""
_MAX_TICKETS_AHEAD = 4
"""Most tickets that are requested before they are needed."""
_MEASURED_ROLLOUTS = 16
"""Latest rollouts during which updates are counted."""
_Result = TypeVar("_Result")
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
    required_version: int = -1
    """Oldest policy version with which the rollout is not too old when it is used."""


class _Weights(NamedTuple):
    """A policy bundle as it was received."""

    bundle: Message
    session: str
    """Session of the learner before the request."""


class ActorLink(Closing):
    """An actor's connection to its learner, for use by one thread."""

    def __init__(  # noqa: PLR0913
        self,
        transport: Transport,
        run: str,
        actor: str,
        *,
        window: int = 1,
        max_window: int = 8,
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
          window: rollouts in transit at first, and at least.
          max_window: most rollouts in transit, over a slow network.
          max_refusals: consecutive refused rollouts after which the link fails.
          request_timeout: deadline of a request in seconds, extended by the size of a rollout.
          patience: seconds without a reply after which the link fails.
          journal: opens the record of every rollout and its outcome, once the run is known.
        """
        self.keys = Keys(run)
        self.actor = actor
        self._ticket_key = self.keys.ticket(actor)
        self._weights_key = self.keys.weights_for("actor", actor)
        self.incarnation = secrets.token_hex(4)
        self._transport = transport
        self._timeout = request_timeout
        self._patience = Patience(patience)  # read often by the thread that receives announcements
        self._info: RunInfo | None = None
        self._learner = (-1, "")  # version and session last reported by the learner
        self._held_session = ""
        self._finished = False
        self._answered = self._patience.now()
        self._next_ticket = _new_ticket_id()
        self._pace = Pace()
        self._rollout_began = time.monotonic()
        self._passed_updates = collections.deque[int](maxlen=_MEASURED_ROLLOUTS)
        self._tickets_ahead: list[Future[Ticket | None]] = []
        self._held_version = -1
        self._weights_lock = threading.Lock()
        self._weights_ahead: Future[_Weights | None] | None = None
        self._sequence = itertools.count()
        self._open_journal = journal
        self._journal: Journal | None = None
        self._news = threading.Condition()
        self._announced = 0
        self._uploads = Uploads(
            transport,
            self.keys.rollout(actor),
            self._note,
            window=UploadWindow(window, max(window, max_window)),
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
        self._info = RunInfo(
            config=str(reply.meta["config"]),
            run_id=str(reply.meta["run_id"]),
            schema=str(reply.meta["schema"]),
            arrays=tuple(reply.meta["arrays"]),
        )
        self._note(reply.meta)
        if self._open_journal is not None and self._journal is None:
            self._journal = self._open_journal(check_name("run", self._info.run_id))
            self._uploads.journal = self._journal
            self._write()
        self._uploads.start_over()
        self._tickets_ahead.clear()
        self._weights_ahead = None
        return self._info

    def wait_for_config(self, stop: threading.Event) -> RunInfo | None:
        """Reads the run's configuration as soon as the learner answers; returns None if stopped.

        Raises:
          TransportError: the learner has been silent for too long.
          RefusedError: it refuses this actor.
        """
        while not stop.is_set():
            try:
                return self.config(_CONFIG_TIMEOUT_S)
            except RefusedError:
                raise
            except TransportError as error:
                self._patience.check(self._answered, error, _NO_ANSWER_YET)
        return None

    def acquire_ticket(self, timeout: float) -> Ticket | None:
        """Waits for permission to produce a rollout; returns None if there is none within `timeout`
        seconds.

        An unreachable learner grants nothing.

        Raises:
          RunRestarted, RunFinished: see these classes.
          CongraspError: the learner refused too many rollouts, or has been silent for too long.
        """
        self._check()
        if self._tickets_ahead:
            ticket = self._ticket_ahead(timeout)
        else:
            ticket = self._request_ticket(self._next_ticket, timeout)
            if ticket is not None:
                self._next_ticket = _new_ticket_id()
        if ticket is not None:
            self._request_ahead()
        self._rollout_began = time.monotonic()
        return ticket

    def _request_ahead(self) -> None:
        """Requests tickets in the background, if waiting for them would delay the next rollouts."""
        ahead = self._pace.overlap_count("ticket", _MAX_TICKETS_AHEAD)
        while len(self._tickets_ahead) < ahead:
            request = functools.partial(self._request_ticket, _new_ticket_id(), _TICKET_TIMEOUT_S)
            self._tickets_ahead.append(_in_background(request))

    def _ticket_ahead(self, timeout: float) -> Ticket | None:
        """Returns a ticket that was requested ahead; None if none is granted within `timeout`
        seconds.

        It need not be the one that was requested first: the learner may grant them in any order.
        """
        done, _ = wait(self._tickets_ahead, timeout, return_when=FIRST_COMPLETED)
        self._check()
        if not done:
            return None
        granted = done.pop()
        self._tickets_ahead.remove(granted)
        return granted.result()

    def _request_ticket(self, ticket_id: str, timeout: float) -> Ticket | None:
        """Requests a ticket until it is granted; None if that takes longer than `timeout` seconds,
        or if the learner cannot be reached.
        """
        deadline = self._patience.now() + timeout
        while True:
            self._check()
            announced = self._announced
            began = time.monotonic()
            try:
                reply = self._ask(self._ticket_key, self._identity(ticket_id), deadline)
            except RefusedError:
                raise
            except TransportError as error:
                self._patience.check(self._answered, error)
                return None
            self._pace.record("ticket", time.monotonic() - began)
            self._note(reply.meta)
            self._check()
            if reply.meta["granted"]:
                return self._ticket_of(ticket_id, reply)
            delay = min(float(reply.meta["retry_after"]), deadline - self._patience.now())
            if delay <= 0:
                return None
            self._wait_for_news(announced, delay)

    def _ticket_of(self, ticket_id: str, reply: Message) -> Ticket:
        """Returns a ticket, whose required version allows for the updates during a rollout."""
        version = int(reply.meta["version"])
        required = int(reply.meta.get("required_version", version))
        passed = max(list(self._passed_updates), default=0)
        return Ticket(ticket_id, version, min(version, required + passed))

    def _wait_for_news(self, announced: int, timeout: float) -> None:
        """Waits until the learner has made more announcements than `announced`."""
        with self._news:
            self._news.wait_for(lambda: self._announced != announced, timeout)

    def give_back(self, ticket: Ticket) -> None:
        """Returns a ticket that is not needed; if that fails, it expires."""
        request = Message(meta={**self._identity(ticket.id), "give_back": True})
        with contextlib.suppress(TransportError):
            self._transport.query(self._ticket_key, request, timeout=self._timeout)

    def weights(self, newer_than: int, required: int | None = None) -> Message | None:
        """Returns the latest policy bundle, or None if the caller keeps its policy.

        That is the case if the caller has the latest policy, if the learner is unreachable, and
        while a later policy is in transit.

        Sends no request unless the learner has announced another version.

        Args:
          newer_than: the version that the caller has; -1 for none.
          required: the oldest version that will do, as the ticket says: a policy on its way is
            then waited for only if the caller's is older. None waits for the latest.

        Raises:
          RunRestarted, RunFinished: see these classes.
          CongraspError: see `acquire_ticket`.
        """
        self._check()
        self._held_version = newer_than
        newest = None
        while not self._is_latest():
            self._fetch_ahead()
            fetching = self._weights_ahead
            if fetching is None:  # it became the latest meanwhile
                break
            if not self._must_wait(required) and not fetching.done():
                break
            fetched = fetching.result()
            self._weights_ahead = None
            self._check()
            if fetched is None:
                break
            self._held_version = int(fetched.bundle.meta["version"])
            self._held_session = fetched.session
            newest = fetched.bundle
            if required is None or self._held_version >= required:
                break
        self._rollout_began = time.monotonic()
        return newest

    def _is_latest(self) -> bool:
        """True if the caller has the latest policy that the learner has announced."""
        return self._held_version >= 0 and self._learner == (
            self._held_version,
            self._held_session,
        )

    def _must_wait(self, required: int | None) -> bool:
        """True if a policy on its way is waited for: the caller's is too old, or the wait is
        short.
        """
        if self._held_session != self._learner[1]:
            return True
        if required is None or self._held_version < required:
            return True
        return not self._pace.overlap_count("weights", 1)

    def _fetch_ahead(self) -> None:
        """Fetches the latest policy in the background, unless the caller has it or that is being
        done.
        """
        with self._weights_lock:
            if self._weights_ahead is not None or self._is_latest():
                return
            fetch = functools.partial(self._fetch_weights, self._held_version, self._held_session)
            self._weights_ahead = _in_background(fetch)

    def _fetch_weights(self, newer_than: int, held_session: str) -> "_Weights | None":
        """Requests the latest policy bundle; None if the caller has it, or on failure.

        Args:
          newer_than: version that the caller has.
          held_session: session of that version.
        """
        _, session = self._learner
        request = Message(meta={"newer_than": newer_than, "session_id": held_session})
        began = time.monotonic()
        try:
            reply = self._transport.query(self._weights_key, request, timeout=self._timeout)
        except TransportError:
            return None
        if not reply.arrays:
            self._note(reply.meta)
            return None
        self._pace.record("weights", time.monotonic() - began)
        if self._info and reply.meta.get("run_id") != self._info.run_id:
            self._uploads.failure = _restart_error(self._info.run_id, reply.meta.get("run_id"))
        return _Weights(reply, session)

    def upload(self, rollout: Message, ticket: Ticket) -> "Future[Outcome]":
        """Queues a rollout for sending in the background; waits while too many others are in
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
        while not self._uploads.window.enter(_POLL_S):
            self._check()
        self._pace.record("rollout", time.monotonic() - self._rollout_began)
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
        outcome = self._uploads.put(message)
        outcome.add_done_callback(functools.partial(self._count_updates, ticket))
        return outcome

    def _count_updates(self, ticket: Ticket, outcome: "Future[Outcome]") -> None:
        """Counts the updates between a ticket and the outcome of its rollout."""
        version, _ = self._learner
        self._passed_updates.append(max(0, version - ticket.version))

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
            self._uploads.failure = _restart_error(self._info.run_id, meta["run_id"])

    def _follow(self) -> None:
        """Receives announcements in the background."""
        while not self._closed.is_set():
            self._patience.now()
            received = self._announcements.receive(_POLL_S)
            if received is None:
                self._closed.wait(0.01)  # a closed transport does not wait
                continue
            _, message = received
            with contextlib.suppress(KeyError, TypeError, ValueError):  # invalid message
                self._note(message.meta)
                with self._news:
                    self._announced += 1
                    self._news.notify_all()
                if self._pace.overlap_count("weights", 1):
                    self._fetch_ahead()

    def _ask(self, key: str, meta: dict[str, Any], deadline: float) -> Message:
        """Sends a request until there is a reply, which may be a refusal."""
        delays = backoff()
        while True:
            rest = max(0.05, deadline - self._patience.now())
            timeout = min(self._timeout, rest)
            try:
                return self._transport.query(key, Message(meta=meta), timeout=timeout)
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


def _in_background(request: Callable[[], _Result]) -> "Future[_Result]":
    """Makes a request in a thread that does not delay the end of the process."""
    future = Future[_Result]()

    def run() -> None:
        try:
            future.set_result(request())
        except Exception as error:
            future.set_exception(error)

    threading.Thread(target=run, daemon=True, name="request").start()
    return future


def _new_ticket_id() -> str:
    """Returns an id for a ticket that is to be requested."""
    return secrets.token_hex(8)


def _restart_error(before: str, now: Any) -> RunRestarted:
    """Error for a changed run id."""
    return RunRestarted(
        f"The learner started another training (run id {now} after {before}).",
        "The actor starts over.",
    )
