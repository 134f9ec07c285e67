"""Tables of the paper, with figures to compare with rows of the same hand, method and source of constraints."""

import dataclasses
from typing import NamedTuple


@dataclasses.dataclass(frozen=True)
class PaperRow:
    """Figures of one row of the paper: success, and errors by the names of the rows here."""

    success: float
    errors: dict[str, float] = dataclasses.field(default_factory=dict)


def _heading(success: float, rad: float, m: float) -> PaperRow:
    return PaperRow(success, {"heading_rad": rad, "heading_m": m})


def _pose(success: float, rad: float, m: float) -> PaperRow:
    return PaperRow(success, {"pose_rad": rad, "pose_m": m})


def _trajectory(success: float, rad: float, m: float) -> PaperRow:
    return PaperRow(success, {"traj_rad": rad, "traj_m": m})


def _affordance(success: float, ratio: float) -> PaperRow:
    return PaperRow(success, {"affordance_ratio": ratio})


_HANDS = {
    "human": {
        "heading": _heading(0.960, 0.143, 0.020),
        "pose": _pose(0.964, 0.253, 0.017),
        "trajectory": _trajectory(0.950, 0.082, 0.020),
        "affordance": _affordance(0.956, 0.014),
    },
    "allegro": {
        "heading": _heading(0.904, 0.160, 0.016),
        "pose": _pose(0.957, 0.145, 0.019),
        "trajectory": _trajectory(0.944, 0.082, 0.026),
        "affordance": _affordance(0.918, 0.006),
    },
    "sharpa": {
        "heading": _heading(0.967, 0.114, 0.013),
        "pose": _pose(0.992, 0.145, 0.014),
        "trajectory": _trajectory(0.987, 0.079, 0.022),
        "affordance": _affordance(0.959, 0.010),
    },
}
_CAPTURED = {
    "ours": {
        "heading": _heading(0.969, 0.137, 0.020),
        "pose": _pose(0.874, 0.316, 0.036),
        "trajectory": _trajectory(0.955, 0.162, 0.029),
        "affordance": _affordance(0.982, 0.016),
        "pose+trajectory": PaperRow(0.865, {"pose_rad": 0.327, "pose_m": 0.046, "traj_rad": 0.156, "traj_m": 0.028}),
        "trajectory+affordance": PaperRow(0.923, {"traj_rad": 0.185, "traj_m": 0.027, "affordance_ratio": 0.045}),
    },
    "graspxl": {"heading": _heading(0.942, 0.278, 0.028), "affordance": _affordance(0.919, 0.016)},
    "dgrasp": {"pose": _pose(0.512, 0.390, 0.031)},
    "pd": {"trajectory": _trajectory(0.645, 0.160, 0.019)},
    "no-dynamic-center": {
        "heading": _heading(0.894, 0.182, 0.021),
        "pose": _pose(0.760, 0.352, 0.041),
        "trajectory": _trajectory(0.667, 0.169, 0.033),
        "affordance": _affordance(0.931, 0.013),
    },
    "no-feedforward": {"trajectory": _trajectory(0.760, 0.170, 0.029)},
}
_CROSS = {
    "heading": _heading(0.976, 0.148, 0.021),
    "pose": _pose(0.817, 0.270, 0.036),
    "trajectory": _trajectory(0.733, 0.183, 0.029),
    "pose+trajectory": PaperRow(0.698, {"pose_rad": 0.268, "pose_m": 0.048, "traj_rad": 0.177, "traj_m": 0.028}),
}
_OBJECTS = {
    "ours": {"": 0.927, "small": 0.929, "medium": 0.936, "large": 0.917},
    "graspxl": {"": 0.822, "small": 0.859, "medium": 0.845, "large": 0.790},
    "no-dynamic-center": {"": 0.880, "small": 0.871, "medium": 0.893, "large": 0.877},
}
CENTER_GROUP = "hand's centre alone above the table"
"""Group of the row whose headings only keep the hand's centre above the table; the paper has no rule for the hand."""
SOURCES = {
    "hands": "procedural references for each hand (hand morphology)",
    "captured": "captured constraints of GRAB and OakInk (single and composed constraints, ablation)",
    "cross": "captured constraints of DexYCB (cross-dataset)",
    "objects": "large-scale objects of Objaverse",
}
"""Tables of the paper, by the source of their episodes."""
CAPTURED_SETS = {"grab": "captured", "oakink": "captured", "dexycb": "cross"}
"""Table of each captured data set; others have none."""


def paper_row(source: str, hand: str, method: str, constraint: str, group: str = "") -> PaperRow | None:
    """Returns the paper's row for these episodes; None if it has none.

    Args:
      source: one of `SOURCES`, or empty for none.
      hand: name of the hand; in the tables of captured constraints and of large-scale objects, the human hand is
        MANO's.
      method: method of `common.task.methods`.
      constraint: constraints joined by `+`.
      group: group of objects or pairs; only its first word is compared.
    """
    word = group.split(" ")[0]
    if source == "hands" and method == "ours" and group in ("", CENTER_GROUP):
        return _HANDS.get(hand, {}).get(constraint)
    if hand != "human":
        return None
    if source == "captured" and not group:
        return _CAPTURED.get(method, {}).get(constraint)
    if source == "cross" and method == "ours" and not group:
        return _CROSS.get(constraint)
    if source == "objects" and constraint == "heading" and (success := _OBJECTS.get(method, {}).get(word)):
        return PaperRow(success)
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
_ABLATION = ("ours", "no-dynamic-center", "no-feedforward")


def paper_lines() -> list[PaperLine]:
    """Returns every line of the paper's tables, in its order."""
    constraints = tuple(_HANDS["human"])
    lines = []
    for method in ("graspxl", "dgrasp", "pd", "ours"):
        of_method = {name: _CAPTURED[method][name] for name in constraints if name in _CAPTURED[method]}
        lines += [PaperLine("single", "captured", name, "human", method, "", row) for name, row in of_method.items()]
    lines.sort(key=lambda line: constraints.index(line.constraint))
    for name in ("pose+trajectory", "trajectory+affordance"):
        lines.append(PaperLine("composed", "captured", name, "human", "ours", "", _CAPTURED["ours"][name]))
    lines += [PaperLine("cross", "cross", name, "human", "ours", "", row) for name, row in _CROSS.items()]
    for method in ("graspxl", "ours", "no-dynamic-center"):
        for group, success in _OBJECTS[method].items():
            lines.append(PaperLine("objects", "objects", "heading", "human", method, group, PaperRow(success)))
    for name in constraints:
        lines += [PaperLine("hands", "hands", name, hand, "ours", "", rows[name]) for hand, rows in _HANDS.items()]
    for name in constraints:
        for method in _ABLATION:
            if name in _CAPTURED[method]:
                lines.append(PaperLine("ablation", "captured", name, "human", method, "", _CAPTURED[method][name]))
    return lines
