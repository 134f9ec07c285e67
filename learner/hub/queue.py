"""Accepted rollouts of a learner: deduplication, queue, and recovery after a kill.

A rollout is identified by (actor, incarnation, sequence). It is acknowledged once it is queued and
on disk, and an acknowledged one is never accepted twice, however often its actor sends it.

The part of a checkpoint (`RolloutQueue.durable`) is consistent with its weights: resuming from it
undoes later decisions together with the updates that used them. Their rollouts in the write-ahead
log are accepted again before the first new rollout. The rest appears as gaps in actors' sequences,
counted as `missing`; so do overtaken rollouts until they arrive. All others are counted once: as
consumed, dropped, queued or stale.
"""

import collections
import dataclasses
import secrets
import threading
import time
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

from congrasp.common.errors import CongraspError
from congrasp.common.wire.codec import Message
from congrasp.common.wire.messages import RolloutForm, RolloutHeader
from congrasp.learner.hub.limits import Events, certificate
from congrasp.learner.hub.staleness import Owner, StalenessManager
from congrasp.learner.hub.used_rollouts import AuditLog
from congrasp.learner.hub.write_ahead import Identity, Recovered, WriteAheadLog

_MAX_INCARNATIONS = 1024
"""Incarnations whose sequences are kept."""
_WINDOW = 64
"""Sequence numbers by which an actor's rollouts may overtake one another."""
_MAX_LISTED = 1 << 10
"""Most sequence numbers below `next` that a checkpoint lists one by one, from the first queued one
on.
"""


@dataclasses.dataclass
class Sequences:
    """Decided sequence numbers of an incarnation: all below `next` except the skipped ones, and
    `ahead`.
    """

    next: int = 0
    ahead: set[int] = dataclasses.field(default_factory=set)
    refused: set[int] = dataclasses.field(default_factory=set)
    """Refused ones among them, if recent; the others were accepted."""
    skipped: int = 0
    """Number of sequence numbers below `next` that never arrived, limited by tickets."""
    granted: int = 0
    """Number of its tickets, which bounds its rollouts apart from those of earlier sessions."""
    rollouts: int = 0
    """Number of accepted rollouts."""
    version: int = -1
    """Version of the newest accepted one."""

    def __contains__(self, sequence: int) -> bool:
        return sequence < self.next or sequence in self.ahead

    def add(self, header: RolloutHeader, accepted: bool) -> None:
        """Records the decision on a rollout."""
        if accepted:
            self.rollouts += 1
            self.version = header.version
        else:
            self.refused.add(header.sequence)
        self.ahead.add(header.sequence)
        if len(self.ahead) > _WINDOW:
            self.skipped += self._limit_gap(min(self.ahead) - self.next)
            self.next = min(self.ahead)
        while self.next in self.ahead:
            self.ahead.remove(self.next)
            self.next += 1
        if len(self.refused) > _WINDOW:
            self.refused.remove(min(self.refused))

    @property
    def missing(self) -> int:
        """Number of undecided sequence numbers below the highest."""
        ahead = max(self.ahead, default=self.next - 1) + 1 - self.next - len(self.ahead)
        return self.skipped + self._limit_gap(ahead)

    def _limit_gap(self, gap: int) -> int:
        """Size of a gap in the sequence numbers, limited by tickets, since an actor may invent
        numbers.
        """
        return max(0, min(gap, self.granted + _WINDOW - self.skipped))


