"""Readable titles and units of a run's metrics."""

import json
import pathlib

from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.metrics import DIVERGED

_KINDS = {"rad": "angle", "m": "distance", "": "share of links"}
TITLES = {
    **json.loads(pathlib.Path(__file__).with_suffix(".json").read_text()),
    f"episode/{DIVERGED}": ("Diverged physics", "share of episodes"),
    **{
        f"success/{constraint.name}": (f"Success with {constraint.title}", "share of episodes")
        for constraint in CONSTRAINTS
        if constraint.blocks
    },
    **{
        f"episode/mask_{block}": (f"Episodes with {block.replace('_', ', ')}", "share of episodes")
        for constraint in CONSTRAINTS
        for block in constraint.blocks
    },
    **{
        f"episode/{spec.name}": (f"{constraint.title.capitalize()} error: {_KINDS[spec.unit]}", spec.unit or "share")
        for constraint in CONSTRAINTS
        for spec in constraint.errors
    },
}
"""Title, unit and, where these are not enough, the meaning of each metric."""
_UNITS = {"_per_second": "1/s", "_seconds": "s", "_rad": "rad", "_m": "m", "_bytes": "bytes", "_ratio": "share"}
"""Units of metrics without a title, by the endings of their names."""


def titled(metric: str) -> tuple[str, str]:
    """Title and unit of a metric by its name after the process; the title of an unknown one is its name in words."""
    if metric in TITLES:
        title, unit, *_ = TITLES[metric]
        return title, unit
    group, _, name = metric.rpartition("/")
    ending = next((end for end in _UNITS if name.endswith(end)), "")
    words = name.removesuffix(ending).replace("_", " ")
    if group == "term":
        return words.capitalize(), "reward"
    if group == "failure":
        return f"Lost objects: {words}", "share of episodes"
    return (f"{group.replace('_', ' ')}: {words}" if group else words).capitalize(), _UNITS.get(ending, "")
