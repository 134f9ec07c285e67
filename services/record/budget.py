"""Budgets of the logs of one identity in a recorder: number of names, and bytes per second.

An identity is a role and, for actors, a certificate. The excess over a budget is dropped; the logs of others are not
affected.
"""

import collections
import time
from collections.abc import Callable

from congrasp.common.errors import CongraspError
from congrasp.learner.hub.rate_limit import certificate

Name = tuple[str, str]
"""Role and name of a publisher."""

_NAMES = 64  # names of one identity
_IDENTITIES = 1024
_IDLE = 60.0  # seconds after which a silent name may be replaced
_PER_SECOND, _MOST = 16 << 20, 256 << 20  # bytes per second of an identity's entries, and their burst


class LogBudget:
    """Names and bytes by identity. Not thread-safe."""

    def __init__(self, on_forget: Callable[[Name], None], clock: Callable[[], float] = time.monotonic):
        """Starts without names.

        Args:
          on_forget: called with a name that is replaced by another.
          clock: seconds, monotonic.
        """
        self._on_forget, self._clock = on_forget, clock
        self._heard: dict[Name, collections.OrderedDict[Name, float]] = {}
        self._bytes: dict[Name, tuple[float, float]] = {}

    def admit(self, who: Name) -> None:
        """Admits a message of a publisher.

        Raises:
          CongraspError: its identity has too many names, or has used up its bytes.
        """
        identity, now = _identity(who), self._clock()
        if identity not in self._heard and len(self._heard) >= _IDENTITIES:
            raise CongraspError(f"More than {_IDENTITIES} identities publish logs.")
        heard = self._heard.setdefault(identity, collections.OrderedDict())
        if who not in heard and len(heard) >= _NAMES:
            oldest = next(iter(heard))
            if heard[oldest] > now - _IDLE:
                raise CongraspError(f"More than {_NAMES} names of one certificate publish logs.")
            del heard[oldest]
            self._on_forget(oldest)
        heard[who] = now
        heard.move_to_end(who)
        if self._level(identity, now) <= 0:
            raise CongraspError(f"One certificate publishes more than {_PER_SECOND >> 20} MiB of logs a second.")

    def charge(self, who: Name, size: int) -> None:
        """Charges a publisher for recorded bytes."""
        identity, now = _identity(who), self._clock()
        self._bytes[identity] = self._level(identity, now) - size, now

    def _level(self, identity: Name, now: float) -> float:
        level, since = self._bytes.get(identity, (float(_MOST), now))
        return min(_MOST, level + (now - since) * _PER_SECOND)


def _identity(who: Name) -> Name:
    role, name = who
    return role, certificate(name) if role == "actor" else ""
