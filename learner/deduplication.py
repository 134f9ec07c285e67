"""Sequence deduplication: which rollouts of an actor's incarnation were decided on, so that none is taken twice."""

import dataclasses

from common.wire.messages import RolloutHeader

_WINDOW = 64  # sequence numbers by which an actor's rollouts may overtake one another
_GAP = 1 << 16  # rollouts that one gap counts at most; an actor that makes its numbers up has no more to count


@dataclasses.dataclass
class Sequences:
    """An incarnation's sequence numbers that were decided on: all below `next` but those skipped, and `ahead`."""

    next: int = 0
    ahead: set[int] = dataclasses.field(default_factory=set)
    refused: set[int] = dataclasses.field(default_factory=set)
    """Those among them that were refused, as far as they are recent; the others were accepted."""
    skipped: int = 0
    """Sequence numbers below `next` that never came."""
    rollouts: int = 0
    """Accepted ones."""
    version: int = -1
    """Of the newest accepted one."""

    def __contains__(self, sequence: int) -> bool:
        return sequence < self.next or sequence in self.ahead

    def add(self, header: RolloutHeader, accepted: bool) -> None:
        """Notes the decision on a rollout."""
        if accepted:
            self.rollouts += 1
            self.version = header.version
        else:
            self.refused.add(header.sequence)
        self.ahead.add(header.sequence)
        if len(self.ahead) > _WINDOW:
            self.skipped += min(_GAP, min(self.ahead) - self.next)
            self.next = min(self.ahead)
        while self.next in self.ahead:
            self.ahead.remove(self.next)
            self.next += 1
        if len(self.refused) > _WINDOW:
            self.refused.remove(min(self.refused))

    @property
    def missing(self) -> int:
        """Sequence numbers below the highest that are not decided on."""
        ahead = max(self.ahead, default=self.next - 1) + 1 - self.next - len(self.ahead)
        return self.skipped + min(_GAP, ahead)
