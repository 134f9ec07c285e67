"""Plan of a reproduction: the policies it needs, and the parts that are evaluated in turn."""

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from congrasp.common.task.methods import METHODS, STUDENTS
from congrasp.services.evaluate.scores import Row
from congrasp.services.train.presets import FULL

BASELINES = tuple(name for name in METHODS if name not in ("ours", *STUDENTS))
"""Methods compared with the full system, all for one hand."""
_ON_MANY_OBJECTS = ("ours", "graspxl", "no-dynamic-center")
"""Methods tested by the paper on large-scale objects."""


class RequiredPolicy(NamedTuple):
    """A policy that a reproduction needs."""

    hand: str
    method: str

    @property
    def name(self) -> str:
        """Name of its run, and in texts."""
        return f"{self.hand}-{self.method}"

    @property
    def training(self) -> list[str]:
        """Options of `congrasp train` for its run."""
        method = ["--method", self.method] if self.method != "ours" else []
        return ["--preset", FULL, "--hand", self.hand, *method]


class Part(NamedTuple):
    """Rows that are evaluated and stored together."""

    policy: RequiredPolicy
    table: str
    """`services.evaluate.tables.evaluate_tables`, or `captured`."""
    data: pathlib.Path | None = None
    """Folder of a captured data set; None for procedural constraints."""

    @property
    def name(self) -> str:
        """Name of its files."""
        return f"{self.policy.name}-{self.data.resolve().name if self.data else self.table}"

    @property
    def pictured(self) -> bool:
        """True if episodes are drawn: those of the full system, under constraints without noise."""
        return self.policy.method == "ours" and self.table not in ("objects", "noise")


class Result(NamedTuple):
    """Result of a part."""

    part: Part
    source: str
    """Source of its episodes (`services.evaluate.paper`)."""
    rows: list[Row]
    about: Mapping[str, Any]
    """Further content of its JSON file: policy, settings, pictures, references, skipped rows,
    seconds.
    """
    fresh: bool
    """True if it was evaluated in this session."""


def policies(hands: Sequence[str], methods: Sequence[str]) -> list[RequiredPolicy]:
    """Returns the full system of every hand, then the other methods of the first hand, learning or
    not.
    """
    full = [RequiredPolicy(hand, "ours") for hand in hands]
    return full + [RequiredPolicy(hands[0], method) for method in BASELINES if method in methods]


def parts(
    needed: Sequence[RequiredPolicy], captured: Sequence[pathlib.Path], *, noise: bool
) -> list[Part]:
    """Returns all parts; the first policy is the one with every table.

    Args:
      needed: result of `policies`.
      captured: folders of captured data sets for the first policy's hand.
      noise: includes rows under noise, which are in none of the paper's tables.
    """
    first = needed[0]
    found = [Part(policy, "single") for policy in needed]
    found += [Part(first, table) for table in ("composed", *(("noise",) if noise else ()))]
    own = [policy for policy in needed if policy.hand == first.hand]
    found += [Part(policy, "objects") for policy in own if policy.method in _ON_MANY_OBJECTS]
    return found + [Part(policy, "captured", folder) for folder in captured for policy in own]
