"""Effect of the rules for headings: shares of the sampled headings that are kept, dropped and moved."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.sampling.headings import Headings, feasible, opposed_at
from congrasp.services.evaluate.plan import repeated_rests

_LIFT = np.array([0, 0, 10, 0, 0, 0, 0])
"""z coordinate of the resting pose, m: higher than any hand reaches down."""


@dataclasses.dataclass(frozen=True)
class HeadingRules:
    """Shares of all pairs of a sampled heading and a resting pose."""

    kept: float
    """Pairs used by episodes."""
    from_below: float
    """Pairs dropped because the hand would come from below."""
    no_room: float
    """Pairs dropped because the hand would be in the table."""
    moved: float
    """Share of the kept pairs whose position moves back from the table."""
    kept_by_center: float | None = None
    """Pairs kept if only the hand's centre must be above the table."""
    opposed: float | None = None
    """Share of the headings by the paper's rules alone that have surfaces to press on from both sides."""

    def sentence(self, hand: str) -> str:
        """Summary, such as "Headings of the human hand: 24 % of those sampled are kept …"."""
        kept, below, room, moved = (f"{100 * x:.0f} %" for x in (self.kept, self.from_below, self.no_room, self.moved))
        center = "" if self.kept_by_center is None or self.opposed is None else (
            f" By the paper's rules, with the hand's centre above the table, {100 * self.kept_by_center:.0f} % are "
            f"kept; {100 * (1 - self.opposed):.0f} % of these rules' headings have no surfaces to press on from both "
            "sides, which the full rules do not sample."
        )  # fmt: skip
        return (
            f"Headings of the {hand} hand: {kept} of the sampled ones are kept, {below} dropped because they come from "
            f"below and {room} because the table leaves the hand no room; {moved} of the kept ones are moved back from "
            f"the table.{center} The paper states no such rules."
        )


def heading_rules(
    bank: ConstraintBank, objects: Sequence[GraspObject], by_center: ConstraintBank | None = None
) -> HeadingRules:
    """Effect of the rules on the headings of the whole surface, over all resting poses.

    Args:
      bank: bank of the objects (`common.task.sampling.build.build_bank`).
      objects: N objects, scaled for the hand.
      by_center: the same with the task's `headings` set to `center`, which also takes the paper's rules alone.
    """
    total, below = 0, 0
    for n, obj in enumerate(objects):
        headings = _sampled(bank, n)
        for rest in obj.rest_poses:
            total += len(headings.direction)
            below += int((~feasible(headings, rest + _LIFT)).sum())
    kept, moved = _kept(bank)
    return HeadingRules(
        kept=kept / total,
        from_below=below / total,
        no_room=1 - (kept + below) / total,
        moved=moved / kept,
        kept_by_center=None if by_center is None else _kept(by_center)[0] / total,
        opposed=None if by_center is None else _opposed(by_center, objects),
    )


def _sampled(bank: ConstraintBank, n: int) -> Headings:
    """Sampled headings of the whole surface of an object, before they are moved."""
    axes = (getattr(bank, f"heading_{name}")[n, 0] for name in Headings._fields)
    return Headings(*(np.asarray(axis, np.float64) for axis in axes))


def _opposed(bank: ConstraintBank, objects: Sequence[GraspObject]) -> float:
    """Share of a bank's headings that have surfaces to press on from both sides."""
    found = [opposed_at(_sampled(bank, n), obj, np.zeros(len(obj.points), bool)) for n, obj in enumerate(objects)]
    return float(np.mean(found))


def _kept(bank: ConstraintBank) -> tuple[int, int]:
    """Numbers of pairs of a heading and a resting pose that a bank keeps, and of those moved back."""
    index, back = np.asarray(bank.heading_index)[:, 0], np.asarray(bank.heading_back)[:, 0]
    kept = moved = 0
    for n, r in np.argwhere(~repeated_rests(np.asarray(bank.rest))):
        found, first = np.unique(index[n, r], return_index=True)
        kept += len(found)
        moved += int((back[n, r][first] > 0).sum())
    return kept, moved
