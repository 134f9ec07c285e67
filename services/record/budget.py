"""What the logs of one identity may cost a recorder: names that it keeps something of, and bytes a second.

An identity is a role and, of actors, a certificate. What exceeds a budget is left out, and the others' logs are not
touched by it.
"""

import collections
import time
from collections.abc import Callable

from congrasp.common.errors import CongraspError
from congrasp.learner.hub.rate_limit import certificate

Name = tuple[str, str]
"""Role and name of who publishes."""

_NAMES = 64  # of one identity
_IDENTITIES = 1024
_IDLE = 60.0  # seconds after which a name makes room for another one
_PER_SECOND, _MOST = 16 << 20, 256 << 20  # bytes that an identity's entries may have, and save up


class LogBudget:
    """Names and bytes by identity. Not safe for several threads."""

    def __init__(self, on_forget: Callable[[Name], None], clock: Callable[[], float] = time.monotonic):
        """Nobody is known.

        Args:
          on_forget: given a name that made room for another one.
          clock: seconds, monotonic.
        """
        self._on_forget, self._clock = on_forget, clock
        self._heard: dict[Name, collections.OrderedDict[Name, float]] = {}
        self._bytes: dict[Name, tuple[float, float]] = {}

    def admit(self, who: Name) -> None:
        """Notes that somebody publishes.

        Raises:
          CongraspError: his identity has too many names, or has used its bytes up.
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
        """Notes that so many bytes were recorded for somebody."""
        identity, now = _identity(who), self._clock()
        self._bytes[identity] = self._level(identity, now) - size, now

    def _level(self, identity: Name, now: float) -> float:
        level, since = self._bytes.get(identity, (float(_MOST), now))
        return min(_MOST, level + (now - since) * _PER_SECOND)


def _identity(who: Name) -> Name:
    role, name = who
    return role, certificate(name) if role == "actor" else ""
