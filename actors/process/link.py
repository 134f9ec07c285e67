"""The actor's end of the link: configuration, tickets, weights, and rollouts that arrive exactly once.

A rollout gets its identity (actor, incarnation, sequence) when it is handed over, and is sent under that identity until
the learner has answered it, across restarts of the learner (`uploads`). Sending happens in the background, so that the
next rollout is made meanwhile; at most `window` rollouts are on their way, further ones wait in `upload`.
"""

import contextlib
import itertools
import secrets
import threading
from concurrent.futures import Future
from typing import Any, NamedTuple, Self

from congrasp.actors.process.uploads import Outcome, Patience, Uploads, backoff
from congrasp.common.errors import CongraspError, RefusedError, TransportError
from congrasp.common.io.journal import Journal
from congrasp.common.transport.base import Transport
from congrasp.common.transport.keys import Keys
from congrasp.common.wire.codec import Message, SharedMessage, checksum

_POLL = 0.2


class RunRestarted(CongraspError):
    """The learner began another training: read the configuration anew and start over."""


class RunFinished(CongraspError):
    """The learner needs no more rollouts."""


class RunInfo(NamedTuple):
    """What an actor must know of a run."""

    config: str
    """The run's configuration as JSON text."""
    run_id: str
    """Identifies the training."""
    schema: str
    """Policy schema that rollouts must have."""
    arrays: tuple[str, ...]
    """Names of the arrays that rollouts must have (`common.wire.schema.RECORDABLE`)."""


class Ticket(NamedTuple):
    """Permission to make one rollout."""

    id: str
    version: int
    """The learner's policy version when it was granted."""