class SequenceTable:
    """Sequences of the incarnations seen, up to a limit."""

    def __init__(self) -> None:
        """Starts empty."""
        self._sequences: collections.OrderedDict[Owner, Sequences] = collections.OrderedDict()
        self._forgotten_missing = 0

    def of(self, owner: Owner) -> Sequences:
        """Returns an incarnation's sequences; older ones are dropped if there are too many."""
        sequences = self._sequences.setdefault(owner, Sequences())
        self._sequences.move_to_end(owner)
        if len(self._sequences) > _MAX_INCARNATIONS:
            # A certificate with many incarnations displaces only its own, so that it cannot
            # displace those of others.
            oldest = next(iter(self._sequences))
            for other in self._sequences:
                if other != owner and certificate(other[0]) == certificate(owner[0]):
                    oldest = other
                    break
            self._forgotten_missing += self._sequences.pop(oldest).missing
        return sequences

    def get(self, owner: Owner) -> Sequences | None:
        """Returns an incarnation's sequences; None if it has not been seen."""
        return self._sequences.get(owner)

    @property
    def missing(self) -> int:
        """Number of undecided sequence numbers below the highest of each incarnation."""
        return self._forgotten_missing + sum(each.missing for each in self._sequences.values())

    def durable(self, waiting: Collection[tuple[Owner, int]]) -> dict[str, Any]:
        """Returns the part to be stored in a checkpoint, as JSON; rollouts queued for an update
        count as undecided.
        """
        rows = []
        for owner, sequences in self._sequences.items():
            queued = {sequence for other, sequence in waiting if other == owner}
            # An actor may make its numbers up
            start = max(min(queued | {sequences.next}), sequences.next - _MAX_LISTED)
            decided = set(range(start, sequences.next)) | sequences.ahead
            refused = sorted(sequences.refused)
            rows.append([*owner, start, sorted(decided - queued), refused, sequences.skipped])
        return {"forgotten_missing": self._forgotten_missing, "sequences": rows}

    def restore(self, durable: Mapping[str, Any]) -> None:
        """Restores the result of `durable`."""
        self._forgotten_missing = durable["forgotten_missing"]
        for actor, incarnation, start, ahead, refused, skipped in durable["sequences"]:
            self._sequences[actor, incarnation] = Sequences(
                start, set(ahead), set(refused), skipped, skipped
            )


class RolloutContract(NamedTuple):
    """Run and form of the rollouts that a learner accepts."""

    run_id: str
    form: RolloutForm
    schema: str


class Verdict(NamedTuple):
    """Decision on a rollout."""

    outcome: str
    """accepted, duplicate, stale, or retry: undecided."""
    why: str = ""


