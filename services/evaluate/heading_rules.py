"""Effect of the rules for headings: shares of sampled headings that episodes use or drop."""

import dataclasses

import numpy as np

from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.sampling.headings import Headings, opposed_at
from congrasp.common.task.sampling.reach import feasible
from congrasp.services.evaluate.experiment import Experiment
from congrasp.services.evaluate.plan import repeated_rests

_LIFT = np.array([0, 0, 10, 0, 0, 0, 0])
"""Added to a resting pose, it lies higher than any hand reaches down, m."""


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
    """Share of the headings by the paper's rules alone that have surfaces to press on from both
    sides.
    """

    def sentence(self, hand: str) -> str:
        """Summary, such as "Headings of the human hand: 24 % of those sampled are kept …"."""
        return (
            f"Headings of the {hand} hand: {_percent(self.kept)} of the sampled ones are kept, "
            f"{_percent(self.from_below)} dropped because they come from below and "
            f"{_percent(self.no_room)} because the table leaves the hand no room; "
            f"{_percent(self.moved)} of the kept ones are moved back from the table. By the "
            f"paper's rules, with the hand's centre above the table, "
            f"{_percent(self.kept_by_center)} are kept; {_percent(1 - self.opposed)} of these "
            "rules' headings have no surfaces to press on from both sides, which the full rules do "
            "not sample. The paper states no such rules."
        )


def _percent(share: float) -> str:
    """Formats a share, such as "24 %"."""
    return f"{100 * share:.0f} %"


def heading_rules(experiment: Experiment) -> HeadingRules:
    """Effect of the rules on the sampled headings of the whole surface, over all resting poses of
    the objects.
    """
    total = 0
    below = 0
    opposed = []
    for n, obj in enumerate(experiment.scaled):
        headings = _sampled_headings(experiment.bank, n)
        by_center = _sampled_headings(experiment.by_center, n)
        opposed.append(opposed_at(by_center, obj, np.zeros(len(obj.points), bool)))
        for rest in obj.rest_poses:
            total += len(headings.direction)
            below += int((~feasible(headings, rest + _LIFT)).sum())
    kept, moved = _count_kept(experiment.bank)
    kept_by_center, _ = _count_kept(experiment.by_center)
    return HeadingRules(
        kept=kept / total,
        from_below=below / total,
        no_room=1 - (kept + below) / total,
        moved=moved / kept,
        kept_by_center=kept_by_center / total,
        opposed=float(np.mean(opposed)),
    )


def _sampled_headings(bank: ConstraintBank, n: int) -> Headings:
    """Sampled headings of the whole surface of an object, before they are moved."""
    columns = [getattr(bank, f"heading_{name}")[n, 0] for name in Headings._fields]
    return Headings(*(np.asarray(column, np.float64) for column in columns))


def _count_kept(bank: ConstraintBank) -> tuple[int, int]:
    """Numbers of pairs of a heading and a resting pose that a bank keeps, and of those moved
    back.
    """
    index = np.asarray(bank.heading_index)[:, 0]
    back = np.asarray(bank.heading_back)[:, 0]
    kept = 0
    moved = 0
    for n, r in np.argwhere(~repeated_rests(np.asarray(bank.rest))):
        headings, first = np.unique(index[n, r], return_index=True)
        kept += len(headings)
        moved += int((back[n, r][first] > 0).sum())
    return kept, moved
