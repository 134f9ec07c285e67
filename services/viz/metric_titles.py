"""Titles and units of the metrics of a run, for figures and the studio."""

import json
import pathlib
from collections.abc import Iterator

from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.metrics import DIVERGED

_KINDS = {"rad": "angle", "m": "distance", "": "share of links"}
"""Kinds of a constraint's errors, by their units."""
_UNITS = {
    "_per_second": "1/s",
    "_seconds": "s",
    "_rad": "rad",
    "_m": "m",
    "_bytes": "bytes",
    "_ratio": "share",
}
"""Units of metrics without a title, by the endings of their names."""


def _titles_of_constraints() -> Iterator[tuple[str, tuple[str, str]]]:
    """Yields metric, title and unit of what is counted for each constraint."""
    for constraint in CONSTRAINTS:
        if constraint.blocks:
            title = f"Success with {constraint.title}"
            yield f"success/{constraint.name}", (title, "share of episodes")
    for constraint in CONSTRAINTS:
        for block in constraint.blocks:
            title = f"Episodes with {block.replace('_', ', ')}"
            yield f"episode/mask_{block}", (title, "share of episodes")
    for constraint in CONSTRAINTS:
        for spec in constraint.errors:
            title = f"{constraint.title.capitalize()} error: {_KINDS[spec.unit]}"
            yield f"episode/{spec.name}", (title, spec.unit or "share")


TITLES = {
    **json.loads(pathlib.Path(__file__).with_name("titles.json").read_text(encoding="utf-8")),
    f"episode/{DIVERGED}": ("Diverged physics", "share of episodes"),
    **dict(_titles_of_constraints()),
}
"""Title, unit and, where these are not enough, the meaning of each metric."""


def titled(metric: str) -> tuple[str, str]:
    """Title and unit of a metric, by its name after the process.

    The title of an unknown one is its name in words.
    """
    if metric in TITLES:
        title, unit, *_ = TITLES[metric]
        return title, unit
    group, _, name = metric.rpartition("/")
    ending = _unit_ending(name)
    words = name.removesuffix(ending).replace("_", " ")
    if group == "term":
        return words.capitalize(), "reward"
    if group == "failure":
        return f"Lost objects: {words}", "share of episodes"
    if group:
        words = f"{group.replace('_', ' ')}: {words}"
    return words.capitalize(), _UNITS.get(ending, "")


def _unit_ending(name: str) -> str:
    """The ending of a name that tells its unit; empty if none does."""
    for ending in _UNITS:
        if name.endswith(ending):
            return ending
    return ""
