"""Effect of the rules for headings: shares of the sampled headings that are kept, dropped and moved."""

import dataclasses

import numpy as np

from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.sampling.headings import Headings, feasible, opposed_at
from congrasp.services.evaluate.experiment import Experiment
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
    kept_by_center: float
    """Pairs kept if only the hand's centre must be above the table."""
    opposed: float
    """Share of the headings by the paper's rules alone that have surfaces to press on from both sides."""

    def sentence(self, hand: str) -> str:
        """Summary, such as "Headings of the human hand: 24 % of those sampled are kept …"."""
        shares = (self.kept, self.from_below, self.no_room, self.moved, self.kept_by_center, 1 - self.opposed)
        kept, below, room, moved, by_center, lost = (f"{100 * share:.0f} %" for share in shares)
        return (
            f"Headings of the {hand} hand: {kept} of the sampled ones are kept, {below} dropped because they come from "
            f"below and {room} because the table leaves the hand no room; {moved} of the kept ones are moved back from "
            f"the table. By the paper's rules, with the hand's centre above the table, {by_center} are kept; {lost} of "
            "these rules' headings have no surfaces to press on from both sides, which the full rules do not sample. "
            "The paper states no such rules."
        )


def heading_rules(experiment: Experiment) -> HeadingRules:
    """Effect of the rules on the sampled headings of the whole surface, over all resting poses of the objects."""
    bank, by_center, objects = experiment.bank, experiment.by_center, experiment.scaled
    total, below, opposed = 0, 0, []
    for n, obj in enumerate(objects):
        headings = _sampled(bank, n)
        opposed.append(opposed_at(_sampled(by_center, n), obj, np.zeros(len(obj.points), bool)))
        for rest in obj.rest_poses:
            total += len(headings.direction)
            below += int((~feasible(headings, rest + _LIFT)).sum())
    kept, moved = _kept(bank)
    return HeadingRules(
        kept=kept / total,
        from_below=below / total,
        no_room=1 - (kept + below) / total,
        moved=moved / kept,
        kept_by_center=_kept(by_center)[0] / total,
        opposed=float(np.mean(opposed)),
    )


def _sampled(bank: ConstraintBank, n: int) -> Headings:
    """Sampled headings of the whole surface of an object, before they are moved."""
    axes = (getattr(bank, f"heading_{name}")[n, 0] for name in Headings._fields)
    return Headings(*(np.asarray(axis, np.float64) for axis in axes))


def _kept(bank: ConstraintBank) -> tuple[int, int]:
    """Numbers of pairs of a heading and a resting pose that a bank keeps, and of those moved back."""
    index, back = np.asarray(bank.heading_index)[:, 0], np.asarray(bank.heading_back)[:, 0]
    kept = moved = 0
    for n, r in np.argwhere(~repeated_rests(np.asarray(bank.rest))):
        found, first = np.unique(index[n, r], return_index=True)
        kept += len(found)
        moved += int((back[n, r][first] > 0).sum())
    return kept, moved
