"""Who may hold how many tickets, and for how long: by what each certificate's actors have delivered.

A certificate may hold its share of the tickets, as large as its share of the latest rollouts that came in, and without
any at most so many that a whole batch is left to the others: whoever holds tickets and delivers nothing stops nobody. A
ticket expires after a few times what its owner's certificate usually needs, and a certificate whose tickets expire is
put off, longer each time.
"""

import collections
import math
import time
from collections.abc import Callable

from learner.rate_limit import PutOff, certificate

_RECENT = 256  # rollouts by which shares are measured
_TIMES = 4.0  # the longest of a certificate's recent rollouts, until a ticket expires
_LEAST = 5.0  # seconds that every ticket lasts


class TicketBudget:
    """Shares and expiry of tickets by certificate. Not safe for several threads."""

    def __init__(self, slots: int, batch: int, seconds: float, clock: Callable[[], float] = time.monotonic):
        """Nobody has delivered anything.

        Args:
          slots: tickets that there are at most.
          batch: rollouts that an update needs.
          seconds: that a ticket lasts before anything is known.
          clock: seconds, monotonic.
        """
        self._slots, self._least = slots, max(1, slots - batch, slots // 2)
        self._seconds, self._clock = seconds, clock
        self._delivered: collections.deque[tuple[str, float]] = collections.deque(maxlen=_RECENT)
        self._late = PutOff(clock)

    def admits(self, actor: str, held: int) -> bool:
        """Whether an actor may have one more ticket, where its certificate holds so many."""
        if self._late.seconds(actor):
            return False
        mine = sum(name == certificate(actor) for name, _ in self._delivered)
        return held < max(self._least, math.ceil(self._slots * mine / max(1, len(self._delivered))))

    def lasts(self, actor: str) -> float:
        """Seconds until a ticket expires that the actor is given now."""
        own = [seconds for name, seconds in self._delivered if name == certificate(actor)]
        known = own or [seconds for _, seconds in self._delivered]
        return min(self._seconds, max(_LEAST, _TIMES * max(known))) if known else self._seconds

    def deliver(self, actor: str, seconds: float) -> None:
        """Notes a rollout that came in so many seconds after its ticket was given, in time or not."""
        self._delivered.append((certificate(actor), seconds))
        self._late.forgive(actor)

    def expire(self, actor: str) -> None:
        """Notes that a ticket of an actor has expired."""
        self._late.offend(actor)
