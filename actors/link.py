"""The actor's end of the wire: configuration, tickets, weights, and uploads that survive a learner's restart."""

import dataclasses
import queue
import secrets
import threading
import time
from typing import Any

from common.errors import CongraspError, TransportError
from common.transport import keys
from common.transport.base import Transport
from common.wire.codec import Message

_RETRY_SECONDS = 0.2
_MAX_REFUSALS = 3


class RunEnded(CongraspError):
    """The learner has finished its run, or has started another one."""

    exit_code = 0


@dataclasses.dataclass(frozen=True)
class Ticket:
    """Permission for one rollout."""

    identity: str
    version: int
    """The learner's version when it was granted."""


class ActorLink:
    """Talks to the learner; every wait has a deadline.

    Uploads run in a thread of their own, one at a time, so that stepping and sending overlap. The same rollout is sent
    under the same identity until the learner acknowledges it.
    """

    def __init__(self, transport: Transport, *, run: str, actor: str, patience: float = 60.0):
        """Shows the actor as alive.

        Args:
          transport: the actor's endpoint.
          run: name of the run.
          actor: the actor's name, unique in the run.
          patience: seconds without a learner after which the actor gives up.
        """
        self.actor, self.incarnation = actor, secrets.token_hex(8)
        self._transport, self._run, self._patience = transport, run, patience
        self._sequence = 0
        self._refusals = 0
        self._epoch = ""
        self._outbox: queue.Queue[Message] = queue.Queue(maxsize=1)
        self._idle = threading.Event()
        self._idle.set()
        self._failure: CongraspError | None = None
        self._stop = threading.Event()
        self._uploader = threading.Thread(target=self._upload_all, name="upload", daemon=True)
        self._uploader.start()
        transport.declare_alive(keys.alive_key(run, "actor", actor, self.incarnation))

    def config(self) -> str:
        """The run's configuration as JSON text; it also binds this actor to the learner's present training."""
        reply = self._ask(keys.CONFIG, {})
        self._epoch = reply.meta["epoch"]
        return reply.meta["config"]

    def acquire_ticket(self, stop: threading.Event) -> Ticket | None:
        """Waits for a ticket; None when `stop` is set.

        Raises:
          RunEnded: the run is over, or the learner trains anew (read the configuration again).
          TransportError: there was no learner for `patience` seconds.
        """
        while not stop.is_set():
            self._raise_failure()
            reply = self._ask(keys.TICKET, {"actor": self.actor, "incarnation": self.incarnation}, stop)
            if reply is None:
                return None
            if reply.meta["done"]:
                raise RunEnded("The run has ended.")
            if reply.meta["epoch"] != self._epoch:
                raise RunEnded("The learner has started a new training.")
            if reply.meta["ticket"] is not None:
                return Ticket(reply.meta["ticket"], reply.meta["version"])
            stop.wait(float(reply.meta["retry_after"]))
        return None

    def weights(self, newer_than: int) -> Message | None:
        """The newest policy bundle, or None if it is not newer than this version."""
        reply = self._ask(keys.WEIGHTS, {"newer_than": newer_than})
        return reply if reply.arrays else None

    def upload(self, rollout: Message, ticket: Ticket) -> None:
        """Hands a rollout to the uploader; blocks while the previous one has not been acknowledged.

        Raises:
          CongraspError: an earlier upload failed for good.
        """
        meta = {
            **rollout.meta,
            "actor": self.actor,
            "incarnation": self.incarnation,
            "sequence": self._sequence,
            "epoch": self._epoch,
            "ticket": ticket.identity,
        }
        self._sequence += 1
        deadline = time.monotonic() + self._patience
        while time.monotonic() < deadline:
            self._raise_failure()
            if self._idle.wait(0.1):
                self._idle.clear()
                self._outbox.put(Message(rollout.arrays, meta))
                return
        raise TransportError(f"The learner acknowledged no rollout for {self._patience:.0f} s.")

    def publish(self, kind: str, message: Message) -> None:
        """Sends to a log stream of this actor; may be lost."""
        self._transport.publish(keys.log_key(self._run, kind, "actor", self.actor), message)

    def close(self, drain: float = 2.0) -> None:
        """Waits up to `drain` seconds for the last acknowledgement and ends the uploader."""
        self._idle.wait(drain)
        self._stop.set()
        self._uploader.join(1.0)

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _ask(self, key: str, meta: dict[str, Any], stop: threading.Event | None = None) -> Any:
        """A query that outlives a learner's restart; None when `stop` is set meanwhile."""
        deadline = time.monotonic() + self._patience
        while True:
            try:
                return self._transport.query(keys.key(self._run, key), Message({}, meta), timeout=5.0)
            except TransportError:
                if time.monotonic() > deadline:
                    raise
                if stop is not None and stop.is_set():
                    return None
                time.sleep(_RETRY_SECONDS)

    def _upload_all(self) -> None:
        while not self._stop.is_set():
            try:
                message = self._outbox.get(timeout=0.2)
            except queue.Empty:
                continue
            self._upload_one(message)
            self._idle.set()

    def _upload_one(self, message: Message) -> None:
        deadline = time.monotonic() + self._patience
        while not self._stop.is_set():
            try:
                reply = self._transport.query(keys.key(self._run, keys.ROLLOUT), message, timeout=10.0)
            except TransportError as error:
                if time.monotonic() > deadline:
                    self._failure = error
                    return
                self._stop.wait(_RETRY_SECONDS)
                continue
            outcome = reply.meta["outcome"]
            if outcome == "refused":
                self._refusals += 1
                if self._refusals >= _MAX_REFUSALS:
                    self._failure = CongraspError(f"The learner refused {_MAX_REFUSALS} rollouts: {reply.meta['why']}")
            elif outcome == "other_epoch":
                self._failure = RunEnded(reply.meta["why"])
            else:
                self._refusals = 0
            return
