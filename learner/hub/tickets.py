"""Who may hold how many tickets, for how long, and which of them are waited for: by what each actor has delivered.

A certificate may hold its share of the tickets, as large as its share of the latest rollouts that came in, and without
any at most so many that a whole batch is left to the others. A ticket expires after a few times what its actor usually
needs, and a certificate whose tickets expire is put off, longer each time.

A ticket holds a place in a batch, so that others wait for its rollout, only while that is about to come as the run's
usually do: not if its actor usually needs twice as long, and never for four times as long. Such a rollout is taken all
the same if it is fresh when it comes. So whoever is slow, or delivers nothing, stops nobody.
"""

import collections
import math
import statistics
import time
from collections.abc import Callable

from congrasp.learner.hub.rate_limit import PutOff, certificate

_RECENT = 256  # rollouts by which shares, and what the run's usually need, are measured
_OWN = 16  # and by which an actor is
_NAMES = 1024  # of actors that are measured
_SLOW = 2.0  # times what the run's rollouts usually need: an actor that needs longer is not waited for
_LATE = 4.0  # and no ticket is for longer
_TIMES = 4.0  # the longest of an actor's recent rollouts, until a ticket expires
_LEAST = 5.0  # seconds that every ticket lasts


class TicketBudget:
    """Shares, places and expiry of tickets. Not safe for several threads."""

    def __init__(self, slots: int, batch: int, seconds: float, clock: Callable[[], float] = time.monotonic):
        """Nobody has delivered anything.

        Args:
          slots: tickets that there are at most.
          batch: rollouts that an update needs.
          seconds: that a ticket lasts before anything is known.
          clock: seconds, monotonic.
        """
        self._slots, self._least = slots, max(1, slots - batch, slots // 2)
        self._seconds = seconds
        self._delivered: collections.deque[tuple[str, float]] = collections.deque(maxlen=_RECENT)
        self._needed: collections.OrderedDict[str, collections.deque[float]] = collections.OrderedDict()
        self._usual = math.inf
        self._late = PutOff(clock)

    def admits(self, actor: str, held: int) -> bool:
        """Whether an actor may have one more ticket, where its certificate holds so many."""
        if self._late.seconds(actor):
            return False
        mine = sum(name == certificate(actor) for name, _ in self._delivered)
        return held < max(self._least, math.ceil(self._slots * mine / max(1, len(self._delivered))))

    def holds_place(self, actor: str, seconds: float) -> bool:
        """Whether the rollout of a ticket that an actor was given so many seconds ago is waited for."""
        own = self._needed.get(actor)
        return seconds <= _LATE * self._usual and (not own or statistics.median(own) <= _SLOW * self._usual)

    def lasts(self, actor: str) -> float:
        """Seconds until a ticket expires that the actor is given now."""
        known = self._needed.get(actor) or [seconds for _, seconds in self._delivered]
        return min(self._seconds, max(_LEAST, _TIMES * max(known))) if known else self._seconds

    def deliver(self, actor: str, seconds: float) -> None:
        """Notes a rollout that came in so many seconds after its ticket was given, in time or not."""
        self.measure(actor, seconds)
        self._delivered.append((certificate(actor), seconds))
        self._usual = statistics.median(needed for _, needed in self._delivered)
        self._late.forgive(actor)

    def measure(self, actor: str, seconds: float) -> None:
        """Notes what an actor needed for a rollout, whether it was of use or not."""
        self._needed.setdefault(actor, collections.deque(maxlen=_OWN)).append(seconds)
        self._needed.move_to_end(actor)
        if len(self._needed) > _NAMES:
            self._needed.popitem(last=False)

    def expire(self, actor: str) -> None:
        """Notes that a ticket of an actor has expired."""
        self._late.offend(actor)
