"""Admission: how many rollouts may be on their way, so that none is too old when it is used. Knows no transport."""

import dataclasses
import secrets
import threading
import time
from collections.abc import Callable

Owner = tuple[str, str]
"""(actor, incarnation)."""


@dataclasses.dataclass
class Ledger:
    """What became of tickets and rollouts since the run began."""

    granted: int = 0
    expired: int = 0
    accepted: int = 0
    duplicate: int = 0
    refused: int = 0
    stale: int = 0
    consumed: int = 0


class StalenessManager:
    """Grants tickets for rollouts while `queued + running < (eta + 1) * batch`.

    This is `accepted + running < (eta + version + 1) * batch` with the `version * batch` rollouts of past updates
    taken off both sides: with first-in-first-out consumption a rollout started at version v is used at v + eta at the
    latest. Tickets of owners that died, or that ran out of time, return. All methods are thread safe.
    """

    def __init__(
        self,
        *,
        max_staleness: int,
        batch: int,
        ticket_seconds: float = 120.0,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Nothing is on its way.

        Args:
          max_staleness: eta, versions.
          batch: rollouts that one update consumes.
          ticket_seconds: after this a ticket that was not redeemed returns.
          clock: seconds, monotonic.
        """
        self.max_staleness = max_staleness
        self.batch = batch
        self.ledger = Ledger()
        self._ticket_seconds = ticket_seconds
        self._clock = clock
        self._lock = threading.Lock()
        self._tickets: dict[str, tuple[Owner, float]] = {}
        self._queued = 0

    @property
    def running(self) -> int:
        """Tickets that are out."""
        with self._lock:
            self._expire()
            return len(self._tickets)

    @property
    def queued(self) -> int:
        """Rollouts accepted and not yet consumed."""
        return self._queued

    def grant(self, owner: Owner) -> str | None:
        """A new ticket, or None while enough is on its way."""
        with self._lock:
            self._expire()
            if self._queued + len(self._tickets) >= (self.max_staleness + 1) * self.batch:
                return None
            ticket = secrets.token_hex(8)
            self._tickets[ticket] = (owner, self._clock() + self._ticket_seconds)
            self.ledger.granted += 1
            return ticket

    def accept(self, ticket: str) -> None:
        """A rollout was accepted; its ticket (which may have expired meanwhile) is redeemed."""
        with self._lock:
            self._tickets.pop(ticket, None)
            self._queued += 1
            self.ledger.accepted += 1

    def give_back(self, ticket: str) -> None:
        """A ticket returns without a rollout (it was refused, or a duplicate)."""
        with self._lock:
            self._tickets.pop(ticket, None)

    def forget(self, owner: Owner) -> int:
        """The tickets of a dead owner return; their number."""
        with self._lock:
            mine = [ticket for ticket, (holder, _) in self._tickets.items() if holder == owner]
            for ticket in mine:
                del self._tickets[ticket]
            self.ledger.expired += len(mine)
            return len(mine)

    def leave_queue(self, *, stale: bool) -> None:
        """A queued rollout was consumed, or dropped because it had become too old."""
        with self._lock:
            self._queued -= 1
            if stale:
                self.ledger.stale += 1
            else:
                self.ledger.consumed += 1

    def _expire(self) -> None:
        now = self._clock()
        late = [ticket for ticket, (_, deadline) in self._tickets.items() if deadline < now]
        for ticket in late:
            del self._tickets[ticket]
        self.ledger.expired += len(late)
