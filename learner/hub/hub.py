"""Learner side of the link: receives rollouts, grants tickets, serves weights, and reports the run's status.

A rollout is identified by (actor, incarnation, sequence). It is acknowledged once it is queued and on disk, and an
acknowledged one is never accepted twice, however often its actor sends it.

The hub's part of a checkpoint (`durable`) is consistent with its weights: resuming from it undoes later decisions
together with the updates that used them. Their rollouts in the write-ahead log are accepted again before the first new
rollout. The rest appears as gaps in actors' sequences, counted as `missing`; so do overtaken rollouts until they
arrive. All others are counted once: as consumed, dropped, queued or stale.
"""

import collections
import secrets
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from congrasp.common.errors import CongraspError
from congrasp.common.transport.base import Transport
from congrasp.common.transport.keys import Keys, below, check_name, parse_alive
from congrasp.common.wire.codec import Message, SharedMessage
from congrasp.common.wire.messages import (
    TICKET,
    RolloutForm,
    RolloutHeader,
    validate,
    validate_bundle,
    validate_rollout,
)
from congrasp.learner.hub.admission import Admission
from congrasp.learner.hub.deduplication import SequenceTable
from congrasp.learner.hub.limits import DAMAGED, Members, RateLimit, sender
from congrasp.learner.hub.staleness import Owner, StalenessManager
from congrasp.learner.hub.used_rollouts import AuditLog
from congrasp.learner.hub.write_ahead import Identity, Recovered, WriteAheadLog

_RETRY_SECONDS = 0.25
_RATE_SECONDS = 10.0
_EVENT_SECONDS = 1.0  # seconds between two events of one kind
_PIECES = 40.0  # chunks of weights, of at most four mebibytes, per second for the owners of one certificate


