"""The paper's tables: figures to compare with rows of the same hand, method and source of
constraints.
"""

import dataclasses
import functools
import json
import pathlib
from typing import NamedTuple

CENTER_GROUP = "hand's centre alone above the table"
"""Group of the row whose headings only keep the hand's centre above the table; the paper has no
rule for the hand.
"""


@dataclasses.dataclass(frozen=True)
class PaperRow:
    """Figures of one row of the paper: success, and errors by the names of the rows here."""

    success: float
    errors: dict[str, float] = dataclasses.field(default_factory=dict)


SOURCES = {
    "hands": "procedural references for each hand (hand morphology)",
    "captured": (
        "captured constraints of GRAB and OakInk (single and composed constraints, ablation)"
    ),
    "cross": "captured constraints of DexYCB (cross-dataset)",
    "objects": "large-scale objects of Objaverse",
}
"""Tables of the paper, by the source of their episodes."""
CAPTURED_SETS = {"grab": "captured", "oakink": "captured", "dexycb": "cross"}
"""Table of each captured data set; others have none."""


def paper_row(
    source: str, hand: str, method: str, constraint: str, group: str = ""
) -> PaperRow | None:
    """Returns the paper's row for these episodes; None if it has none.

    Args:
      source: one of `SOURCES`, or empty for none.
      hand: name of the hand; in the tables of captured constraints and of large-scale objects, the
        human hand is MANO's.
      method: method of `common.task.methods`.
      constraint: constraints joined by `+`.
      group: group of objects or pairs; only its first word is compared.
    """
    if source == "hands" and group == CENTER_GROUP:
        group = ""
    if source == "objects":
        group, _, _ = group.partition(" ")
    key = (source, constraint, hand, method, group)
    for line in paper_lines():
        if (line.source, line.constraint, line.hand, line.method, line.group) == key:
            return line.figures
    return None


class PaperLine(NamedTuple):
    """A line of one of the paper's tables."""

    table: str
    """One of `TABLES`."""
    source: str
    """Source of its episodes, one of `SOURCES`."""
    constraint: str
    """Constraints joined by `+`."""
    hand: str
    method: str
    group: str
    """Size of the objects; empty for all."""
    figures: PaperRow


TABLES = {
    "single": "Single constraints",
    "composed": "Composed constraints",
    "cross": "Cross-dataset generalization",
    "objects": "Large-scale objects",
    "hands": "Hand morphology",
    "ablation": "Ablation",
}
"""The paper's tables with figures."""


@functools.cache
def paper_lines() -> tuple[PaperLine, ...]:
    """Returns every line of the paper's tables, in its order."""
    lines = []
    for row in json.loads(pathlib.Path(__file__).with_suffix(".json").read_text(encoding="utf-8")):
        figures = PaperRow(row.pop("success"), row.pop("errors"))
        lines.append(PaperLine(figures=figures, **row))
    return tuple(lines)
