"""The learner's end of the wire: configuration, tickets, rollouts, weights, status and who is alive."""

import collections
import dataclasses
import threading
import time
from collections.abc import Callable
from typing import Any

from common.errors import CongraspError
from common.transport import keys
from common.transport.base import Transport
from common.wire.codec import Message
from common.wire.messages import validate_bundle, validate_rollout
from learner.staleness import Ledger, StalenessManager

RETRY_SECONDS = 0.05
"""What an actor without a ticket is told to wait."""


@dataclasses.dataclass(frozen=True)
class RolloutSizes:
    """What a rollout of this run must look like."""

    observation: int
    action: int
    schema: str


class LearnerHub:
    """Serves actors and keeps accepted rollouts until the learner takes them.

    A rollout is identified by (actor, incarnation, sequence): one that was accepted before is answered as a duplicate
    and not queued again, so that an actor may send it until it hears an answer.
    """

    def __init__(
        self,
        transport: Transport,
        *,
        run: str,
        config_json: str,
        epoch: str,
        sizes: RolloutSizes,
        staleness: StalenessManager,
        on_event: Callable[[str, str], None] = lambda level, text: None,
    ):
        """Starts to serve.

        Args:
          transport: the learner's endpoint.
          run: name of the run.
          config_json: the run's configuration, given to every actor that asks.
          epoch: identifies this training; it stays the same when the run is resumed.
          sizes: what rollouts must look like.
          staleness: admission.
          on_event: called with (level, text) when something worth a line happens.
        """
        self._run, self._config_json, self._epoch, self._sizes = run, config_json, epoch, sizes
        self._staleness, self._on_event, self._transport = staleness, on_event, transport
        self._lock = threading.Condition()
        self._queue: collections.deque[Message] = collections.deque()
        self._seen: dict[str, dict[str, Any]] = {}
        self._bundle: Message | None = None
        self._version = -1
        self._done = False
        self._alive: dict[str, float] = {}
        self._actors: dict[str, dict[str, Any]] = {}
        self._progress: dict[str, float] = {}
        transport.watch_alive(keys.alive_key(run, "*", "*", "*"), self._on_alive)
        transport.serve(keys.key(run, keys.CONFIG), self._serve_config)
        transport.serve(keys.key(run, keys.TICKET), self._serve_ticket)
        transport.serve(keys.key(run, keys.ROLLOUT), self._serve_rollout, workers=2)
        transport.serve(keys.key(run, keys.WEIGHTS), self._serve_weights, workers=2)
        transport.serve(keys.key(run, keys.STATUS), lambda key, request: Message({}, self.status()))

    def next_batch(self, count: int, timeout: float) -> list[Message] | None:
        """The oldest `count` rollouts that are fresh enough for the present version, or None after `timeout` s."""
        deadline = time.monotonic() + timeout
        with self._lock:
            while True:
                self._drop_stale()
                if len(self._queue) >= count:
                    batch = [self._queue.popleft() for _ in range(count)]
                    break
                if not self._lock.wait(max(0.0, deadline - time.monotonic())) and time.monotonic() >= deadline:
                    return None
        for _ in batch:
            self._staleness.leave_queue(stale=False)
        return batch

    def publish_weights(self, bundle: Message, version: int) -> None:
        """Makes a bundle the newest; actors pull it, others hear of it."""
        validate_bundle(bundle)
        with self._lock:
            self._bundle, self._version = bundle, version
        self._transport.publish(
            keys.key(self._run, keys.ANNOUNCE), Message({}, {"version": version, "epoch": self._epoch})
        )

    def set_progress(self, values: dict[str, float]) -> None:
        """Figures that `status` shows beside the ledger."""
        self._progress = values

    def finish(self) -> None:
        """The run is over: actors that ask for a ticket are sent home."""
        self._done = True

    def status(self) -> dict[str, Any]:
        """The run as JSON: versions, roles alive, rollouts on their way, ledger, progress, actors."""
        with self._lock:
            return {
                "run": self._run,
                "epoch": self._epoch,
                "version": self._version,
                "done": self._done,
                "alive": sorted(self._alive),
                "running": self._staleness.running,
                "queued": self._staleness.queued,
                "ledger": dataclasses.asdict(self._staleness.ledger),
                "progress": dict(self._progress),
                "actors": {name: dict(entry) for name, entry in self._actors.items()},
                "time": time.time(),
            }

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps: ledger and identities of accepted rollouts (rollouts still queued are not in it)."""
        with self._lock:
            ledger = dataclasses.asdict(self._staleness.ledger)
            ledger["accepted"] -= len(self._queue)
            waiting = {_identity(message) for message in self._queue}
            seen = {}
            for owner, marks in self._seen.items():
                extra = {n for n in marks["extra"] if (owner, n) not in waiting}
                low = min([marks["below"], *(n for o, n in waiting if o == owner)])
                extra |= {n for n in range(low, marks["below"]) if (owner, n) not in waiting}
                seen[owner] = {"below": low, "extra": sorted(extra)}
            return {"ledger": ledger, "seen": seen}

    def restore(self, state: dict[str, Any]) -> None:
        """The inverse of `state`, before actors come back."""
        with self._lock:
            self._staleness.ledger = Ledger(**state["ledger"])
            self._seen = {
                owner: {"below": marks["below"], "extra": set(marks["extra"])} for owner, marks in state["seen"].items()
            }

    def _serve_config(self, key: str, request: Message) -> Message:
        return Message({}, {"config": self._config_json, "epoch": self._epoch})

    def _serve_ticket(self, key: str, request: Message) -> Message:
        actor, incarnation = _owner(request)
        common = {"epoch": self._epoch, "version": self._version, "done": self._done}
        if self._done or self._version < 0:
            return Message({}, {**common, "ticket": None, "retry_after": 10 * RETRY_SECONDS})
        ticket = self._staleness.grant((actor, incarnation))
        return Message({}, {**common, "ticket": ticket, "retry_after": RETRY_SECONDS})

    def _serve_rollout(self, key: str, request: Message) -> Message:
        ticket = str(request.meta.get("ticket", ""))
        try:
            actor, _ = _owner(request)
            validate_rollout(
                request,
                observation_size=self._sizes.observation,
                action_size=self._sizes.action,
                schema=self._sizes.schema,
            )
        except CongraspError as error:
            self._staleness.give_back(ticket)
            self._staleness.ledger.refused += 1
            self._on_event("warning", f"Refused a rollout: {error}")
            return Message({}, {"outcome": "refused", "why": str(error)})
        if request.meta["epoch"] != self._epoch:
            self._staleness.give_back(ticket)
            self._staleness.ledger.refused += 1
            return Message({}, {"outcome": "other_epoch", "why": "The learner has started a new training."})
        with self._lock:
            if not self._mark(request):
                self._staleness.give_back(ticket)
                self._staleness.ledger.duplicate += 1
                return Message({}, {"outcome": "duplicate"})
            self._staleness.accept(ticket)
            self._queue.append(request)
            entry = self._actors.setdefault(actor, {"rollouts": 0, "steps": 0})
            entry["rollouts"] += 1
            entry["steps"] += request.meta["steps"]
            entry["version"] = request.meta["version"]
            entry["time"] = time.time()
            self._lock.notify_all()
        return Message({}, {"outcome": "accepted"})

    def _mark(self, message: Message) -> bool:
        """Remembers a rollout's identity; false if it is known. `below` and `extra` stay small when order is kept."""
        owner, sequence = _identity(message)
        marks = self._seen.setdefault(owner, {"below": 0, "extra": set()})
        if sequence < marks["below"] or sequence in marks["extra"]:
            return False
        marks["extra"].add(sequence)
        while marks["below"] in marks["extra"]:
            marks["extra"].discard(marks["below"])
            marks["below"] += 1
        return True

    def _serve_weights(self, key: str, request: Message) -> Message:
        newer_than = request.meta.get("newer_than", -1)
        with self._lock:
            bundle, version = self._bundle, self._version
        if bundle is None or (isinstance(newer_than, int) and newer_than >= version):
            return Message({}, {"version": version, "epoch": self._epoch})
        return bundle

    def _on_alive(self, key: str, alive: bool) -> None:
        _, role, name, incarnation = keys.relative(key).split("/")
        label = f"{role}/{name}/{incarnation}"
        with self._lock:
            if alive:
                self._alive[label] = time.time()
            else:
                self._alive.pop(label, None)
        if alive:
            self._on_event("info", f"The {role} '{name}' has joined.")
        elif role == "actor":
            returned = self._staleness.forget((name, incarnation))
            self._on_event("warning", f"The actor '{name}' has left; {returned} ticket(s) returned.")

    def _drop_stale(self) -> None:
        oldest = self._version - self._staleness.max_staleness
        while self._queue and self._queue[0].meta["version"] < oldest:
            message = self._queue.popleft()
            self._staleness.leave_queue(stale=True)
            self._on_event("warning", f"Dropped a rollout of '{message.meta['actor']}': too old.")


def _owner(message: Message) -> tuple[str, str]:
    actor, incarnation = message.meta.get("actor"), message.meta.get("incarnation")
    if not isinstance(actor, str) or not isinstance(incarnation, str):
        raise CongraspError("The request does not name its actor and incarnation.")
    return actor, incarnation


def _identity(message: Message) -> tuple[str, int]:
    return f"{message.meta['actor']}/{message.meta['incarnation']}", message.meta["sequence"]
