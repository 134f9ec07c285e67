"""Learner side of the link: receives rollouts, grants tickets, serves weights, and reports the
run's status.
"""

import collections
import threading
import time
from typing import Any

from congrasp.common.errors import CongraspError
from congrasp.common.transport.base import Transport
from congrasp.common.transport.keys import below, check_name, parse_alive
from congrasp.common.wire.codec import Message, SharedMessage
from congrasp.common.wire.messages import (
    TICKET,
    RolloutHeader,
    validate,
    validate_bundle,
    validate_rollout,
)
from congrasp.learner.hub.admission import Admission
from congrasp.learner.hub.limits import DAMAGED, Events, Members, RateLimit, sender
from congrasp.learner.hub.queue import RolloutQueue
from congrasp.learner.hub.staleness import Owner

_RETRY_SECONDS = 0.25
_RATE_SECONDS = 10.0
# Chunks of weights, of at most four mebibytes, per second for the owners of one certificate
_PIECES = 40.0


class LearnerHub:
    """Serves a run's keys for the learner; thread-safe."""

    def __init__(
        self,
        transport: Transport,
        rollouts: RolloutQueue,
        events: Events,
        config_json: str,
        admission: Admission | None = None,
    ):
        """Starts to serve; tickets are granted from the first `publish_weights` on.

        Args:
          transport: a listening transport.
          rollouts: takes the rollouts.
          events: receives events; the hub serves its run.
          config_json: configuration of the run, for actors that connect.
          admission: checks the values of rollouts; by default only their form is checked.
        """
        self.keys = events.keys
        self._transport = transport
        self._rollouts = rollouts
        self._events = events
        self._staleness = rollouts.staleness
        self._config = config_json
        self._bundle: SharedMessage | None = None
        self._members = Members()
        self._admission = admission or Admission()
        self._lock = threading.Lock()  # of members and arrivals
        self._arrivals: collections.deque[tuple[float, Owner, int]] = collections.deque()
        self.trouble = ""
        """Reason why the run cannot be saved, and what its end would cost; part of the status."""
        self._rate_limit = RateLimit()
        self.pull_limit = RateLimit(per_second=_PIECES, most=4 * _PIECES)
        """Limit of the requests for weights."""
        self._serve()

    def publish_weights(self, bundle: Message, version: int) -> None:
        """Publishes a policy bundle as the latest, and announces it.

        Args:
          bundle: a policy bundle of this run and schema.
          version: version of the bundle; one more than the last, except after a resume.

        Raises:
          CongraspError: the bundle is invalid, or has another schema, version or run id.
        """
        validate_bundle(bundle, schema=self._rollouts.schema)
        if (bundle.meta["version"], bundle.meta["run_id"]) != (version, self._rollouts.run_id):
            raise CongraspError(
                f"The bundle is not version {version} of run id {self._rollouts.run_id}."
            )
        self._bundle = SharedMessage(bundle.arrays, bundle.meta)
        self._rollouts.publish(version)
        self._announce()

    def finish(self) -> None:
        """Notifies actors that the run is over."""
        self._rollouts.finished = True
        self._announce()

    def status(self) -> dict[str, Any]:
        """Returns the run's status as JSON: roles, versions, rates and counters."""
        with self._lock:
            now = time.monotonic()
            self._forget_arrivals(now)
            arrivals = list(self._arrivals)
            members = self._members.listed()
            unlisted = self._members.unlisted
        span_s = _RATE_SECONDS
        if arrivals:
            first, _, _ = arrivals[0]
            span_s = min(span_s, max(1.0, now - first))
        steps_by_actor = collections.defaultdict[Owner, list[int]](list)
        for _, owner, steps in arrivals:
            steps_by_actor[owner].append(steps)
        roles: list[dict[str, Any]] = []
        for member in members:
            role: dict[str, Any] = member._asdict()
            if member.role == "actor":
                owner = member.id, member.incarnation
                role |= self._progress_of(owner)
                role |= self._admission.counts(member.id)
                role |= _rates(steps_by_actor[owner], span_s)
            roles.append(role)
        rollouts = self._rollouts.status()
        rejected = self._rate_limit.rejected + self._admission.rejected
        return {
            **self._state(),
            "time": time.time(),
            "run": self.keys.run,
            "schema": self._rollouts.schema,
            "roles": roles,
            "unlisted": unlisted,
            "trouble": self.trouble,
            "rates": _rates([steps for *_, steps in arrivals], span_s),
            **rollouts,
            "counters": {**rollouts["counters"], "rejected": rejected},
        }

    def _progress_of(self, owner: Owner) -> dict[str, int]:
        """Number of decided rollouts of an actor, their latest version, and its lag."""
        decided = self._rollouts.decided(owner)
        if decided is None:
            return {}
        progress = {"rollouts": decided.rollouts, "version": decided.version}
        if decided.rollouts:
            progress["lag"] = self._staleness.lag(decided.version)
        return progress

    def _serve(self) -> None:
        """Serves the run's keys from now on, and declares the learner alive."""
        transport = self._transport
        transport.serve(self.keys.config, self._on_config)
        charged = self._rate_limit.wrap_handler
        transport.serve(
            self.keys.tickets, charged(self._on_ticket), depth=64, admission=self._reject
        )
        transport.serve(self.keys.status, lambda key, request: Message(meta=self.status()))
        transport.serve(
            below(self.keys.weights),
            self._on_weights,
            workers=4,
            depth=16,
            admission=self._reject_puller,
        )
        transport.serve(
            self.keys.rollouts,
            charged(self._on_rollout),
            workers=2,
            depth=8,
            on_damage=self._on_damage,
            admission=self._reject,
        )
        transport.watch_alive(self.keys.everyone, self._on_alive)
        transport.declare_alive(
            self.keys.alive("learner", self._events.name, self._rollouts.session_id)
        )

    def _state(self) -> dict[str, Any]:
        rollouts = self._rollouts
        version = self._staleness.version if self._bundle else -1
        return {
            "version": version,
            "run_id": rollouts.run_id,
            "session_id": rollouts.session_id,
            "finished": rollouts.finished,
        }

    def _announce(self) -> None:
        self._transport.publish(self.keys.announcement, Message(meta=self._state()))

    def _on_config(self, key: str, request: Message) -> Message:
        arrays = list(self._rollouts.form.arrays)
        return Message(
            meta={
                **self._state(),
                "config": self._config,
                "schema": self._rollouts.schema,
                "arrays": arrays,
            }
        )

    def _on_ticket(self, key: str, request: Message) -> Message:
        validate(request, TICKET)
        meta = request.meta
        owner = check_name("actor", meta["actor"]), check_name("incarnation", meta["incarnation"])
        _check_sender(key, owner[0])
        ticket_id = check_name("ticket", meta["ticket"])
        if meta.get("give_back"):
            self._staleness.give_back(owner, ticket_id)
            return Message(meta=self._state())
        granted = self._rollouts.grant(owner, ticket_id)
        return Message(
            meta={
                **self._state(),
                "granted": granted,
                "required_version": self._staleness.required_version,
                "retry_after": _RETRY_SECONDS,
            }
        )

    def _on_weights(self, key: str, request: Message) -> Message:
        bundle = self._bundle
        state = self._state()
        session = self._rollouts.session_id
        version_of_actor = request.meta.get("newer_than")
        session_of_actor = request.meta.get("session_id", session)
        if bundle is None:
            return Message(meta=state)
        if version_of_actor == bundle.meta["version"] and session_of_actor == session:
            return Message(meta=state)
        return bundle

    def _on_rollout(self, key: str, message: Message) -> Message:
        meta = message.meta
        ticket = str(meta.get("ticket", ""))
        try:
            header = validate_rollout(message, self._rollouts.form, schema=self._rollouts.schema)
            _check_sender(key, header.actor)
            self._admission.check(message)
        except CongraspError as error:
            self._staleness.refuse_damaged((sender(key), str(meta.get("incarnation"))), ticket)
            self._admission.refuse(sender(key))
            self._events.add(
                "warning", f"A rollout of {sender(key)} was refused: {error}", kind="refused"
            )
            return self._answer("refused", str(error))
        verdict = self._rollouts.admit(header, ticket, message)
        if verdict.outcome == "accepted":
            self._admission.accept(header.actor)
            self._note_arrival(header)
        return self._answer(*verdict)

    def _note_arrival(self, header: RolloutHeader) -> None:
        """Counts an accepted rollout in the rates of the status."""
        with self._lock:
            now = time.monotonic()
            self._arrivals.append((now, header.owner, header.steps))
            self._forget_arrivals(now)

    def _answer(self, outcome: str, why: str = "") -> Message:
        return Message(
            meta={**self._state(), "outcome": outcome, "why": why, "retry_after": _RETRY_SECONDS}
        )

    def _forget_arrivals(self, now: float) -> None:
        while self._arrivals and self._arrivals[0][0] < now - _RATE_SECONDS:
            self._arrivals.popleft()

    def _reject(self, key: str) -> Message | None:
        """Returns the reply to a deferred or rate-limited actor, before its request is decoded;
        None for others.
        """
        if seconds := self._admission.retry_after(sender(key)):
            retry = self._answer("retry", "A rollout of yours was refused: try again later.")
            return Message(meta={**retry.meta, "granted": False, "retry_after": seconds})
        if self._rate_limit.admits(key):
            return None
        self._events.add(
            "warning", f"Too many useless requests of {sender(key)}: rejected.", kind="rejected"
        )
        retry = self._answer("retry", "Too many of your requests were useless.")
        return Message(meta={**retry.meta, "granted": False})

    def _reject_puller(self, key: str) -> Message | None:
        """Returns the reply to a peer beyond the rate limit of weights; None for others, which are
        charged.
        """
        if not self.pull_limit.admits(key):
            return Message(meta=self._state())
        self.pull_limit.charge(key, 0)
        return None

    def _on_damage(self, key: str, error: CongraspError) -> None:
        self._rate_limit.charge(key, DAMAGED)
        self._staleness.refuse_damaged()
        self._events.add("warning", f"A damaged message arrived at {key}: {error}", kind="damaged")

    def _on_alive(self, key: str, alive: bool) -> None:
        who = parse_alive(key)
        if who is None:
            return
        with self._lock:
            counts = self._members.note(who, alive)
        if not counts:
            return
        if alive:
            if who.role == "actor":  # it may have missed announcements
                self._announce()
            return
        tickets = self._staleness.forget((who.id, who.incarnation)) if who.role == "actor" else 0
        returned = f"; {tickets} of its tickets returned" if who.role == "actor" else ""
        self._events.add("info", f"The {who.role} {who.id} left{returned}.")


def _rates(steps: list[int], seconds: float) -> dict[str, float]:
    """Rates of rollouts with these numbers of steps, received within some seconds."""
    return {"rollouts_per_second": len(steps) / seconds, "steps_per_second": sum(steps) / seconds}


def _check_sender(key: str, actor: str) -> None:
    if sender(key) != actor:
        raise CongraspError(
            f"Actor {ascii(actor)[:70]} published on {ascii(key)[:140]}, the key of another actor."
        )
