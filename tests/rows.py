"""Rows of an evaluation that no evaluation made, for what shows and compares them."""

import itertools

from congrasp.services.evaluate.paper.figures import paper_row
from congrasp.services.evaluate.scores import ERROR_COLUMNS, Row, RowDescription, summarise

FORCES = {
    f"{name}_{of}": 1.0
    for name, of in itertools.product(("link_force", "force_sum", "torque_share"), ("mean", "p95"))
}
FORCES |= {"force_peak_n": 1.0, "force_mean_n": 1.0}


def summarised(name, hand, sample, *, objects, held_2s=True, **facts):
    """The row of a sample's episodes."""
    return summarise(RowDescription(name, hand, objects, held_2s, **facts), sample)


def _no_errors() -> dict[str, float]:
    """Zero for every error of every constraint."""
    errors: dict[str, float] = {}
    for names in ERROR_COLUMNS.values():
        errors |= dict.fromkeys(names, 0.0)
    return errors


def row(  # noqa: PLR0913
    constraint,
    success,
    low,
    high,
    *,
    hand="human",
    method="ours",
    group="",
    errors=None,
    margins=None,
    source="",
):
    """A row of 100 episodes on 8 objects."""
    return Row(
        constraint=constraint,
        hand=hand,
        method=method,
        group=group,
        episodes=100,
        covered=8,
        pool=8,
        distinct=100,
        independent=100.0,
        mass_kg=0.2,
        success=success,
        success_low=low,
        success_high=high,
        success_all=success,
        held_2s=None,
        held_2s_low=None,
        held_2s_high=None,
        held_all=None,
        errors=_no_errors() | (errors or {}),
        forces=FORCES,
        episode_return=0.0,
        links_at_removal=5.0,
        diverged=0.0,
        paper=paper_row(source, hand, method, constraint, group),
        margins=margins or {},
    )
