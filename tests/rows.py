"""Rows of an evaluation that nobody made, for what shows and compares them."""

from congrasp.services.evaluate.paper import paper_row
from congrasp.services.evaluate.scores import ERRORS, Row

FORCES = {f"{name}_{of}": 1.0 for name in ("link_force", "force_sum", "torque_share") for of in ("mean", "p95")}
FORCES |= dict.fromkeys(("force_peak_n", "force_mean_n"), 1.0)


def row(constraint, success, low, high, *, hand="human", method="ours", group="", errors=None, margins=None, source=""):
    """A row of 100 episodes on 8 objects."""
    means = {name: 0.0 for names in ERRORS.values() for name in names.values()} | (errors or {})
    paper = paper_row(source, hand, method, constraint, group)
    return Row(
        constraint, hand, method, group, 100, 8, 8, success, low, high, None, None, None, means, FORCES, 0.0, 5.0, 0.0,
        paper, margins=margins or {},
    )  # fmt: skip