class LearnerHub:
    """Serves a run's keys for the learner; thread-safe."""

    def __init__(
        self,
        transport: Transport,
        *,
        run: str,
        config_json: str,
        run_id: str,
        schema: str,
        form: RolloutForm,
        staleness: StalenessManager,
        queue_limit: int = 64,
        name: str = "0",
        durable: Mapping[str, Any] | None = None,
        on_event: Callable[[str, str], None] = lambda level, text: None,
        audit: AuditLog | None = None,
        log: WriteAheadLog | None = None,
        admission: Admission | None = None,
    ):
        """Starts to serve; tickets are granted from the first `publish_weights` on.

        Args:
          transport: a listening transport.
          run: name of the run.
          config_json: configuration of the run, for actors that connect.
          run_id: identifies this training; it changes on a start from scratch, not on a resume.
          schema: required policy schema of rollouts.
          form: required arrays and sizes of rollouts; only rollouts that differ are refused.
          staleness: staleness manager in its initial state.
          queue_limit: most rollouts queued for an update.
          name: name of the learner, for logs.
          durable: result of `durable` in the checkpoint, when resuming.
          on_event: called with level and text of every event; must not block.
          audit: journal of the outcome of every rollout.
          log: stores accepted rollouts until a checkpoint holds their outcome.
          admission: checks the values of rollouts; by default only their form is checked.

        Raises:
          CongraspError: the durable state belongs to another run.
        """
        self.keys, self.run_id = Keys(run), run_id
        self.session_id = secrets.token_hex(4)
        self._transport = transport
        self._config, self._schema, self._form = config_json, schema, form
        self._staleness, self._limit = staleness, queue_limit
        self._name, self._on_event = check_name("learner", name), on_event
        self._changed = threading.Condition()
        self._queue: collections.deque[tuple[RolloutHeader, Message]] = collections.deque()
        self._sequences = SequenceTable()
        self._being_written: set[tuple[Owner, int]] = set()  # accepted, but not acknowledged yet
        self._bundle: SharedMessage | None = None
        self._members, self._admission = Members(), admission or Admission()
        self._arrivals: collections.deque[tuple[float, Owner, int]] = collections.deque()
        self._last_event: dict[str, float] = {}
        self._finished = self._closed = False
        self.trouble = ""
        """Reason why the run cannot be saved, and what its end would cost; part of the status."""
        self._audit, self._log = audit, log
        self._rate_limit, self._pull_limit = RateLimit(), RateLimit(per_second=_PIECES, most=4 * _PIECES)
        self._recovered: Recovered | None = self._begin(durable)
        self._serve()

    def has_batch(self, count: int, timeout: float) -> bool:
        """Waits at most `timeout` seconds; returns True if `next_batch` would return a batch. Takes nothing."""
        deadline = time.monotonic() + timeout
        with self._changed:
            while True:
                self._drop_stale()
                if len(self._queue) >= count:
                    return True
                rest = deadline - time.monotonic()
                if rest <= 0:
                    return False
                self._changed.wait(rest)

    def next_batch(self, count: int, timeout: float) -> list[Message] | None:
        """Returns the `count` fresh rollouts of the oldest policies; None if there are fewer after `timeout` s."""
        with self._changed:
            if not self.has_batch(count, timeout):
                return None
            waiting = sorted(self._queue, key=lambda entry: -self.lag(entry[0].version))
            batch, self._queue = waiting[:count], collections.deque(waiting[count:])
            for header, _ in batch:
                self._staleness.take(header.version)
        messages = [message for _, message in batch]
        if self._audit is not None:
            self._audit.used(self._staleness.version, [self.lag(header.version) for header, _ in batch], messages)
        return messages

    def lag(self, version: int) -> int:
        """Number of updates between the policy of a version and the current one."""
        return self._staleness.lag(version)

    def publish_weights(self, bundle: Message, version: int) -> None:
        """Publishes a policy bundle as the latest, and announces it.

        Args:
          bundle: a policy bundle of this run and schema.
          version: version of the bundle; one more than the last, except after a resume.

        Raises:
          CongraspError: the bundle is invalid, or has another schema, version or run id.
        """
        validate_bundle(bundle, schema=self._schema)
        if (bundle.meta["version"], bundle.meta["run_id"]) != (version, self.run_id):
            raise CongraspError(f"The bundle is not version {version} of run id {self.run_id}.")
        with self._changed:
            self._bundle = SharedMessage(bundle.arrays, bundle.meta)
            self._staleness.publish(version)
            if self._recovered is not None:
                self._take_up(self._recovered)
                self._recovered = None
        self._transport.publish(self.keys.announcement, Message(meta=self._state()))

    def finish(self) -> None:
        """Notifies actors that the run is over."""
        self._finished = True
        self._transport.publish(self.keys.announcement, Message(meta=self._state()))

    def close(self) -> None:
        """Stops accepting rollouts, while the transport still replies, and records the unused ones.

        A rollout that is being written at that time is included, and acknowledged once it is written.
        """
        with self._changed:
            self._closed = True
            if self._audit is not None:
                self._audit.end((*header.owner, header.sequence) for header, _ in self._queue)

    def status(self) -> dict[str, Any]:
        """Returns the run's status as JSON: roles, versions, rates and counters."""
        with self._changed:
            now = time.monotonic()
            self._forget_arrivals(now)
            span = min(_RATE_SECONDS, max(1.0, now - self._arrivals[0][0])) if self._arrivals else _RATE_SECONDS
            roles: list[dict[str, Any]] = []
            arrived = collections.defaultdict[Owner, list[int]](list)
            for _, owner, steps in self._arrivals:
                arrived[owner].append(steps)
            for alive in self._members.listed():
                known = self._sequences.get((alive.id, alive.incarnation)) if alive.role == "actor" else None
                entry = {"rollouts": known.rollouts, "version": known.version} if known else {}
                entry |= {"lag": self.lag(known.version)} if known and known.rollouts else {}
                entry |= self._admission.counts(alive.id) if alive.role == "actor" else {}
                own = _rates(arrived[alive.id, alive.incarnation], span) if alive.role == "actor" else {}
                roles.append({**alive._asdict(), **entry, **own})
            return {
                **self._state(),
                "time": time.time(),
                "run": self.keys.run,
                "schema": self._schema,
                "roles": roles,
                "unlisted": self._members.unlisted,
                "trouble": self.trouble,
                "rates": _rates([steps for *_, steps in self._arrivals], span),
                "queue": {"length": len(self._queue), "limit": self._limit},
                "counters": self._staleness.counters()
                | {
                    "missing": self._sequences.missing,
                    "rejected": self._rate_limit.rejected + self._admission.rejected,
                },
            }

    def durable(self) -> dict[str, Any]:
        """Returns the hub's part of a checkpoint, as JSON; call it between two updates, when no batch is in use."""
        with self._changed:
            if self._log is not None:
                self._log.begin_checkpoint(self._staleness.version)
                for header, message in self._queue:
                    self._write_ahead(header, message)
                self._log.cover((*header.owner, header.sequence) for header, _ in self._queue)
            waiting = {(header.owner, header.sequence) for header, _ in self._queue}
            return {
                "run_id": self.run_id,
                "version": self._staleness.version,
                "counters": self._staleness.durable(),
                **self._sequences.durable(waiting),
            }

    def note_saved(self) -> None:
        """Records that a checkpoint holds the last result of `durable`, and removes what it covers."""
        if self._log is not None:
            self._log.end_checkpoint()
        if self._audit is not None:
            self._audit.saved(self._staleness.version)

    def discard(self, batch: Sequence[Message]) -> None:
        """Drops the rollouts of an unusable batch, so that no resume uses them."""
        identities = [(m.meta["actor"], m.meta["incarnation"], m.meta["sequence"]) for m in batch]
        if self._audit is not None:
            self._audit.dropped(identities)
        if self._log is not None:
            self._log.discard(identities)

    def _serve(self) -> None:
        """Serves the run's keys from now on, and declares the learner alive."""
        transport = self._transport
        transport.serve(self.keys.config, self._on_config)
        charging = self._rate_limit.charging
        transport.serve(self.keys.tickets, charging(self._on_ticket), depth=64, admission=self._reject)
        transport.serve(self.keys.status, lambda key, request: Message(meta=self.status()))
        transport.serve(below(self.keys.weights), self._on_weights, workers=4, depth=16, admission=self._reject_puller)
        transport.serve(
            self.keys.rollouts,
            charging(self._on_rollout),
            workers=2,
            depth=8,
            on_damage=self._on_damage,
            admission=self._reject,
        )
        transport.watch_alive(self.keys.everyone, self._on_alive)
        transport.declare_alive(self.keys.alive("learner", self._name, self.session_id))

    def _begin(self, durable: Mapping[str, Any] | None) -> Recovered:
        """Restores a checkpoint's part, reads the data of earlier sessions, and records the start of this one."""
        staleness, log = self._staleness, self._log
        if durable is not None:
            if durable["run_id"] != self.run_id:
                raise CongraspError(f"The checkpoint has run id {durable['run_id']}, not {self.run_id}.")
            staleness.restore(durable["counters"], durable["version"])
            self._sequences.restore(durable)
        version = staleness.version
        recovered = Recovered([], []) if log is None else log.recover(version, self.run_id, self._form, self._schema)
        if self._audit is not None:
            kept = log is not None and log.write
            session = self.session_id, self.run_id, version, staleness.max_staleness
            staleness.note_undone(self._audit.begin(*session, kept=kept))
        return recovered

    def _state(self) -> dict[str, Any]:
        version = self._staleness.version if self._bundle else -1
        return {"version": version, "run_id": self.run_id, "session_id": self.session_id, "finished": self._finished}

    def _on_config(self, key: str, request: Message) -> Message:
        arrays = list(self._form.arrays)
        return Message(meta={**self._state(), "config": self._config, "schema": self._schema, "arrays": arrays})

    def _on_ticket(self, key: str, request: Message) -> Message:
        validate(request, TICKET)
        meta = request.meta
        owner = check_name("actor", meta["actor"]), check_name("incarnation", meta["incarnation"])
        _check_sender(key, owner[0])
        ticket_id = check_name("ticket", meta["ticket"])
        if meta.get("give_back"):
            self._staleness.give_back(owner, ticket_id)
            return Message(meta=self._state())
        may = self._bundle is not None and not self._finished
        repeated = self._staleness.holds(owner, ticket_id)
        ticket = self._staleness.grant(owner, ticket_id) if may else None
        if ticket is not None and not repeated:
            with self._changed:
                self._sequences.of(owner).granted += 1
        return Message(meta={**self._state(), "granted": ticket is not None, "retry_after": _RETRY_SECONDS})

    def _on_weights(self, key: str, request: Message) -> Message:
        bundle, state = self._bundle, self._state()
        known = request.meta.get("newer_than"), request.meta.get("session_id", self.session_id)
        if bundle is None or known == (bundle.meta["version"], self.session_id):
            return Message(meta=state)
        return bundle

    def _on_rollout(self, key: str, message: Message) -> Message:
        meta = message.meta
        ticket = str(meta.get("ticket", ""))
        try:
            header = validate_rollout(message, self._form, schema=self._schema)
            _check_sender(key, header.actor)
            self._admission.check(message)
        except CongraspError as error:
            self._staleness.refuse_damaged((sender(key), str(meta.get("incarnation"))), ticket)
            self._admission.refuse(sender(key))
            self._event("warning", f"A rollout of {sender(key)} was refused: {error}", kind="refused")
            return self._answer("refused", why=str(error))
        if header.run_id != self.run_id:
            self._staleness.refuse_stale(header.owner, ticket)
            return self._answer("stale", why=f"The rollout has run id {header.run_id}, not {self.run_id}.")
        with self._changed:
            answer = self._admit(header, ticket, message)
            if answer.meta["outcome"] != "accepted":
                return answer
            self._being_written.add((header.owner, header.sequence))
        written = self._write_ahead(header, message)
        with self._changed:
            self._being_written.remove((header.owner, header.sequence))
        return answer if written or not self._closed else self._answer("retry", why="The learner is stopping.")

    def _write_ahead(self, header: RolloutHeader, message: Message) -> bool:
        """Writes an accepted rollout to disk if a resume could use it; records a failure of the disk."""
        if self._log is None or self._log.add(header, message):
            return True
        with self._changed:
            if self._audit is not None and not self._closed:
                self._audit.unwritten([(*header.owner, header.sequence)])
        return False

    def _take_up(self, recovered: Recovered) -> None:
        """Queues rollouts acknowledged by earlier sessions since the checkpoint; the caller holds the lock."""
        taken: list[Identity] = []
        stale: list[Identity] = []
        for header, message in recovered.rollouts:
            sequences, identity = self._sequences.of(header.owner), (*header.owner, header.sequence)
            if header.sequence in sequences:  # the checkpoint holds its outcome
                continue
            verdict = self._staleness.arrive(header.owner, "", header.version, beyond_capacity=True)
            sequences.add(header, accepted=verdict == "accepted")
            if verdict == "accepted":
                self._queue.append((header, message))
            (taken if verdict == "accepted" else stale).append(identity)
        if self._audit is not None:
            self._audit.recovered(taken, stale, recovered.damaged)
        if taken or stale:
            self._event(
                "info", f"Recovered {len(taken)} accepted rollouts of earlier sessions; {len(stale)} are too old."
            )
        if recovered.damaged:
            self._event("error", f"{len(recovered.damaged)} accepted rollouts are damaged on disk and were ignored.")

    def _admit(self, header: RolloutHeader, ticket: str, message: Message) -> Message:
        if self._bundle is None:
            return self._answer("retry", why="The learner is starting.")
        if self._closed:
            return self._answer("retry", why="The learner is stopping.")
        if (header.owner, header.sequence) in self._being_written:
            return self._answer("retry", why="The rollout is being written.")
        sequences = self._sequences.of(header.owner)
        if header.sequence in sequences.refused:
            self._staleness.redeem(header.owner, ticket)
            return self._answer("stale", why="The rollout was refused before.")
        if header.sequence in sequences:
            self._staleness.refuse_duplicate(header.owner, ticket)
            return self._answer("duplicate")
        if len(self._queue) >= self._limit:
            return self._answer("retry", why=f"{self._limit} rollouts are already queued.")
        if self._finished:
            self._staleness.refuse_stale(header.owner, ticket)
            sequences.add(header, accepted=False)
            return self._answer("stale", why="The run is finished.")
        verdict = self._staleness.arrive(header.owner, ticket, header.version)
        if verdict == "full":
            return self._answer("retry", why="No more rollouts are needed at this version.")
        sequences.add(header, accepted=verdict == "accepted")
        if verdict == "stale":
            why = f"The rollout has version {header.version}, but the learner is at {self._staleness.version}."
            self._event("info", f"A rollout of {header.actor} was refused. {why}", kind="stale")
            return self._answer("stale", why=why)
        self._admission.accept(header.actor)
        self._queue.append((header, message))
        now = time.monotonic()
        self._arrivals.append((now, header.owner, header.steps))
        self._forget_arrivals(now)
        self._changed.notify_all()
        return self._answer("accepted")

    def _answer(self, outcome: str, *, why: str = "") -> Message:
        return Message(meta={**self._state(), "outcome": outcome, "why": why, "retry_after": _RETRY_SECONDS})

    def _forget_arrivals(self, now: float) -> None:
        while self._arrivals and self._arrivals[0][0] < now - _RATE_SECONDS:
            self._arrivals.popleft()

    def _drop_stale(self) -> None:
        stale = [header for header, _ in self._queue if self._staleness.is_stale(header.version)]
        if not stale:
            return
        self._queue = collections.deque(
            entry for entry in self._queue if not self._staleness.is_stale(entry[0].version)
        )
        for header in stale:
            self._staleness.take(header.version)
        if self._audit is not None:
            self._audit.dropped((*header.owner, header.sequence) for header in stale)
        actors = ", ".join(sorted({header.actor for header in stale}))
        self._event("warning", f"Dropped as too old at version {self._staleness.version}: {len(stale)} of {actors}.")

    def _reject(self, key: str) -> Message | None:
        """Returns the reply to a deferred or rate-limited actor, before its request is decoded; None for others."""
        if seconds := self._admission.retry_after(sender(key)):
            retry = self._answer("retry", why="A rollout of yours was refused: try again later.")
            return Message(meta={**retry.meta, "granted": False, "retry_after": seconds})
        if self._rate_limit.admits(key):
            return None
        self._event("warning", f"Too many useless requests of {sender(key)}: rejected.", kind="rejected")
        retry = self._answer("retry", why="Too many of your requests were useless.")
        return Message(meta={**retry.meta, "granted": False})

    def _reject_puller(self, key: str) -> Message | None:
        """Returns the reply to a peer beyond the rate limit of weights; None for others, which are charged."""
        if not self._pull_limit.admits(key):
            return Message(meta=self._state())
        self._pull_limit.charge(key, 0)
        return None

    def _on_damage(self, key: str, error: CongraspError) -> None:
        self._rate_limit.charge(key, DAMAGED)
        self._staleness.refuse_damaged()
        self._event(
            "warning",
            f"A damaged message arrived at {key}: {error}",
            kind="damaged",
        )

    def _on_alive(self, key: str, alive: bool) -> None:
        who = parse_alive(key)
        if who is None:
            return
        with self._changed:
            counts = self._members.note(who, alive)
        if not counts:
            return
        if alive:
            if who.role == "actor":  # it may have missed announcements
                self._transport.publish(self.keys.announcement, Message(meta=self._state()))
            return
        tickets = self._staleness.forget((who.id, who.incarnation)) if who.role == "actor" else 0
        returned = f"; {tickets} of its tickets returned" if who.role == "actor" else ""
        self._event("info", f"The {who.role} {who.id} left{returned}.")

    def _event(self, level: str, text: str, *, kind: str = "") -> None:
        """Publishes an event; at most one per second of a kind that untrusted peers can trigger."""
        now = time.monotonic()
        if kind and now - self._last_event.get(kind, -_EVENT_SECONDS) < _EVENT_SECONDS:
            return
        self._last_event[kind] = now
        self._on_event(level, text)
        meta = {"time": time.time(), "level": level, "text": text}
        self._transport.publish(self.keys.log("event", "learner", self._name), Message(meta=meta))


def _rates(steps: list[int], seconds: float) -> dict[str, float]:
    """Rates of rollouts with these numbers of steps, received within some seconds."""
    return {"rollouts_per_second": len(steps) / seconds, "steps_per_second": sum(steps) / seconds}


def _check_sender(key: str, actor: str) -> None:
    if sender(key) != actor:
        raise CongraspError(f"A message of the actor {ascii(actor)[:70]} came under the key {ascii(key)[:140]}.")
