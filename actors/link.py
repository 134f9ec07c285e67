"""The actor's end of the link: configuration, tickets, weights, and rollouts that arrive exactly once.

A rollout gets its identity (actor, incarnation, sequence) when it is handed over, and is sent under that identity until
the learner has answered it, across restarts of the learner. Sending happens in the background, so that the next rollout
is made meanwhile; at most `window` rollouts are on their way, further ones wait in `upload`.

A learner that is killed takes with it what it had accepted since its last checkpoint. So accepted rollouts are kept, a
few in all: those that are fresh, and those that will be when the learner goes on from that checkpoint. Its next life is
sent them again before any new ticket is asked for; what it has after all is a duplicate to it.
"""

import contextlib
import itertools
import queue
import secrets
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Literal, NamedTuple, Self

import numpy as np

from common.errors import CongraspError, TransportError
from common.journal import Journal
from common.transport.base import RefusedError, Transport
from common.transport.keys import Keys
from common.wire.codec import Message, SharedMessage, checksum

Outcome = Literal["accepted", "duplicate", "stale", "refused"]
"""What became of a rollout; `duplicate` means that it had been accepted before, `stale` that it was too old."""
_BACKOFF = (0.1, 0.5)  # first and longest pause between two attempts, s
_POLL = 0.2
_SLOWEST = 100e3  # bytes a second of a link that is waited for


class RunRestarted(CongraspError):
    """The learner began another training: read the configuration anew and start over."""


class RunFinished(CongraspError):
    """The learner needs no more rollouts."""


class RunInfo(NamedTuple):
    """What the learner says about its run."""

    config: str
    """The run's configuration as JSON text."""
    epoch: str
    """Identifies the training."""
    schema: str
    """Policy schema that rollouts must have."""


class Ticket(NamedTuple):
    """Permission to make one rollout."""

    id: str
    version: int
    """The learner's policy version when it was granted."""