class ActorLink:
    """An actor's connection to its learner; one thread uses it."""

    def __init__(
        self,
        transport: Transport,
        run: str,
        actor: str,
        *,
        window: int = 1,
        max_refusals: int = 5,
        request_timeout: float = 10.0,
        patience: float = 300.0,
        journal: Journal | None = None,
    ):
        """Announces the actor.

        Args:
          transport: a connected transport.
          run: name of the run.
          actor: the actor's name, unique in the run.
          window: rollouts on their way at a time.
          max_refusals: rollouts refused in a row after which the link fails.
          request_timeout: seconds that one request may take; a rollout gets more, by its size.
          patience: seconds without any answer after which the link gives the learner up.
          journal: where every rollout and each answer to it is written down; it stays the caller's.
        """
        self.keys = Keys(run)
        self.actor = actor
        self._ticket_key, self._weights_key = self.keys.ticket(actor), self.keys.weights_for("actor", actor)
        self.incarnation = secrets.token_hex(4)
        self._transport = transport
        self._timeout = request_timeout
        self._patience = Patience(patience)  # which the thread that follows announcements reads often
        self._info: RunInfo | None = None
        self._learner = (-1, "")  # version and session that the learner showed last
        self._held_session = ""
        self._finished = False
        self._answered = self._patience.now()
        self._wanted = secrets.token_hex(8)  # the next ticket's id, kept until it is granted
        self._sequence = itertools.count()
        self._journal = journal
        self._news = threading.Event()
        self._uploads = Uploads(
            transport,
            self.keys.rollout(actor),
            self._note,
            window=window,
            max_refusals=max_refusals,
            request_timeout=request_timeout,
            patience=self._patience,
            journal=journal,
        )
        self._closed = self._uploads.closed
        self._write()
        self._announcements = transport.subscribe(self.keys.announcement, depth=1)
        transport.declare_alive(self.keys.alive("actor", actor, self.incarnation))
        threading.Thread(target=self._follow, daemon=True, name="announcements").start()

    def config(self, timeout: float) -> RunInfo:
        """Reads the run's configuration, and follows this run from now on.

        Raises:
          TransportError: the learner did not answer within `timeout` seconds.
        """
        reply = self._ask(self.keys.config, {}, self._patience.now() + timeout)
        config, run_id, schema = (str(reply.meta[name]) for name in ("config", "epoch", "schema"))
        self._info = RunInfo(config, run_id, schema, tuple(reply.meta["arrays"]))
        self._note(reply.meta)
        self._uploads.start_over()
        return self._info

    def acquire_ticket(self, timeout: float) -> Ticket | None:
        """Waits for permission to make a rollout; None if there is none within `timeout` seconds.

        A learner that is away counts as one that grants nothing.

        Raises:
          RunRestarted, RunFinished: see there.
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
        """The latest policy bundle, or None if it is the one that the caller has or the learner is away.

        Costs no request as long as the learner has shown no other version.

        Args:
          newer_than: the version that the caller has; -1 for none.

        Raises:
          RunRestarted: see there.
        """
        self._check()
        if newer_than >= 0 and (newer_than, self._held_session) == self._learner:
            return None
        session = self._learner[1]
        request = Message(meta={"newer_than": newer_than, "life": self._held_session})
        try:
            reply = self._transport.query(self._weights_key, request, timeout=self._timeout)
        except TransportError:
            return None
        if not reply.arrays:
            self._note(reply.meta)
            self._check()
            return None
        if self._info and reply.meta.get("epoch") != self._info.run_id:
            self._uploads.failure = _restarted(self._info.run_id, reply.meta.get("epoch"))
        self._check()
        self._held_session = session
        return reply

    def upload(self, rollout: Message, ticket: Ticket) -> "Future[Outcome]":
        """Hands a rollout over, to be sent in the background; waits while `window` others are on their way.

        Args:
          rollout: arrays and meta entries `version`, `schema` and `steps`; the link adds who made it.
          ticket: what it was made under.

        Returns:
          Its outcome, once the learner has answered.

        Raises:
          RunRestarted: see there; this rollout is not sent.
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
            "epoch": self._info.run_id,
        }
        message = SharedMessage(rollout.arrays, meta)
        if self._journal is not None:
            self._write(made=meta["sequence"], version=meta["version"], checksum=checksum(message))
        return self._uploads.put(message)

    def flush(self, timeout: float) -> bool:
        """Waits until every rollout has its outcome; False if that takes longer than `timeout` seconds."""
        return self._uploads.wait(timeout)

    def close(self) -> None:
        """Stops sending; what has no outcome yet is given up. The transport stays open."""
        self._uploads.close()
        self._announcements.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _identity(self, ticket: str) -> dict[str, Any]:
        """Who asks, and by which ticket: meta entries of the actor's requests."""
        return {"actor": self.actor, "incarnation": self.incarnation, "ticket": ticket}

    def _check(self) -> None:
        """Raises what stops the link: a failure of the uploads, the end of the run, or its own closing."""
        if self._uploads.failure:
            raise self._uploads.failure
        if self._finished:
            raise RunFinished("The run is finished.")
        if self._closed.is_set():
            raise CongraspError("The link is closed.")

    def _note(self, meta: Any) -> None:
        """Takes in the learner's state, which comes with every answer and announcement."""
        self._answered = self._patience.now()
        self._learner = int(meta["version"]), str(meta["life"])
        self._finished = bool(meta["finished"])
        if self._info and meta["epoch"] != self._info.run_id:
            self._uploads.failure = _restarted(self._info.run_id, meta["epoch"])

    def _follow(self) -> None:
        """Takes announcements in as they come, whatever the caller is doing meanwhile."""
        while not self._closed.is_set():
            self._patience.now()
            received = self._announcements.receive(_POLL)
            if received is None:
                self._closed.wait(0.01)  # a closed transport does not wait
                continue
            with contextlib.suppress(KeyError, TypeError, ValueError):  # from nobody who speaks this language
                self._note(received[1].meta)
                self._news.set()

    def _ask(self, key: str, meta: dict[str, Any], deadline: float) -> Message:
        """Asks until there is an answer; a refusal is one."""
        delays = backoff()
        while True:
            rest = max(0.05, deadline - self._patience.now())
            try:
                return self._transport.query(key, Message(meta=meta), timeout=min(self._timeout, rest))
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
    """The error of a run id that is another than before."""
    return RunRestarted(f"The learner began another training (run id {now} after {before}).", "The actor starts over.")
