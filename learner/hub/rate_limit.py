"""Rate limit of useless work, a token bucket for each actor's certificate; and how long an offender is put off.

A request that helps training costs nothing: a ticket that is granted, a rollout that is accepted. All others (asked for
in vain, refused, too old, sent twice) cost tokens by their size. Whoever has none left is told to come again later
before anything is decoded, so a flood costs the learner little, and the other actors nothing.
"""

import collections
import threading
import time
from collections.abc import Callable

from congrasp.common.transport.base import Handler
from congrasp.common.wire.codec import Message

DAMAGED = 1 << 20
"""Bytes that a message is charged for which cannot be decoded."""
_NAMES = 1024
_LONGEST = 600.0  # seconds that anybody is put off


class RateLimit:
    """Token buckets by certificate; safe to call from several threads."""

    def __init__(
        self,
        *,
        per_second: float = 200.0,
        most: float = 2000.0,
        unit: int = 256 << 10,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Starts with full buckets.

        Args:
          per_second: tokens that return each second.
          most: a bucket's size, tokens.
          unit: bytes that cost as much as a request without any.
          clock: seconds, monotonic.
        """
        self._per_second = per_second
        self._most = most
        self._unit = unit
        self._clock = clock
        self._lock = threading.Lock()
        self._levels: collections.OrderedDict[str, tuple[float, float]] = collections.OrderedDict()
        self.turned_away = 0
        """Requests that found their bucket empty."""

    def admits(self, key: str) -> bool:
        """Whether a request under an actor's key may be looked at; counts it if not."""
        with self._lock:
            fine = self._level(_account(key)) > 0
            self.turned_away += not fine
            return fine

    def charge(self, key: str, size: int) -> None:
        """Notes a request of `size` bytes that helped nobody."""
        name = _account(key)
        with self._lock:
            self._levels[name] = self._level(name) - 1 - size / self._unit, self._clock()
            self._levels.move_to_end(name)
            if len(self._levels) > _NAMES:
                self._levels.popitem(last=False)

    def charging(self, handler: Handler) -> Handler:
        """A handler of tickets or rollouts that charges for what it does not grant or accept."""

        def handle(key: str, request: Message) -> Message:
            helped = False
            try:
                reply = handler(key, request)
                helped = reply.meta.get("outcome") == "accepted" or bool(reply.meta.get("granted"))
                return reply
            finally:
                if not helped:
                    self.charge(key, sum(array.nbytes for array in request.arrays.values()))

        return handle

    def _level(self, name: str) -> float:
        level, since = self._levels.get(name, (self._most, 0.0))
        return min(self._most, level + (self._clock() - since) * self._per_second)


class PutOff:
    """Who offends is told to come again later: at once the first time, then after 1, 2, 4, … seconds.

    Offences are counted for each certificate, and one is forgiven for each useful rollout. Not safe for several
    threads.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        """Nobody has offended; `clock` counts seconds, monotonic."""
        self._clock = clock
        self._known: collections.OrderedDict[str, tuple[int, float]] = collections.OrderedDict()

    def offend(self, actor: str) -> None:
        """Notes an offence of an actor."""
        name = certificate(actor)
        count = self._known.get(name, (0, 0.0))[0] + 1
        seconds = 0.0 if count == 1 else min(_LONGEST, 2.0 ** min(count - 2, 20))
        self._known[name] = count, self._clock() + seconds
        self._known.move_to_end(name)
        if len(self._known) > _NAMES:
            self._known.popitem(last=False)

    def forgive(self, actor: str) -> None:
        """Notes something useful of an actor."""
        name = certificate(actor)
        count, until = self._known.pop(name, (0, 0.0))
        if count > 1:
            self._known[name] = count - 1, until

    def seconds(self, actor: str) -> float:
        """Seconds until the actor may come again, 0 for most."""
        return max(0.0, self._known.get(certificate(actor), (0, 0.0))[1] - self._clock())


def certificate(actor: str) -> str:
    """What the names of all actors with one certificate have in common."""
    return actor.partition(".")[0]


def _account(key: str) -> str:
    return certificate(key.rpartition("/")[2])
