"""Deduplication: records which rollouts of an actor's incarnation have been decided, so that none is accepted twice."""

import collections
import dataclasses
from collections.abc import Collection, Mapping
from typing import Any

from congrasp.common.wire.messages import RolloutHeader
from congrasp.learner.hub.limits import certificate
from congrasp.learner.hub.staleness import Owner

_INCARNATIONS = 1024  # incarnations whose sequences are kept
_WINDOW = 64  # sequence numbers by which an actor's rollouts may overtake one another
_FAR = 1 << 10  # most sequence numbers below `next` that a checkpoint lists one by one, from the first queued one on


@dataclasses.dataclass
class Sequences:
    """Decided sequence numbers of an incarnation: all below `next` except the skipped ones, and `ahead`."""

    next: int = 0
    ahead: set[int] = dataclasses.field(default_factory=set)
    refused: set[int] = dataclasses.field(default_factory=set)
    """Refused ones among them, if recent; the others were accepted."""
    skipped: int = 0
    """Number of sequence numbers below `next` that never arrived, limited by tickets."""
    granted: int = 0
    """Number of its tickets, which bounds its rollouts apart from those of earlier sessions."""
    rollouts: int = 0
    """Number of accepted rollouts."""
    version: int = -1
    """Version of the newest accepted one."""

    def __contains__(self, sequence: int) -> bool:
        return sequence < self.next or sequence in self.ahead

    def add(self, header: RolloutHeader, accepted: bool) -> None:
        """Records the decision on a rollout."""
        if accepted:
            self.rollouts += 1
            self.version = header.version
        else:
            self.refused.add(header.sequence)
        self.ahead.add(header.sequence)
        if len(self.ahead) > _WINDOW:
            self.skipped += self._made(min(self.ahead) - self.next)
            self.next = min(self.ahead)
        while self.next in self.ahead:
            self.ahead.remove(self.next)
            self.next += 1
        if len(self.refused) > _WINDOW:
            self.refused.remove(min(self.refused))

    @property
    def missing(self) -> int:
        """Number of undecided sequence numbers below the highest."""
        ahead = max(self.ahead, default=self.next - 1) + 1 - self.next - len(self.ahead)
        return self.skipped + self._made(ahead)

    def _made(self, gap: int) -> int:
        """Size of a gap in the sequence numbers, limited by tickets, since an actor may invent numbers."""
        return max(0, min(gap, self.granted + _WINDOW - self.skipped))


class SequenceTable:
    """Sequences of the incarnations seen, up to a limit."""

    def __init__(self) -> None:
        """Starts empty."""
        self._known: collections.OrderedDict[Owner, Sequences] = collections.OrderedDict()
        self._forgotten_missing = 0

    def of(self, owner: Owner) -> Sequences:
        """Returns an incarnation's sequences; older ones are dropped if there are too many."""
        sequences = self._known.setdefault(owner, Sequences())
        self._known.move_to_end(owner)
        if len(self._known) > _INCARNATIONS:
            # A certificate with many incarnations displaces only its own, so that it cannot displace those of others.
            mine = (of for of in self._known if of != owner and certificate(of[0]) == certificate(owner[0]))
            self._forgotten_missing += self._known.pop(next(mine, next(iter(self._known)))).missing
        return sequences

    def get(self, owner: Owner) -> Sequences | None:
        """Returns an incarnation's sequences; None if it has not been seen."""
        return self._known.get(owner)

    @property
    def missing(self) -> int:
        """Number of undecided sequence numbers below the highest of each incarnation."""
        return self._forgotten_missing + sum(each.missing for each in self._known.values())

    def durable(self, waiting: Collection[tuple[Owner, int]]) -> dict[str, Any]:
        """Returns the part to be stored in a checkpoint, as JSON; rollouts queued for an update count as undecided."""
        rows = []
        for owner, known in self._known.items():
            queued = {sequence for of, sequence in waiting if of == owner}
            start = max(min(queued | {known.next}), known.next - _FAR)  # an actor may make its numbers up
            decided = set(range(start, known.next)) | known.ahead
            rows.append([*owner, start, sorted(decided - queued), sorted(known.refused), known.skipped])
        return {"forgotten_missing": self._forgotten_missing, "sequences": rows}

    def restore(self, durable: Mapping[str, Any]) -> None:
        """Restores the result of `durable`."""
        self._forgotten_missing = durable["forgotten_missing"]
        for actor, incarnation, start, ahead, refused, skipped in durable["sequences"]:
            self._known[actor, incarnation] = Sequences(start, set(ahead), set(refused), skipped, skipped)
