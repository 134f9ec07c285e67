"""Plan of a reproduction: the policies it needs, and the parts that are evaluated in turn."""

import pathlib
from collections.abc import Sequence
from typing import NamedTuple

from congrasp.common.task.methods import METHODS, STUDENTS

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


def policies(hands: Sequence[str], methods: Sequence[str]) -> list[RequiredPolicy]:
    """Returns the full system of every hand, then the other methods of the first hand, learning or not."""
    full = [RequiredPolicy(hand, "ours") for hand in hands]
    return full + [RequiredPolicy(hands[0], method) for method in BASELINES if method in methods]


def parts(needed: Sequence[RequiredPolicy], captured: Sequence[pathlib.Path], *, noise: bool) -> list[Part]:
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
