"""Parts of a reproduction: the policies it needs, and the tables evaluated for each of them."""

import pathlib
from collections.abc import Sequence
from typing import NamedTuple

from congrasp.common.task.methods import METHODS, STUDENTS
from congrasp.services.evaluate.lineup import PolicyKey

BASELINES = tuple(name for name in METHODS if name not in ("ours", *STUDENTS))
"""Methods compared with the full system, all for one hand."""
_METHODS_ON_MANY_OBJECTS = ("ours", "graspxl", "no-dynamic-center")
"""Methods tested by the paper on large-scale objects."""
_TABLES_WITHOUT_PICTURES = ("objects", "noise")


class Part(NamedTuple):
    """Rows that are evaluated and stored together."""

    policy: PolicyKey
    table: str
    """Table of `services.evaluate.tables.evaluate_tables`, or `captured`."""
    data: pathlib.Path | None = None
    """Folder of a captured data set; None for procedural constraints."""

    @property
    def name(self) -> str:
        """Name of its files."""
        return f"{self.policy.name}-{self.data_name or self.table}"

    @property
    def data_name(self) -> str:
        """Name of the captured data set's folder; empty for procedural constraints."""
        if self.data is None:
            return ""
        return self.data.resolve().name

    @property
    def has_pictures(self) -> bool:
        """True if episodes are drawn: for the full system, under constraints without noise."""
        return self.policy.method == "ours" and self.table not in _TABLES_WITHOUT_PICTURES


def required_policies(hands: Sequence[str], methods: Sequence[str]) -> list[PolicyKey]:
    """Returns the policies of a reproduction, including those of methods without learning.

    Args:
      hands: hands of the full system; the first is used by all other methods.
      methods: some of `BASELINES`.

    Returns:
      The full system of every hand, then the other methods in the order of `BASELINES`.
    """
    policies = [PolicyKey(hand, "ours") for hand in hands]
    for method in BASELINES:
        if method in methods:
            policies.append(PolicyKey(hands[0], method))
    return policies


def list_parts(
    policies: Sequence[PolicyKey], captured: Sequence[pathlib.Path], *, noise: bool
) -> list[Part]:
    """Returns all parts of a reproduction.

    Args:
      policies: result of `required_policies`; the first one is evaluated in every table.
      captured: folders of captured data sets for the first policy's hand.
      noise: includes rows under noise, which are in none of the paper's tables.
    """
    first = policies[0]
    parts = [Part(policy, "single") for policy in policies]
    parts.append(Part(first, "composed"))
    if noise:
        parts.append(Part(first, "noise"))
    policies_of_hand = [policy for policy in policies if policy.hand == first.hand]
    for policy in policies_of_hand:
        if policy.method in _METHODS_ON_MANY_OBJECTS:
            parts.append(Part(policy, "objects"))
    for folder in captured:
        parts += [Part(policy, "captured", folder) for policy in policies_of_hand]
    return parts
