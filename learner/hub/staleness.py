"""Admission by staleness: how many rollouts may be under way, and which are too old to learn from.

An actor asks for a ticket before it makes a rollout. A ticket is granted while

    accepted + awaited < (max_staleness + version + 1) * batch

(AReaL, arXiv 2505.24298, section on staleness control), where `version` counts the updates, `accepted` all rollouts
that its updates have used or that wait for one, and `awaited` the tickets that are out and whose rollouts are waited
for. So nothing is made that could only be thrown away, unless its actor is slow. A rollout that arrives more than
`max_staleness` versions after the policy that made it is refused, and dropped if it grows that old while it waits.

A ticket ends when its rollout arrives, when its owner dies, and when its deadline passes. Who gets one, until when, and
how long it is waited for also depends on what has come of earlier ones (`learner.hub.tickets`).

The lag of a rollout is the number of updates between the policy that acted and the current one. A learner that resumes
from a checkpoint gives its policy a new number; what acted under the versions before is measured from the checkpoint's:
rollouts of that very policy are as fresh as ever, those of policies that died with the killed learner are not.
"""

import collections
import dataclasses
import threading
import time
from collections.abc import Callable, Mapping
from typing import Literal, NamedTuple

from congrasp.learner.hub.rate_limit import certificate
from congrasp.learner.hub.tickets import TicketBudget

Owner = tuple[str, str]
"""Actor and incarnation."""
Verdict = Literal["accepted", "stale", "full"]
_EXPIRED = 256  # tickets that are remembered, to learn how long their rollouts take


class Ticket(NamedTuple):
    """Permission to make one rollout."""

    owner: Owner
    id: str
    """Chosen by the owner, so that asking twice yields one ticket."""
    version: int
    """Policy version when it was granted."""
    granted: float
    deadline: float


@dataclasses.dataclass
class Counters:
    """Outcomes of tickets and rollouts.

    Always `granted = running + redeemed + returned + expired` and `accepted = consumed + dropped + queued`.
    """

    granted: int = 0
    """Tickets given out."""
    redeemed: int = 0
    """Tickets whose rollout arrived, whatever its outcome."""
    returned: int = 0
    """Tickets given back, by their owner or by its death."""
    expired: int = 0
    """Tickets whose deadline passed."""
    accepted: int = 0
    """Rollouts taken in and acknowledged."""
    consumed: int = 0
    """Accepted rollouts that were handed to an update."""
    dropped: int = 0
    """Accepted rollouts that were too old when their turn came."""
    stale: int = 0
    """Rollouts refused on arrival as too old."""
    duplicate: int = 0
    """Arrivals of a rollout that had been accepted before."""
    damaged: int = 0
    """Messages refused because they were damaged or broke the rules of a rollout."""
    undone: int = 0
    """Rollouts that were consumed by updates which died with a killed learner; not among the others."""


