"""Limits for the owners of each certificate: rate of useless work, backoff of offenders, listed
tokens, events.

A request that helps training is free: a granted ticket, an accepted rollout. All others (denied,
refused, stale, duplicate) cost tokens by size. An actor without tokens gets the reply to retry
later before its request is decoded, so that a flood costs the learner little and other actors
nothing. The rate limit is a token bucket for each certificate.
"""

import collections
import itertools
import threading
import time
from collections.abc import Callable

from congrasp.common.transport.base import Handler, Transport
from congrasp.common.transport.keys import Alive, Keys
from congrasp.common.wire.codec import Message

DAMAGED = 1 << 20
"""Bytes charged for a message that cannot be decoded."""
_MAX_CERTIFICATES = 1024
_MAX_BACKOFF_S = 600.0
_EVENT_SECONDS = 1.0  # between two events of one kind
_MAX_LISTED_TOKENS = 64
"""Most listed tokens of one role and certificate."""
_MAX_LISTED_MEMBERS = 1024
"""Most entries of one listing, whose reply must fit into a message."""


class RateLimit:
    """Token buckets by certificate; thread-safe."""

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
          per_second: tokens added each second.
          most: size of a bucket, tokens.
          unit: bytes that cost as much as an empty request.
          clock: seconds, monotonic.
        """
        self._per_second = per_second
        self._most = most
        self._unit = unit
        self._clock = clock
        self._lock = threading.Lock()
        self._levels: collections.OrderedDict[str, tuple[float, float]] = collections.OrderedDict()
        self.rejected = 0
        """Number of requests with an empty bucket."""

    def admits(self, key: str) -> bool:
        """True if a request under an actor's key may be processed; counts it otherwise."""
        with self._lock:
            fine = self._level(certificate(sender(key))) > 0
            self.rejected += not fine
            return fine

    def charge(self, key: str, size: int) -> None:
        """Charges a useless request of `size` bytes."""
        name = certificate(sender(key))
        with self._lock:
            self._levels[name] = self._level(name) - 1 - size / self._unit, self._clock()
            self._levels.move_to_end(name)
            if len(self._levels) > _MAX_CERTIFICATES:
                self._levels.popitem(last=False)

    def wrap_handler(self, handler: Handler) -> Handler:
        """Wraps a handler of tickets or rollouts to charge for what it does not grant or accept."""

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
    """Backoff of offending certificates: none after the first offence, then 1, 2, 4, … seconds.

    Offences are counted for each certificate, and each useful rollout cancels one. Not thread-safe.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        """Starts without offences; `clock` counts seconds, monotonic."""
        self._clock = clock
        self._known: collections.OrderedDict[str, tuple[int, float]] = collections.OrderedDict()

    def offend(self, actor: str) -> None:
        """Records an offence of an actor."""
        name = certificate(actor)
        count = self._known.get(name, (0, 0.0))[0] + 1
        seconds = 0.0 if count == 1 else min(_MAX_BACKOFF_S, 2.0 ** min(count - 2, 20))
        self._known[name] = count, self._clock() + seconds
        self._known.move_to_end(name)
        if len(self._known) > _MAX_CERTIFICATES:
            self._known.popitem(last=False)

    def forgive(self, actor: str) -> None:
        """Records a useful rollout of an actor."""
        name = certificate(actor)
        count, until = self._known.pop(name, (0, 0.0))
        if count > 1:
            self._known[name] = count - 1, until

    def seconds(self, actor: str) -> float:
        """Seconds until the actor may send again, usually 0."""
        return max(0.0, self._known.get(certificate(actor), (0, 0.0))[1] - self._clock())


def certificate(actor: str) -> str:
    """Common part of the names of all actors with one certificate."""
    return actor.partition(".")[0]


def sender(key: str) -> str:
    """Returns the actor of a key, which access control may reserve for it."""
    return key.rpartition("/")[2]


class Events:
    """Publishes the events of a learner; at most one a second of a kind that untrusted peers can
    trigger.

    Attributes:
      keys: keys of the run.
      name: name of the learner.
    """

    def __init__(
        self,
        transport: Transport,
        run: str,
        name: str = "0",
        on_event: Callable[[str, str], None] = lambda level, text: None,
    ):
        """Publishes as the learner `name` of a run; `on_event` is called with level and text, and
        must not block.
        """
        self.keys = Keys(run)
        self.name = name
        self._transport = transport
        self._on_event = on_event
        self._last: dict[str, float] = {}

    def add(self, level: str, text: str, *, kind: str = "") -> None:
        """Publishes an event, unless one of its kind was published within a second."""
        now = time.monotonic()
        if kind and now - self._last.get(kind, -_EVENT_SECONDS) < _EVENT_SECONDS:
            return
        self._last[kind] = now
        self._on_event(level, text)
        meta = {"time": time.time(), "level": level, "text": text}
        self._transport.publish(self.keys.log("event", "learner", self.name), Message(meta=meta))


class Members:
    """Processes of a run by their tokens; the caller serialises access."""

    def __init__(self) -> None:
        """Starts without members."""
        self._known: dict[tuple[str, str], set[Alive]] = collections.defaultdict(set)
        self._beyond: collections.Counter[tuple[str, str]] = collections.Counter()

    def note(self, who: Alive, alive: bool) -> bool:
        """Records a token that appeared or disappeared; returns True if it is a listed one."""
        account = who.role, certificate(who.id)
        members = self._known[account]
        if alive and (who in members or len(members) < _MAX_LISTED_TOKENS):
            members.add(who)
            return True
        if who in members:
            members.discard(who)
            return True
        self._beyond[account] += 1 if alive else -1
        if self._beyond[account] <= 0:
            del self._beyond[account]
        return False

    def listed(self) -> list[Alive]:
        """Listed members, in order; if there are too many, the first of each certificate precedes
        all second ones.
        """
        ranks = (enumerate(sorted(known)) for _, known in sorted(self._known.items()))
        first = sorted(itertools.chain.from_iterable(ranks), key=lambda ranked: ranked[0])
        return sorted(who for _, who in first[:_MAX_LISTED_MEMBERS])

    @property
    def unlisted(self) -> int:
        """Number of live tokens that are not listed."""
        members = sum(map(len, self._known.values()))
        return sum(self._beyond.values()) + max(0, members - _MAX_LISTED_MEMBERS)