class _Upload(NamedTuple):
    message: Message
    outcome: "Future[Outcome] | None"
    """None for one that is sent again."""


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
        keep: bool = True,
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
          keep: keep accepted rollouts for a learner's next life; needless where actor and learner die together.
          journal: where every rollout and each answer to it is written down; it stays the caller's.
        """
        self.keys = Keys(run)
        self.actor = actor
        self._ticket_key, self._rollout_key = self.keys.ticket(actor), self.keys.rollout(actor)
        self.incarnation = secrets.token_hex(4)
        self._transport = transport
        self._max_refusals = max_refusals
        self._timeout = request_timeout
        self._patience = patience
        self._info: RunInfo | None = None
        self._learner = (-1, "")  # version and life that the learner showed last
        self._held_life = ""
        self._finished = False
        self._answered = time.monotonic()
        self._wanted = secrets.token_hex(8)  # the next ticket's id, kept until it is granted
        self._sequence = itertools.count()
        self._refusals = 0
        self._failure: CongraspError | None = None
        self._free = threading.Semaphore(window)
        self._uploads: queue.SimpleQueue[_Upload | None] = queue.SimpleQueue()
        self._pending: set[Future[Outcome]] = set()
        self._closed = threading.Event()
        self._keep, self._journal = keep, journal
        self._news = threading.Event()
        self._lock = threading.Lock()  # of the next two
        self._kept: dict[int, Message] = {}
        self._owed = 0  # rollouts that are being sent again
        self._write(actor=actor, incarnation=self.incarnation)
        self._announcements = transport.subscribe(self.keys.announcement, depth=1)
        transport.declare_alive(self.keys.alive("actor", actor, self.incarnation))
        threading.Thread(target=self._follow, daemon=True, name="announcements").start()
        for index in range(window):
            threading.Thread(target=self._upload_all, daemon=True, name=f"upload-{index}").start()

    def config(self, timeout: float) -> RunInfo:
        """Reads the run's configuration, and follows its epoch from now on.

        Raises:
          TransportError: the learner did not answer within `timeout` seconds.
        """
        reply = self._ask(self.keys.config, {}, time.monotonic() + timeout)
        self._info = RunInfo(str(reply.meta["config"]), str(reply.meta["epoch"]), str(reply.meta["schema"]))
        self._note(reply.meta)
        self._failure, self._refusals = None, 0
        return self._info

    def acquire_ticket(self, timeout: float) -> Ticket | None:
        """Waits for permission to make a rollout; None if there is none within `timeout` seconds.

        A learner that is away counts as one that grants nothing.

        Raises:
          RunRestarted, RunFinished: see there.
          CongraspError: the learner refused too many rollouts, or has been silent for too long.
        """
        deadline = time.monotonic() + timeout
        while True:
            self._check()
            if self._owed:
                rest = deadline - time.monotonic()
                if rest <= 0:
                    return None
                self._closed.wait(min(_POLL, rest))
                continue
            self._news.clear()
            try:
                reply = self._ask(self._ticket_key, self._identity(self._wanted), deadline)
            except RefusedError:
                raise
            except TransportError as error:
                self._despair(self._answered, error)
                return None
            self._note(reply.meta)
            self._check()
            if reply.meta["granted"]:
                ticket, self._wanted = self._wanted, secrets.token_hex(8)
                return Ticket(ticket, int(reply.meta["version"]))
            pause = min(float(reply.meta["retry_after"]), deadline - time.monotonic())
            if pause <= 0:
                return None
            self._news.wait(pause)

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
        if newer_than >= 0 and (newer_than, self._held_life) == self._learner:
            return None
        life = self._learner[1]
        request = Message(meta={"newer_than": newer_than, "life": self._held_life})
        try:
            reply = self._transport.query(self.keys.weights, request, timeout=self._timeout)
        except TransportError:
            return None
        if not reply.arrays:
            self._note(reply.meta)
            self._check()
            return None
        if self._info and reply.meta.get("epoch") != self._info.epoch:
            self._failure = _restarted(self._info.epoch, reply.meta.get("epoch"))
        self._check()
        self._held_life = life
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
        while not self._free.acquire(timeout=_POLL):
            self._check()
        self._check()
        meta = {
            **rollout.meta,
            **self._identity(ticket.id),
            "sequence": next(self._sequence),
            "epoch": self._info.epoch,
        }
        arrays = rollout.arrays
        if self._keep:
            arrays = {name: np.asarray(array) for name, array in arrays.items()}  # no device memory is held on to
        message, outcome = SharedMessage(arrays, meta), Future[Outcome]()
        if self._journal is not None:
            self._write(made=meta["sequence"], version=meta["version"], checksum=checksum(message))
        self._pending.add(outcome)
        outcome.add_done_callback(self._pending.discard)
        self._uploads.put(_Upload(message, outcome))
        return outcome

    def flush(self, timeout: float) -> bool:
        """Waits until every rollout has its outcome; False if that takes longer than `timeout` seconds."""
        deadline = time.monotonic() + timeout
        for outcome in list(self._pending):
            try:
                outcome.exception(max(0.0, deadline - time.monotonic()))
            except TimeoutError:
                return False
        return True

    def close(self) -> None:
        """Stops sending; what has no outcome yet is given up. The transport stays open."""
        self._closed.set()
        self._uploads.put(None)
        self._announcements.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _identity(self, ticket: str) -> dict[str, Any]:
        return {"actor": self.actor, "incarnation": self.incarnation, "ticket": ticket}

    def _check(self) -> None:
        if self._failure:
            raise self._failure
        if self._finished:
            raise RunFinished("The run is finished.")
        if self._closed.is_set():
            raise CongraspError("The link is closed.")

    def _note(self, meta: Any) -> None:
        """Takes in what every answer and announcement of the learner says about itself."""
        self._answered = time.monotonic()
        life = self._learner[1]
        self._learner = int(meta["version"]), str(meta["life"])
        self._finished = bool(meta["finished"])
        if self._info and meta["epoch"] != self._info.epoch:
            self._failure = _restarted(self._info.epoch, meta["epoch"])
        with self._lock:
            if life not in ("", meta["life"]):
                for message in self._kept.values():
                    self._owed += 1
                    self._uploads.put(_Upload(message, None))
                self._kept.clear()
            elif meta["version"] >= 0:
                first, last = meta["saved"]
                self._kept = {
                    sequence: kept
                    for sequence, kept in self._kept.items()
                    if kept.meta["version"] >= meta["oldest"] or first <= kept.meta["version"] <= last
                }

    def _follow(self) -> None:
        """Takes announcements in as they come, whatever the caller is doing meanwhile."""
        while not self._closed.is_set():
            received = self._announcements.receive(_POLL)
            if received is None:
                self._closed.wait(0.01)  # a closed transport does not wait
                continue
            with contextlib.suppress(KeyError, TypeError, ValueError):  # from nobody who speaks this language
                self._note(received[1].meta)
                self._news.set()

    def _ask(self, key: str, meta: dict[str, Any], deadline: float) -> Message:
        """Asks until there is an answer; a refusal is one."""
        pauses = _pauses()
        while True:
            rest = max(0.05, deadline - time.monotonic())
            try:
                return self._transport.query(key, Message(meta=meta), timeout=min(self._timeout, rest))
            except RefusedError:
                raise
            except TransportError:
                rest = deadline - time.monotonic()
                if rest <= 0 or self._closed.wait(min(next(pauses), rest)):
                    raise

    def _upload_all(self) -> None:
        while (upload := self._uploads.get()) is not None:
            outcome = upload.outcome or Future[Outcome]()
            try:
                outcome.set_result(self._deliver(upload.message))
            except CongraspError as error:
                self._failure = self._failure or error
                outcome.set_exception(error)
            except Exception as error:  # an answer that is none: the thread must not die in silence
                self._failure = CongraspError(f"The learner's answer cannot be understood: {error!r}.")
                outcome.set_exception(self._failure)
            finally:
                if upload.outcome is None:
                    with self._lock:
                        self._owed -= 1
                else:
                    self._free.release()
        self._uploads.put(None)

    def _write(self, **entry: Any) -> None:
        if self._journal is not None:
            self._journal.write(**entry)

    def _deliver(self, message: Message) -> Outcome:
        """Sends one rollout until it has an outcome."""
        answered = time.monotonic()
        damaged = 0
        # To send again what is still on its way would only fill a slow link; a dead one ends the query by itself.
        timeout = min(self._timeout + sum(a.nbytes for a in message.arrays.values()) / _SLOWEST, self._patience)
        pauses = _pauses()
        while not self._closed.is_set():
            pause = next(pauses)
            try:
                reply = self._transport.query(self._rollout_key, message, timeout=timeout)
            except RefusedError as error:  # it arrived damaged, or the learner failed on it
                damaged += 1
                answered = time.monotonic()
                if damaged >= self._max_refusals:
                    return self._refused(str(error))
            except TransportError as error:
                self._despair(answered, error)
            else:
                answered = time.monotonic()
                self._note(reply.meta)
                if self._failure:
                    raise self._failure
                outcome = reply.meta["outcome"]
                if outcome != "retry":
                    self._write(answer=message.meta["sequence"], outcome=outcome, life=reply.meta["life"])
                if outcome == "refused":
                    return self._refused(str(reply.meta["why"]))
                if outcome != "retry":
                    self._refusals = 0
                    if self._keep and outcome != "stale":
                        with self._lock:
                            self._kept[message.meta["sequence"]] = Message(message.arrays, message.meta)
                    return outcome
                pauses = _pauses()
                pause = float(reply.meta["retry_after"])
            self._closed.wait(pause)
        raise TransportError("The link was closed before the rollout was acknowledged.")

    def _despair(self, answered: float, error: TransportError) -> None:
        """Gives the learner up if its last answer was too long ago."""
        if time.monotonic() - answered > self._patience:
            raise TransportError(
                f"The learner has not answered for {self._patience:g} s: {error}", "Start the actor again later."
            ) from None

    def _refused(self, why: str) -> Outcome:
        self._refusals += 1
        if self._refusals >= self._max_refusals:
            self._failure = CongraspError(
                f"The learner refused {self._refusals} rollouts in a row: {why}",
                "Start the actor with the version of congrasp that the learner has.",
            )
        return "refused"


def _restarted(before: str, now: Any) -> RunRestarted:
    return RunRestarted(f"The learner began another training (epoch {now} after {before}).", "The actor starts over.")


def _pauses() -> "itertools.chain[float]":
    """Seconds to wait after the first, second, ... failed attempt."""
    first, longest = _BACKOFF
    growing: Callable[[int], float] = lambda index: min(longest, first * 2**index)  # noqa: E731
    return itertools.chain(map(growing, range(10)), itertools.repeat(longest))
