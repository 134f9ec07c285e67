"""Admission by staleness: limits the rollouts in progress, and rejects those too old to learn from.

An actor requests a ticket before it produces a rollout. A ticket is granted while

    accepted + awaited < (max_staleness + version + 1) * batch

(AReaL, arXiv 2505.24298, section on staleness control), where `version` counts the updates,
`accepted` the rollouts used by an update or queued for one, and `awaited` the outstanding tickets
that hold a place. No rollout is therefore produced in vain, unless its actor is slow. A rollout
that arrives more than `max_staleness` versions after its policy is refused, and dropped if it
becomes that old in the queue.

A ticket ends when its rollout arrives, when its owner dies, and when its deadline passes. Its
grant, its deadline and the time for which it holds a place also depend on the owner's earlier
rollouts (`TicketBudget`).

The lag of a rollout is the number of updates between its policy and the current one. A learner that
resumes from a checkpoint gives its policy a new version; earlier versions are measured from the
checkpoint's: rollouts of that policy keep their lag, those of policies lost with the killed learner
do not.
"""

import collections
import dataclasses
import threading
import time
from collections.abc import Callable, Mapping
from typing import Literal, NamedTuple

from congrasp.learner.hub.limits import certificate
from congrasp.learner.hub.ticket_budget import TicketBudget

Owner = tuple[str, str]
"""Actor and incarnation."""
Verdict = Literal["accepted", "stale", "full"]
_LEAST_PER_OWNER = 4
"""Least limit of the tickets of one owner."""
_MAX_EXPIRED = 256
"""Expired tickets that are remembered, to measure how long their rollouts take."""


class Ticket(NamedTuple):
    """Permission to produce one rollout."""

    owner: Owner
    id: str
    """Chosen by the owner, so that a repeated request yields the same ticket."""
    version: int
    """Policy version at the time of the grant."""
    granted: float
    deadline: float


@dataclasses.dataclass
class Counters:
    """Outcomes of tickets and rollouts.

    Invariants: `granted = running + redeemed + returned + expired` and `accepted = consumed +
    dropped + queued`.
    """

    granted: int = 0
    """Tickets granted."""
    redeemed: int = 0
    """Tickets whose rollout arrived, whatever its outcome."""
    returned: int = 0
    """Tickets returned by their owner, or because of its death."""
    expired: int = 0
    """Tickets whose deadline passed."""
    accepted: int = 0
    """Rollouts accepted and acknowledged."""
    consumed: int = 0
    """Accepted rollouts passed to an update."""
    dropped: int = 0
    """Accepted rollouts that were too old when they were due."""
    stale: int = 0
    """Rollouts refused on arrival as too old."""
    duplicate: int = 0
    """Repeated arrivals of accepted rollouts."""
    damaged: int = 0
    """Messages refused because they were damaged or not valid rollouts."""
    undone: int = 0
    """Rollouts consumed by updates that were lost with a killed learner; not among the others."""


