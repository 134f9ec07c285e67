"""Ticket budget: number, duration and places of each actor's tickets, from its deliveries.

A certificate's share of the tickets equals its share of the latest rollouts. Without any rollouts it may hold so many
that a whole batch is left to the others. A ticket expires after a few times the usual duration of its actor's rollouts.
A certificate whose tickets expire must back off, longer each time.

A ticket holds a place in a batch only while its rollout is due by the run's usual duration: not if its actor usually
takes twice as long, and never for four times as long. A later rollout is accepted if it is still fresh. A slow or
failing actor therefore blocks no other.
"""

import collections
import math
import statistics
import time
from collections.abc import Callable

from congrasp.learner.hub.rate_limit import PutOff, certificate

_RECENT = 256  # rollouts over which shares and the run's usual duration are measured
_OWN = 16  # rollouts over which an actor's duration is measured
_NAMES = 1024  # actors that are measured
_SLOW = 2.0  # multiple of the run's usual duration above which an actor holds no place
_LATE = 4.0  # multiple of the run's usual duration after which a ticket loses its place
_TIMES = 4.0  # multiple of the longest of an actor's recent rollouts after which a ticket expires
_LEAST = 5.0  # least duration of a ticket, s


class TicketBudget:
    """Shares, places and expiry of tickets. Not thread-safe."""

    def __init__(self, slots: int, batch: int, seconds: float, clock: Callable[[], float] = time.monotonic):
        """Starts without deliveries.

        Args:
          slots: total number of tickets.
          batch: rollouts of an update.
          seconds: initial duration of a ticket.
          clock: seconds, monotonic.
        """
        self._slots, self._least = slots, max(1, slots - batch, slots // 2)
        self._seconds = seconds
        self._delivered: collections.deque[tuple[str, float]] = collections.deque(maxlen=_RECENT)
        self._needed: collections.OrderedDict[str, collections.deque[float]] = collections.OrderedDict()
        self._usual = math.inf
        self._late = PutOff(clock)

    def admits(self, actor: str, held: int) -> bool:
        """True if an actor may have another ticket when its certificate holds `held`."""
        if self._late.seconds(actor):
            return False
        mine = sum(name == certificate(actor) for name, _ in self._delivered)
        return held < max(self._least, math.ceil(self._slots * mine / max(1, len(self._delivered))))

    def holds_place(self, actor: str, seconds: float) -> bool:
        """True if a ticket granted to an actor `seconds` ago holds a place."""
        own = self._needed.get(actor)
        return seconds <= _LATE * self._usual and (not own or statistics.median(own) <= _SLOW * self._usual)

    def lasts(self, actor: str) -> float:
        """Seconds until a ticket granted to the actor now expires."""
        known = self._needed.get(actor) or [seconds for _, seconds in self._delivered]
        return min(self._seconds, max(_LEAST, _TIMES * max(known))) if known else self._seconds

    def deliver(self, actor: str, seconds: float) -> None:
        """Records a rollout that arrived `seconds` after its ticket was granted, in time or not."""
        self.measure(actor, seconds)
        self._delivered.append((certificate(actor), seconds))
        self._usual = statistics.median(needed for _, needed in self._delivered)
        self._late.forgive(actor)

    def measure(self, actor: str, seconds: float) -> None:
        """Records the duration of an actor's rollout, useful or not."""
        self._needed.setdefault(actor, collections.deque(maxlen=_OWN)).append(seconds)
        self._needed.move_to_end(actor)
        if len(self._needed) > _NAMES:
            self._needed.popitem(last=False)

    def expire(self, actor: str) -> None:
        """Records that a ticket of an actor has expired."""
        self._late.offend(actor)
