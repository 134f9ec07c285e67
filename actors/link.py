"""Actor side of the link: configuration, tickets, weights, and exactly-once delivery of rollouts.

`upload` assigns a rollout its identity (actor, incarnation, sequence), under which it is sent until
the learner replies, across restarts of the learner (`actors.uploads`). Sending happens in the
background, while the next rollout is produced; at most `window` rollouts are in transit, further
ones wait in `upload`.
"""

import contextlib
import itertools
import secrets
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, NamedTuple

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
        self._next_ticket = secrets.token_hex(8)  # its id, until it is granted
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
                reply = self._ask(self._ticket_key, self._identity(self._next_ticket), deadline)
            except RefusedError:
                raise
            except TransportError as error:
                self._patience.check(self._answered, error)
                return None
            self._note(reply.meta)
            self._check()
            if reply.meta["granted"]:
                granted = Ticket(self._next_ticket, int(reply.meta["version"]))
                self._next_ticket = secrets.token_hex(8)
                return granted
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
        _, session = self._learner
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
        while not self._uploads.free.acquire(timeout=_POLL_S):
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
            received = self._announcements.receive(_POLL_S)
            if received is None:
                self._closed.wait(0.01)  # a closed transport does not wait
                continue
            _, message = received
            with contextlib.suppress(KeyError, TypeError, ValueError):  # invalid message
                self._note(message.meta)
                self._news.set()

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


def _restarted(before: str, now: Any) -> RunRestarted:
    """Error for a changed run id."""
    return RunRestarted(
        f"The learner started another training (run id {now} after {before}).",
        "The actor starts over.",
    )
