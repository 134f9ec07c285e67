"""What a reproduction consists of: which policies it needs, and the parts that are evaluated one after the other."""

import pathlib
from collections.abc import Sequence
from typing import NamedTuple

from congrasp.common.task.methods import METHODS, STUDENT

BASELINES = tuple(name for name in METHODS if name not in ("ours", STUDENT))
"""Methods beside the full system, all of one hand."""
_ON_MANY_OBJECTS = ("ours", "graspxl", "no-dynamic-center")
"""Methods that the paper tests on large-scale objects."""


class Policy(NamedTuple):
    """A policy that a reproduction needs."""

    hand: str
    method: str

    @property
    def name(self) -> str:
        """Of its run, and in texts."""
        return f"{self.hand}-{self.method}"


class Part(NamedTuple):
    """Rows that are evaluated together, and kept together."""

    policy: Policy
    table: str
    """`services.evaluate.tables.evaluate_tables`, or `captured`."""
    data: pathlib.Path | None = None
    """Folder of a captured data set; None for procedural constraints."""

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.policy.name}-{self.data.resolve().name if self.data else self.table}"


def policies(hands: Sequence[str], methods: Sequence[str]) -> list[Policy]:
    """The full system of every hand, then the other methods of the first hand, learning or not."""
    full = [Policy(hand, "ours") for hand in hands]
    return full + [Policy(hands[0], method) for method in BASELINES if method in methods]


def parts(needed: Sequence[Policy], captured: Sequence[pathlib.Path], *, noise: bool) -> list[Part]:
    """All parts; the first policy is the one with every table.

    Args:
      needed: `policies`.
      captured: folders of captured data sets, of the first policy's hand.
      noise: whether rows under noise are part of it, which stand in none of the paper's tables.
    """
    first = needed[0]
    found = [Part(policy, "single") for policy in needed]
    found += [Part(first, table) for table in ("composed", *(("noise",) if noise else ()))]
    own = [policy for policy in needed if policy.hand == first.hand]
    found += [Part(policy, "objects") for policy in own if policy.method in _ON_MANY_OBJECTS]
    return found + [Part(policy, "captured", folder) for folder in captured for policy in own]