class RolloutQueue:
    """Accepts and queues rollouts for the updates of a learner; thread-safe.

    Attributes:
      run_id: identifies this training; it changes on a start from scratch, not on a resume.
      form: required arrays and sizes of rollouts; only rollouts that differ are refused.
      schema: required policy schema of rollouts.
      session_id: identifies this process.
      staleness: versions, tickets and counters.
      finished: True once the run is over; all further rollouts are stale.
    """

    def __init__(
        self,
        contract: RolloutContract,
        staleness: StalenessManager,
        events: Events,
        *,
        limit: int = 64,
        durable: Mapping[str, Any] | None = None,
        audit: AuditLog | None = None,
        log: WriteAheadLog | None = None,
    ):
        """Accepts rollouts from the first `publish` on.

        Args:
          contract: run id, form and schema of the class.
          staleness: staleness manager in its initial state.
          events: receives events.
          limit: most rollouts queued for an update.
          durable: result of `durable` in the checkpoint, when resuming.
          audit: journal of the outcome of every rollout.
          log: stores accepted rollouts until a checkpoint holds their outcome.

        Raises:
          CongraspError: the durable state belongs to another run.
        """
        self.run_id = contract.run_id
        self.form = contract.form
        self.schema = contract.schema
        self.session_id = secrets.token_hex(4)
        self.staleness = staleness
        self.finished = False
        self._events = events
        self._limit = limit
        self._audit = audit
        self._log = log
        self._changed = threading.Condition()
        self._queue: collections.deque[tuple[RolloutHeader, Message]] = collections.deque()
        self._sequences = SequenceTable()
        self._being_written: set[tuple[Owner, int]] = set()  # accepted, but not acknowledged yet
        self._started = False
        self._closed = False
        if durable is not None:
            self._restore(durable)
        self._recovered = Recovered([], [])
        if log is not None:
            self._recovered = log.recover(staleness.version, self.run_id, self.form, self.schema)
        if audit is not None:
            undone = audit.begin(
                self.session_id,
                self.run_id,
                staleness.version,
                staleness.max_staleness,
                kept=log is not None and log.write,
            )
            staleness.note_undone(undone)

    def _restore(self, durable: Mapping[str, Any]) -> None:
        """Restores counters and sequences of a checkpoint."""
        if durable["run_id"] != self.run_id:
            raise CongraspError(
                f"The checkpoint has run id {durable['run_id']}, not {self.run_id}."
            )
        self.staleness.restore(durable["counters"], durable["version"])
        self._sequences.restore(durable)

    def publish(self, version: int) -> None:
        """Makes `version` the current one; the first time, it queues the rollouts of earlier
        sessions.
        """
        with self._changed:
            self.staleness.publish(version)
            if not self._started:
                self._take_up(self._recovered)
                self._started = True
                self._recovered = Recovered([], [])

    def grant(self, owner: Owner, ticket: str) -> bool:
        """Grants a ticket, or confirms a granted one, if another rollout is needed."""
        if not self._started or self.finished:
            return False
        repeated = self.staleness.holds(owner, ticket)
        granted = self.staleness.grant(owner, ticket) is not None
        if granted and not repeated:
            with self._changed:
                self._sequences.of(owner).granted += 1
        return granted

    def admit(self, header: RolloutHeader, ticket: str, message: Message) -> Verdict:
        """Decides on a valid rollout; an accepted one is on disk on return, if a resume could use
        it.
        """
        if header.run_id != self.run_id:
            self.staleness.refuse_stale(header.owner, ticket)
            return Verdict("stale", f"The rollout has run id {header.run_id}, not {self.run_id}.")
        with self._changed:
            verdict = self._decide(header, ticket, message)
            if verdict.outcome != "accepted":
                return verdict
            self._being_written.add((header.owner, header.sequence))
        written = self._write_ahead(header, message)
        with self._changed:
            self._being_written.remove((header.owner, header.sequence))
        if self._closed and not written:
            return Verdict("retry", "The learner is stopping.")
        return verdict

    def has_batch(self, count: int, timeout: float) -> bool:
        """Waits at most `timeout` seconds; returns True if `next_batch` would return a batch. Takes
        nothing.
        """
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
        """Returns the `count` fresh rollouts of the oldest policies; None if there are fewer after
        `timeout` s.
        """
        with self._changed:
            if not self.has_batch(count, timeout):
                return None
            waiting = sorted(self._queue, key=lambda entry: -self.staleness.lag(entry[0].version))
            batch = waiting[:count]
            self._queue = collections.deque(waiting[count:])
            for header, _ in batch:
                self.staleness.take(header.version)
        messages = [message for _, message in batch]
        if self._audit is not None:
            lags = [self.staleness.lag(header.version) for header, _ in batch]
            self._audit.record_uses(self.staleness.version, lags, messages)
        return messages

    def close(self) -> None:
        """Stops accepting rollouts, while the transport still replies, and records the unused ones.

        A rollout that is being written at that time is included, and acknowledged once it is
        written.
        """
        with self._changed:
            self._closed = True
            if self._audit is not None:
                self._audit.end((*header.owner, header.sequence) for header, _ in self._queue)

    def status(self) -> dict[str, Any]:
        """Returns the queue's length and limit and all counters, as JSON."""
        with self._changed:
            return {
                "queue": {"length": len(self._queue), "limit": self._limit},
                "counters": {**self.staleness.counters(), "missing": self._sequences.missing},
            }

    def decided(self, owner: Owner) -> Sequences | None:
        """Returns the decisions on the rollouts of an incarnation; None if it has not been seen."""
        return self._sequences.get(owner)

    def durable(self) -> dict[str, Any]:
        """Returns the part of a checkpoint, as JSON; call it between two updates, when no batch is
        in use.
        """
        with self._changed:
            if self._log is not None:
                self._log.begin_checkpoint(self.staleness.version)
                for header, message in self._queue:
                    self._write_ahead(header, message)
                self._log.cover((*header.owner, header.sequence) for header, _ in self._queue)
            waiting = {(header.owner, header.sequence) for header, _ in self._queue}
            return {
                "run_id": self.run_id,
                "version": self.staleness.version,
                "counters": self.staleness.durable(),
                **self._sequences.durable(waiting),
            }

    def note_saved(self) -> None:
        """Records that a checkpoint holds the last result of `durable`, and removes what it
        covers.
        """
        if self._log is not None:
            self._log.end_checkpoint()
        if self._audit is not None:
            self._audit.record_checkpoint(self.staleness.version)

    def discard(self, batch: Sequence[Message]) -> None:
        """Drops the rollouts of an unusable batch, so that no resume uses them."""
        identities = [(m.meta["actor"], m.meta["incarnation"], m.meta["sequence"]) for m in batch]
        if self._audit is not None:
            self._audit.record_dropped(identities)
        if self._log is not None:
            self._log.discard(identities)

    def _write_ahead(self, header: RolloutHeader, message: Message) -> bool:
        """Writes an accepted rollout to disk if a resume could use it; records a failure of the
        disk.
        """
        if self._log is None or self._log.add(header, message):
            return True
        with self._changed:
            if self._audit is not None and not self._closed:
                self._audit.record_unwritten([(*header.owner, header.sequence)])
        return False

    def _take_up(self, recovered: Recovered) -> None:
        """Queues rollouts acknowledged by earlier sessions since the checkpoint; the caller holds
        the lock.
        """
        taken: list[Identity] = []
        stale: list[Identity] = []
        for header, message in recovered.rollouts:
            sequences = self._sequences.of(header.owner)
            if header.sequence in sequences:  # the checkpoint holds its outcome
                continue
            verdict = self.staleness.arrive(header.owner, "", header.version, beyond_capacity=True)
            identity = (*header.owner, header.sequence)
            if verdict == "accepted":
                sequences.add(header, accepted=True)
                self._queue.append((header, message))
                taken.append(identity)
            else:
                sequences.add(header, accepted=False)
                stale.append(identity)
        if self._audit is not None:
            self._audit.record_recovered(taken, stale, recovered.damaged)
        if taken or stale:
            self._events.add(
                "info",
                f"Recovered {len(taken)} accepted rollouts of earlier sessions; {len(stale)} are "
                f"too old.",
            )
        if recovered.damaged:
            self._events.add(
                "error",
                f"{len(recovered.damaged)} accepted rollouts are damaged on disk and were ignored.",
            )

    def _decide(self, header: RolloutHeader, ticket: str, message: Message) -> Verdict:
        """Decides on a rollout of this run, and queues an accepted one; the caller holds the
        lock.
        """
        if not self._started:
            return Verdict("retry", "The learner is starting.")
        if self._closed:
            return Verdict("retry", "The learner is stopping.")
        if (header.owner, header.sequence) in self._being_written:
            return Verdict("retry", "The rollout is being written.")
        sequences = self._sequences.of(header.owner)
        if header.sequence in sequences.refused:
            self.staleness.redeem(header.owner, ticket)
            return Verdict("stale", "The rollout was refused before.")
        if header.sequence in sequences:
            self.staleness.refuse_duplicate(header.owner, ticket)
            return Verdict("duplicate")
        if len(self._queue) >= self._limit:
            return Verdict("retry", f"{self._limit} rollouts are already queued.")
        if self.finished:
            self.staleness.refuse_stale(header.owner, ticket)
            sequences.add(header, accepted=False)
            return Verdict("stale", "The run is finished.")
        verdict = self.staleness.arrive(header.owner, ticket, header.version)
        if verdict == "full":
            return Verdict("retry", "No more rollouts are needed at this version.")
        sequences.add(header, accepted=verdict == "accepted")
        if verdict == "stale":
            why = (
                f"The rollout has version {header.version}, but the learner is at "
                f"{self.staleness.version}."
            )
            self._events.add(
                "info", f"A rollout of {header.actor} was refused. {why}", kind="stale"
            )
            return Verdict("stale", why)
        self._queue.append((header, message))
        self._changed.notify_all()
        return Verdict("accepted")

    def _drop_stale(self) -> None:
        """Drops queued rollouts that have become too old; the caller holds the lock."""
        stale = [header for header, _ in self._queue if self.staleness.is_stale(header.version)]
        if not stale:
            return
        self._queue = collections.deque(
            entry for entry in self._queue if not self.staleness.is_stale(entry[0].version)
        )
        for header in stale:
            self.staleness.take(header.version)
        if self._audit is not None:
            self._audit.record_dropped((*header.owner, header.sequence) for header in stale)
        actors = ", ".join(sorted({header.actor for header in stale}))
        self._events.add(
            "warning",
            f"Dropped as too old at version {self.staleness.version}: {len(stale)} of {actors}.",
        )
