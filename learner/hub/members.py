"""Liveliness tokens of peers, within bounds: each certificate's are listed up to a limit, and the others counted."""

import collections
import itertools

from congrasp.common.transport.keys import Alive
from congrasp.learner.hub.rate_limit import certificate

_EACH = 64
"""Most listed tokens of one role and certificate."""
_LISTED = 1024
"""Most entries of one listing, whose reply must fit into a message."""


class Members:
    """Processes of a run by their tokens; the caller serialises access."""

    def __init__(self) -> None:
        """Starts without members."""
        self._known: dict[tuple[str, str], set[Alive]] = collections.defaultdict(set)
        self._beyond: collections.Counter[tuple[str, str]] = collections.Counter()

    def note(self, who: Alive, alive: bool) -> bool:
        """Records a token that appeared or disappeared; returns True if it is a listed one."""
        account = who.role, certificate(who.id)
        known = self._known[account]
        if alive and (who in known or len(known) < _EACH):
            known.add(who)
            return True
        if who in known:
            known.discard(who)
            return True
        self._beyond[account] += 1 if alive else -1
        if self._beyond[account] <= 0:
            del self._beyond[account]
        return False

    def listed(self) -> list[Alive]:
        """Listed members, in order; if there are too many, the first of each certificate precedes all second ones."""
        ranks = (enumerate(sorted(known)) for _, known in sorted(self._known.items()))
        first = sorted(itertools.chain.from_iterable(ranks), key=lambda ranked: ranked[0])
        return sorted(who for _, who in first[:_LISTED])

    @property
    def unlisted(self) -> int:
        """Number of live tokens that are not listed."""
        known = sum(map(len, self._known.values()))
        return sum(self._beyond.values()) + max(0, known - _LISTED)