class StalenessManager:
    """Tickets and counters, independent of messages and transports; thread-safe.

    Attributes (read only):
      max_staleness: eta, the greatest lag in versions.
      version: current policy version.
    """

    def __init__(
        self,
        max_staleness: int,
        rollouts_per_update: int,
        *,
        ticket_seconds: float = 120.0,
        tickets_per_owner: int | None = None,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Starts at version 0 without tickets.

        Args:
          max_staleness: eta, versions.
          rollouts_per_update: size of the batch.
          ticket_seconds: longest time until an unused ticket expires, s.
          tickets_per_owner: most tickets of one owner, so that no owner takes all of them; by
            default half of all, and at least four.
          clock: seconds, monotonic.
        """
        self.max_staleness = max_staleness
        self._batch = rollouts_per_update
        slots = (max_staleness + 1) * rollouts_per_update
        self._budget = TicketBudget(slots, rollouts_per_update, ticket_seconds, clock)
        self._per_owner = tickets_per_owner or max(_LEAST_PER_OWNER, slots // 2)
        self._clock = clock
        self._lock = threading.RLock()
        self._tickets: dict[tuple[Owner, str], Ticket] = {}
        self._expired: collections.OrderedDict[tuple[Owner, str], Ticket] = (
            collections.OrderedDict()
        )
        self.version = 0
        self._in_update = 0
        # Versions at the last resume: that of the checkpoint, and the new one of its policy.
        self._resumed: tuple[int, int | None] = 0, 0
        self._counters = Counters()

    @property
    def queued(self) -> int:
        """Number of accepted rollouts queued for an update."""
        return self._counters.accepted - self._counters.consumed - self._counters.dropped

    @property
    def capacity(self) -> int:
        """Number of tickets that could be granted now."""
        with self._lock:
            return (self.max_staleness + self.version + 1) * self._batch - self._count_promised()

    @property
    def required_version(self) -> int:
        """Oldest version whose policy keeps the rollout of the latest ticket fresh until its use.

        The rollout is assumed to arrive before the rollouts of later tickets.
        """
        with self._lock:
            used_at = max(0, self._count_promised() - 1) // self._batch
            return min(self.version, used_at - self.max_staleness)

    def grant(self, owner: Owner, ticket_id: str) -> Ticket | None:
        """Grants a ticket, or returns None if there is none now; repeating the id returns the same
        ticket.
        """
        with self._lock:
            self._expire()
            if held := self._tickets.get((owner, ticket_id)):
                return held
            of_owner = sum(ticket.owner == owner for ticket in self._tickets.values())
            shared = sum(
                certificate(ticket.owner[0]) == certificate(owner[0])
                for ticket in self._tickets.values()
            )
            if (
                of_owner >= self._per_owner
                or not self._budget.admits(owner[0], shared)
                or self.capacity <= 0
            ):
                return None
            now = self._clock()
            ticket = Ticket(owner, ticket_id, self.version, now, now + self._budget.lasts(owner[0]))
            self._tickets[owner, ticket_id] = ticket
            self._counters.granted += 1
            return ticket

    def holds(self, owner: Owner, ticket_id: str) -> bool:
        """True if a ticket of this id is outstanding."""
        with self._lock:
            self._expire()
            return (owner, ticket_id) in self._tickets

    def give_back(self, owner: Owner, ticket_id: str) -> None:
        """Ends a ticket that its owner does not need; an unknown ticket is ignored."""
        with self._lock:
            if self._tickets.pop((owner, ticket_id), None):
                self._counters.returned += 1

    def forget(self, owner: Owner) -> int:
        """Ends all tickets of an owner that died; returns their number."""
        with self._lock:
            keys = [key for key in self._tickets if key[0] == owner]
            for key in keys:
                del self._tickets[key]
            self._counters.returned += len(keys)
            return len(keys)

    def arrive(
        self, owner: Owner, ticket_id: str, version: int, *, beyond_capacity: bool = False
    ) -> Verdict:
        """Decides on a valid rollout that arrived for the first time.

        Its ticket ends unless the verdict is `full`: the rollout and its owner have no ticket (any
        more), and there is no capacity. It may be sent again later.

        Args:
          owner: actor and incarnation of the rollout.
          ticket_id: ticket of the rollout.
          version: policy version of the rollout.
          beyond_capacity: admits it without a ticket or capacity, because it had been admitted
            before.
        """
        with self._lock:
            self._expire()
            if self.is_stale(version) or version > self.version:
                if ticket := self._known(owner, ticket_id):
                    self._budget.measure(owner[0], self._clock() - ticket.granted)
                self.refuse_stale(owner, ticket_id)
                return "stale"
            if (
                (owner, ticket_id) not in self._tickets
                and self.capacity <= 0
                and not beyond_capacity
            ):
                # Its ticket may belong to an earlier session: any current one of its owner is used
                # instead. Otherwise an actor with one upload at a time would hold the place for
                # which its rollout waits.
                ticket_id = next((other for of, other in self._tickets if of == owner), "")
                if not ticket_id:
                    return "full"
            if ticket := self._known(owner, ticket_id):
                self._budget.deliver(owner[0], self._clock() - ticket.granted)
            self.redeem(owner, ticket_id)
            self._counters.accepted += 1
            return "accepted"

    def redeem(self, owner: Owner, ticket_id: str) -> None:
        """Ends the ticket of a decided rollout; an unknown one is ignored."""
        with self._lock:
            if self._tickets.pop((owner, ticket_id), None):
                self._counters.redeemed += 1

    def refuse_stale(self, owner: Owner, ticket_id: str) -> None:
        """Counts a rollout that is too old, or belongs to another training."""
        with self._lock:
            self.redeem(owner, ticket_id)
            self._counters.stale += 1

    def refuse_duplicate(self, owner: Owner, ticket_id: str) -> None:
        """Counts a repeated accepted rollout."""
        with self._lock:
            self.redeem(owner, ticket_id)
            self._counters.duplicate += 1

    def refuse_damaged(self, owner: Owner | None = None, ticket_id: str = "") -> None:
        """Counts a message that is not a valid rollout."""
        with self._lock:
            if owner is not None:
                self.redeem(owner, ticket_id)
            self._counters.damaged += 1

    def lag(self, version: int) -> int:
        """Number of updates between the policy of a version and the current one."""
        source, renamed = self._resumed
        if renamed is None or version >= renamed:
            return self.version - version
        return abs(version - source) + self.version - renamed

    def is_stale(self, version: int) -> bool:
        """True if a rollout of this policy version is too old to learn from."""
        return self.lag(version) > self.max_staleness

    def take(self, version: int) -> bool:
        """Passes an accepted rollout to the coming update; returns False if it has become too old,
        and drops it.
        """
        with self._lock:
            if self.is_stale(version):
                self._counters.dropped += 1
                return False
            self._counters.consumed += 1
            self._in_update += 1
            return True

    def publish(self, version: int) -> None:
        """Advances to a version, after the update that led to it."""
        with self._lock:
            if self._resumed[1] is None:
                self._resumed = self.version, version
            self.version = version
            self._in_update = 0

    def counters(self) -> dict[str, int]:
        """All counters, with outstanding tickets, queued rollouts and the current capacity."""
        with self._lock:
            self._expire()
            gauges = {
                "running": len(self._tickets),
                "queued": self.queued,
                "capacity": self.capacity,
            }
            return dataclasses.asdict(self._counters) | gauges

    def durable(self) -> dict[str, int]:
        """Counters for a checkpoint, without outstanding tickets, which do not survive the
        process.
        """
        with self._lock:
            self._expire()
            counts = dataclasses.asdict(self._counters)
            return counts | {
                "granted": self._counters.granted - len(self._tickets),
                "accepted": counts["accepted"] - self.queued,
            }

    def restore(self, durable: Mapping[str, int], version: int) -> None:
        """Restores counters and version of a checkpoint, without tickets; `publish` assigns the new
        version.
        """
        with self._lock:
            self._counters = Counters(**durable)
            self._tickets.clear()
            self.version = version
            self._in_update = 0
            self._resumed = version, None

    def note_undone(self, count: int) -> None:
        """Records the number of rollouts lost with updates of a killed learner."""
        with self._lock:
            self._counters.undone = count

    def _count_promised(self) -> int:
        """Number of rollouts that have been used, or are queued or awaited.

        Every version counts for one batch, so that a resumed run, or an update of another size,
        leaves no debt.
        """
        used = self.version * self._batch + self._in_update
        return used + self.queued + self._count_awaited()

    def _count_awaited(self) -> int:
        """Number of tickets that hold a place."""
        self._expire()
        now = self._clock()
        return sum(
            self._budget.holds_place(t.owner[0], now - t.granted) for t in self._tickets.values()
        )

    def _known(self, owner: Owner, ticket_id: str) -> Ticket | None:
        """Returns an outstanding ticket, or an expired one, which is then forgotten."""
        return self._tickets.get((owner, ticket_id)) or self._expired.pop((owner, ticket_id), None)

    def _expire(self) -> None:
        now = self._clock()
        late = [key for key, ticket in self._tickets.items() if ticket.deadline <= now]
        for key in late:
            self._expired[key] = self._tickets.pop(key)
            self._budget.expire(key[0][0])
        while len(self._expired) > _MAX_EXPIRED:
            self._expired.popitem(last=False)
        self._counters.expired += len(late)
