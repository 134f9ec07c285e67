"""Budgets of the logs of each publisher, so that one of them cannot fill the recordings."""

import collections
import time
from collections.abc import Callable
from typing import NamedTuple

from congrasp.common.errors import CongraspError
from congrasp.learner.hub.limits import certificate

_MAX_NAMES_PER_IDENTITY = 64
_MAX_IDENTITIES = 1024
_IDLE_S = 60.0
"""Time in s after which a silent name or identity may be replaced by another."""
_REFILL_BYTES_PER_S = 16 << 20
"""Bytes of an identity's entries per second, in the long term."""
_MAX_BURST_BYTES = 256 << 20
"""Bytes of an identity's entries at once, after a pause."""


class Publisher(NamedTuple):
    """A process that publishes logs."""

    role: str
    name: str
    """Name of the process; that of an actor begins with its certificate."""


class Identity(NamedTuple):
    """Publishers that share a budget."""

    role: str
    certificate: str
    """Certificate of the actors; empty for other roles, whose publishers share one budget."""


class _Allowance(NamedTuple):
    """Bytes that an identity had left at some time."""

    left: float
    """Bytes; below zero after entries that were larger than the rest of the allowance."""
    time: float
    """Time in s of this value; the allowance has grown since."""


class LogBudget:
    """Budgets of all identities: a number of names, and bytes per second. Not thread-safe.

    The excess over a budget is dropped, and the logs of other identities are not affected. The
    bytes are a token bucket: `charge` takes the size of entries from the allowance of their
    identity, even below zero, and `admit` rejects messages until time has refilled it. The caller
    thus calls `admit` before it converts a message, and `charge` when the size of its entries is
    known.
    """

    def __init__(
        self, on_forget: Callable[[Publisher], None], clock: Callable[[], float] = time.monotonic
    ):
        """Starts without publishers.

        Args:
          on_forget: called with each publisher whose name was replaced by another.
          clock: seconds, monotonic.
        """
        self._on_forget = on_forget
        self._clock = clock
        # Time in s of the last message by publisher; the identity and the name that were silent for
        # longest come first.
        self._last_message: collections.OrderedDict[
            Identity, collections.OrderedDict[Publisher, float]
        ] = collections.OrderedDict()
        self._allowances: dict[Identity, _Allowance] = {}

    def admit(self, publisher: Publisher) -> None:
        """Admits a message of a publisher.

        Raises:
          CongraspError: there are too many identities, or the publisher's has too many names or has
            used up its bytes.
        """
        identity = _identity(publisher)
        now = self._clock()
        if self._bytes_left(identity, now) <= 0:
            rate = _REFILL_BYTES_PER_S >> 20
            raise CongraspError(
                f"{_owner(identity)} publishes more than {rate} MiB of logs a second."
            )
        if identity not in self._last_message and len(self._last_message) >= _MAX_IDENTITIES:
            self._forget_oldest_identity(now)
        names = self._last_message.setdefault(identity, collections.OrderedDict())
        if publisher not in names and len(names) >= _MAX_NAMES_PER_IDENTITY:
            self._forget_oldest_name(identity, now)
        names[publisher] = now
        names.move_to_end(publisher)
        self._last_message.move_to_end(identity)

    def charge(self, publisher: Publisher, size: int) -> None:
        """Charges the identity of a publisher for `size` recorded bytes."""
        identity = _identity(publisher)
        now = self._clock()
        self._allowances[identity] = _Allowance(self._bytes_left(identity, now) - size, now)

    def _forget_oldest_identity(self, now: float) -> None:
        """Removes the identity that was silent for longest, and its names.

        Raises:
          CongraspError: it published recently, or its allowance is not full again.
        """
        identity, names = next(iter(self._last_message.items()))
        is_idle = max(names.values()) <= now - _IDLE_S
        if not is_idle or self._bytes_left(identity, now) < _MAX_BURST_BYTES:
            raise CongraspError(
                f"More than {_MAX_IDENTITIES} certificates and roles publish logs at once."
            )
        del self._last_message[identity]
        self._allowances.pop(identity, None)
        for publisher in names:
            self._on_forget(publisher)

    def _forget_oldest_name(self, identity: Identity, now: float) -> None:
        """Removes the name of an identity that was silent for longest.

        Raises:
          CongraspError: it published recently.
        """
        names = self._last_message[identity]
        oldest = next(iter(names))
        if names[oldest] > now - _IDLE_S:
            raise CongraspError(
                f"More than {_MAX_NAMES_PER_IDENTITY} names of {_owner(identity).lower()} publish "
                f"logs."
            )
        del names[oldest]
        self._on_forget(oldest)

    def _bytes_left(self, identity: Identity, now: float) -> float:
        """Bytes that an identity may still record at once."""
        allowance = self._allowances.get(identity)
        if allowance is None:
            return _MAX_BURST_BYTES
        refilled = (now - allowance.time) * _REFILL_BYTES_PER_S
        return min(_MAX_BURST_BYTES, allowance.left + refilled)


def _identity(publisher: Publisher) -> Identity:
    """Returns the identity of a publisher."""
    if publisher.role == "actor":
        return Identity(publisher.role, certificate(publisher.name))
    return Identity(publisher.role, "")


def _owner(identity: Identity) -> str:
    """Owner of an identity, at the start of a message."""
    return "One certificate" if identity.role == "actor" else "One role"