class StalenessManager:
    """Tickets and the counters; knows neither messages nor a transport. Safe to call from several threads."""

    def __init__(
        self,
        max_staleness: int,
        rollouts_per_update: int,
        *,
        ticket_seconds: float = 120.0,
        tickets_per_owner: int = 4,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Starts at version 0 with nothing under way.

        Args:
          max_staleness: eta, versions.
          rollouts_per_update: the batch.
          ticket_seconds: seconds until an unused ticket expires, at most.
          tickets_per_owner: tickets that one owner can hold, so that nobody takes all there are.
          clock: seconds, monotonic.
        """
        self._max_staleness = max_staleness
        self._batch = rollouts_per_update
        slots = (max_staleness + 1) * rollouts_per_update
        self._budget = TicketBudget(slots, rollouts_per_update, ticket_seconds, clock)
        self._per_owner = tickets_per_owner
        self._clock = clock
        self._lock = threading.RLock()
        self._tickets: dict[tuple[Owner, str], Ticket] = {}
        self._expired: collections.OrderedDict[tuple[Owner, str], Ticket] = collections.OrderedDict()
        self._version = 0
        self._in_update = 0
        # Where the last resume began: the version of the checkpoint, and the one that its policy got instead.
        self._resumed: tuple[int, int | None] = 0, 0
        self._counters = Counters()

    @property
    def version(self) -> int:
        """The current policy version."""
        return self._version

    @property
    def max_staleness(self) -> int:
        """Eta."""
        return self._max_staleness

    @property
    def rollouts_per_update(self) -> int:
        """The batch."""
        return self._batch

    @property
    def running(self) -> int:
        """Tickets that are out."""
        with self._lock:
            self._expire()
            return len(self._tickets)

    @property
    def queued(self) -> int:
        """Accepted rollouts that wait for an update."""
        return self._counters.accepted - self._counters.consumed - self._counters.dropped

    @property
    def capacity(self) -> int:
        """Tickets that could be granted now."""
        with self._lock:
            # Every version stands for one batch; so a resumed run, or an update of another size, leaves no debt.
            accepted = self._version * self._batch + self._in_update + self.queued
            return (self._max_staleness + self._version + 1) * self._batch - accepted - self._awaited()

    def grant(self, owner: Owner, ticket_id: str) -> Ticket | None:
        """A ticket, or None if there is none now; asking again with the same id returns the same ticket."""
        with self._lock:
            self._expire()
            if held := self._tickets.get((owner, ticket_id)):
                return held
            mine = sum(ticket.owner == owner for ticket in self._tickets.values())
            shared = sum(certificate(ticket.owner[0]) == certificate(owner[0]) for ticket in self._tickets.values())
            if mine >= self._per_owner or not self._budget.admits(owner[0], shared) or self.capacity <= 0:
                return None
            now = self._clock()
            ticket = Ticket(owner, ticket_id, self._version, now, now + self._budget.lasts(owner[0]))
            self._tickets[owner, ticket_id] = ticket
            self._counters.granted += 1
            return ticket

    def give_back(self, owner: Owner, ticket_id: str) -> None:
        """Ends a ticket that its owner does not need; an unknown one is ignored."""
        with self._lock:
            if self._tickets.pop((owner, ticket_id), None):
                self._counters.returned += 1

    def forget(self, owner: Owner) -> int:
        """Ends all tickets of an owner that died; returns their number."""
        with self._lock:
            mine = [key for key in self._tickets if key[0] == owner]
            for key in mine:
                del self._tickets[key]
            self._counters.returned += len(mine)
            return len(mine)

    def arrive(self, owner: Owner, ticket_id: str, version: int, *, beyond_capacity: bool = False) -> Verdict:
        """Decides about a valid rollout that arrived for the first time.

        Its ticket ends unless the verdict is `full`: neither it nor its owner has one (any more), and nothing more may
        come in. It may come again later.

        Args:
          owner: who made it.
          ticket_id: the ticket it was made under.
          version: the policy version it was made with.
          beyond_capacity: without a ticket it need not fit: it had been admitted before.
        """
        with self._lock:
            self._expire()
            if self.is_stale(version) or version > self._version:
                if ticket := self._known(owner, ticket_id):
                    self._budget.measure(owner[0], self._clock() - ticket.granted)
                self.refuse_stale(owner, ticket_id)
                return "stale"
            if (owner, ticket_id) not in self._tickets and self.capacity <= 0 and not beyond_capacity:
                # Perhaps its ticket is of a session before: one of its owner's present ones does as well. Otherwise an
                # actor with one upload at a time would hold the place that its own rollout waits for.
                ticket_id = next((other for of, other in self._tickets if of == owner), "")
                if not ticket_id:
                    return "full"
            if ticket := self._known(owner, ticket_id):
                self._budget.deliver(owner[0], self._clock() - ticket.granted)
            self.redeem(owner, ticket_id)
            self._counters.accepted += 1
            return "accepted"

    def redeem(self, owner: Owner, ticket_id: str) -> None:
        """Ends the ticket of a rollout that was answered; an unknown one is ignored."""
        with self._lock:
            if self._tickets.pop((owner, ticket_id), None):
                self._counters.redeemed += 1

    def refuse_stale(self, owner: Owner, ticket_id: str) -> None:
        """Notes a rollout that is too old, or that another training made."""
        with self._lock:
            self.redeem(owner, ticket_id)
            self._counters.stale += 1

    def refuse_duplicate(self, owner: Owner, ticket_id: str) -> None:
        """Notes that an accepted rollout came again."""
        with self._lock:
            self.redeem(owner, ticket_id)
            self._counters.duplicate += 1

    def refuse_damaged(self, owner: Owner | None = None, ticket_id: str = "") -> None:
        """Notes a message that is no valid rollout."""
        with self._lock:
            if owner is not None:
                self.redeem(owner, ticket_id)
            self._counters.damaged += 1

    def lag(self, version: int) -> int:
        """Updates between the policy of a version and the current one."""
        source, renamed = self._resumed
        if renamed is None or version >= renamed:
            return self._version - version
        return abs(version - source) + self._version - renamed

    def is_stale(self, version: int) -> bool:
        """Whether a rollout of this policy version is too old to learn from."""
        return self.lag(version) > self._max_staleness

    def take(self, version: int) -> bool:
        """Hands an accepted rollout to the coming update; False if it has grown too old, and is dropped."""
        with self._lock:
            if self.is_stale(version):
                self._counters.dropped += 1
                return False
            self._counters.consumed += 1
            self._in_update += 1
            return True

    def publish(self, version: int) -> None:
        """Moves on to a version, which ends the update that led to it."""
        with self._lock:
            if self._resumed[1] is None:
                self._resumed = self._version, version
            self._version = version
            self._in_update = 0

    def counters(self) -> dict[str, int]:
        """All counts, with the tickets that run, the rollouts that wait and the capacity now."""
        with self._lock:
            self._expire()
            gauges = {"running": len(self._tickets), "queued": self.queued, "capacity": self.capacity}
            return dataclasses.asdict(self._counters) | gauges

    def durable(self) -> dict[str, int]:
        """What a checkpoint keeps: the counts without what is under way, which dies with the process."""
        with self._lock:
            self._expire()
            counts = dataclasses.asdict(self._counters)
            return counts | {
                "granted": self._counters.granted - len(self._tickets),
                "accepted": counts["accepted"] - self.queued,
            }

    def restore(self, durable: Mapping[str, int], version: int) -> None:
        """Goes on from a checkpoint: its counts and its version, with nothing under way; `publish` renames it."""
        with self._lock:
            self._counters = Counters(**durable)
            self._tickets.clear()
            self._version, self._in_update = version, 0
            self._resumed = version, None

    def note_undone(self, count: int) -> None:
        """Notes how many rollouts the run has lost with updates that died with a killed learner."""
        with self._lock:
            self._counters.undone = count

    def _awaited(self) -> int:
        """Tickets whose rollouts are waited for."""
        self._expire()
        now = self._clock()
        return sum(self._budget.holds_place(t.owner[0], now - t.granted) for t in self._tickets.values())

    def _known(self, owner: Owner, ticket_id: str) -> Ticket | None:
        """A ticket that is out, or one that has expired, which is forgotten then."""
        return self._tickets.get((owner, ticket_id)) or self._expired.pop((owner, ticket_id), None)

    def _expire(self) -> None:
        now = self._clock()
        late = [key for key, ticket in self._tickets.items() if ticket.deadline <= now]
        for key in late:
            self._expired[key] = self._tickets.pop(key)
            self._budget.expire(key[0][0])
        while len(self._expired) > _EXPIRED:
            self._expired.popitem(last=False)
        self._counters.expired += len(late)
