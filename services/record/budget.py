"""Budgets of the logs of each publisher, so that one of them cannot fill the recordings."""

import collections
import time
from collections.abc import Callable

from congrasp.common.errors import CongraspError
from congrasp.learner.hub.limits import certificate

Name = tuple[str, str]
"""Role and name of a publisher."""
_NAMES = 64
"""Most names of one identity."""
_IDENTITIES = 1024
_IDLE_S = 60.0
"""Time after which a silent name may be replaced."""
_BYTES_PER_SECOND = 16 << 20
"""Bytes of an identity's entries, in the long term."""
_BURST_BYTES = 256 << 20
"""Bytes of an identity's entries, at once."""


class LogBudget:
    """Budgets of the logs of one identity: number of names, and bytes per second. Not thread-safe.

    An identity is a role and, for actors, a certificate. The excess over a budget is dropped; the
    logs of others are not affected.
    """

    def __init__(
        self, on_forget: Callable[[Name], None], clock: Callable[[], float] = time.monotonic
    ):
        """Starts without names.

        Args:
          on_forget: called with a name that is replaced by another.
          clock: seconds, monotonic.
        """
        self._on_forget = on_forget
        self._clock = clock
        self._last_heard: dict[Name, collections.OrderedDict[Name, float]] = {}
        self._bytes: dict[Name, tuple[float, float]] = {}  # level, and its time

    def admit(self, who: Name) -> None:
        """Admits a message of a publisher.

        Raises:
          CongraspError: its identity has too many names, or has used up its bytes.
        """
        identity = _identity(who)
        now = self._clock()
        if identity not in self._last_heard and len(self._last_heard) >= _IDENTITIES:
            raise CongraspError(f"More than {_IDENTITIES} identities publish logs.")
        names = self._last_heard.setdefault(identity, collections.OrderedDict())
        if who not in names and len(names) >= _NAMES:
            self._replace_oldest(names, now)
        names[who] = now
        names.move_to_end(who)
        if self._level(identity, now) <= 0:
            mebibytes = _BYTES_PER_SECOND >> 20
            raise CongraspError(
                f"One certificate publishes more than {mebibytes} MiB of logs a second."
            )

    def _replace_oldest(self, names: "collections.OrderedDict[Name, float]", now: float) -> None:
        """Removes the name that was silent for longest.

        Raises:
          CongraspError: it was heard recently.
        """
        oldest = next(iter(names))
        if names[oldest] > now - _IDLE_S:
            raise CongraspError(f"More than {_NAMES} names of one certificate publish logs.")
        del names[oldest]
        self._on_forget(oldest)

    def charge(self, who: Name, size: int) -> None:
        """Charges a publisher for recorded bytes."""
        identity = _identity(who)
        now = self._clock()
        level = self._level(identity, now) - size
        self._bytes[identity] = (level, now)

    def _level(self, identity: Name, now: float) -> float:
        """Bytes that an identity may still use at once."""
        level, since = self._bytes.get(identity, (float(_BURST_BYTES), now))
        return min(_BURST_BYTES, level + (now - since) * _BYTES_PER_SECOND)


def _identity(who: Name) -> Name:
    """The identity of a publisher: its role and, for actors, its certificate."""
    role, name = who
    return role, certificate(name) if role == "actor" else ""
