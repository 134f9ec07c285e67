"""Shares, places and expiry of the tickets with which actors produce rollouts."""

import collections
import math
import statistics
import time
from collections.abc import Callable

from congrasp.learner.hub.limits import PutOff, certificate

_MAX_DELIVERIES = 256
"""Rollouts over which shares and the run's usual duration are measured."""
_MAX_DURATIONS = 16
"""Rollouts over which an actor's duration is measured."""
_MAX_ACTORS = 1024
"""Actors that are measured."""
_SLOW_FACTOR = 2.0
"""Multiple of the run's usual duration above which an actor holds no place."""
_LATE_FACTOR = 4.0
"""Multiple of the run's usual duration after which a ticket loses its place."""
_EXPIRY_FACTOR = 4.0
"""Multiple of the longest of an actor's recent rollouts after which a ticket expires."""
_LEAST_DURATION_S = 5.0
"""Least duration of a ticket."""


class TicketBudget:
    """Shares, places and expiry of tickets, from each actor's deliveries. Not thread-safe.

    A certificate's share of the tickets equals its share of the latest rollouts. Without any
    rollouts it may hold so many that a whole batch is left to the others. A ticket expires after a
    few times the usual duration of its actor's rollouts. A certificate whose tickets expire must
    back off, longer each time.

    A ticket holds a place in a batch only while its rollout is due by the run's usual duration: not
    if its actor usually takes twice as long, and never for four times as long. A later rollout is
    accepted if it is still fresh. A slow or failing actor therefore blocks no other.
    """

    def __init__(
        self, slots: int, batch: int, seconds: float, clock: Callable[[], float] = time.monotonic
    ):
        """Starts without deliveries.

        Args:
          slots: total number of tickets.
          batch: rollouts of an update.
          seconds: initial duration of a ticket.
          clock: seconds, monotonic.
        """
        self._slots = slots
        self._least = max(1, slots - batch, slots // 2)
        self._seconds = seconds
        self._delivered: collections.deque[tuple[str, float]] = collections.deque(
            maxlen=_MAX_DELIVERIES
        )
        self._needed: collections.OrderedDict[str, collections.deque[float]] = (
            collections.OrderedDict()
        )
        self._usual = math.inf
        self._late = PutOff(clock)

    def admits(self, actor: str, held: int) -> bool:
        """True if an actor may have another ticket when its certificate holds `held`."""
        if self._late.seconds(actor):
            return False
        of_certificate = sum(name == certificate(actor) for name, _ in self._delivered)
        delivered = max(1, len(self._delivered))
        share = math.ceil(self._slots * of_certificate / delivered)
        return held < max(self._least, share)

    def holds_place(self, actor: str, seconds: float) -> bool:
        """True if a ticket granted to an actor `seconds` ago holds a place."""
        if seconds > _LATE_FACTOR * self._usual:
            return False
        needed = self._needed.get(actor)
        return not needed or statistics.median(needed) <= _SLOW_FACTOR * self._usual

    def lasts(self, actor: str) -> float:
        """Seconds until a ticket granted to the actor now expires."""
        durations = self._needed.get(actor) or [seconds for _, seconds in self._delivered]
        if not durations:
            return self._seconds
        return min(self._seconds, max(_LEAST_DURATION_S, _EXPIRY_FACTOR * max(durations)))

    def deliver(self, actor: str, seconds: float) -> None:
        """Records a rollout that arrived `seconds` after its ticket was granted, in time or not."""
        self.measure(actor, seconds)
        self._delivered.append((certificate(actor), seconds))
        self._usual = statistics.median(needed for _, needed in self._delivered)
        self._late.forgive(actor)

    def measure(self, actor: str, seconds: float) -> None:
        """Records the duration of an actor's rollout, useful or not."""
        self._needed.setdefault(actor, collections.deque(maxlen=_MAX_DURATIONS)).append(seconds)
        self._needed.move_to_end(actor)
        if len(self._needed) > _MAX_ACTORS:
            self._needed.popitem(last=False)

    def expire(self, actor: str) -> None:
        """Records that a ticket of an actor has expired."""
        self._late.offend(actor)
