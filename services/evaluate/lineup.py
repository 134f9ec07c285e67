"""Selects the policies compared in an evaluation: given ones, pretrained ones, and methods without
a policy.
"""

import dataclasses
import hashlib
import pathlib
from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple

from congrasp.common.errors import CongraspError
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.policy.pretrained import policy_file, pretrained_hands
from congrasp.common.task.methods import STUDENTS, evaluated_as, get_method
from congrasp.learner.run_directory import POLICY_FILE
from congrasp.services.evaluate.plan import objects_label

Table = Literal[
    "single",
    "composed",
    "cross",
    "hands",
    "ablation",
    "objects",
    "noise",
    "sensing",
    "payload",
    "peers",
    "all",
]
ABLATION = ("ours", "no-dynamic-center", "no-feedforward", "single-stage", "two-phase")
"""Methods of the table `ablation`."""


class Entrant(NamedTuple):
    """A policy with its method; its task is that of the method."""

    policy: PolicyBundle
    file: pathlib.Path

    @property
    def hand(self) -> str:
        """Name of its hand."""
        return self.policy.spec.hand_name

    @property
    def method(self) -> str:
        """Method of `common.task.methods`."""
        return self.policy.task.method


class Missing(NamedTuple):
    """A method of a table without a policy."""

    hand: str
    method: str
    reason: str


class Lineup(NamedTuple):
    """Policies to evaluate, and the tables of each."""

    entrants: list[tuple[Entrant, tuple[Table, ...]]]
    missing: list[Missing]

    @property
    def title(self) -> str:
        """Describes what is evaluated: a policy, a method without one, or several."""
        if len(self.entrants) > 1:
            return f"{len(self.entrants)} policies"
        one = self.entrants[0][0]
        what = f"{one.file.name}, version {one.policy.version}"
        if one.method == "ours":
            return what
        return (
            f"method {one.method}, {what}"
            if get_method(one.method).learns
            else f"method {one.method}"
        )

    def objects(self, folder: pathlib.Path | None, exam: str) -> str:
        """Label of the objects, with their scale for the hand if there is one."""
        labels = list(
            dict.fromkeys(objects_label(one.policy, folder, exam) for one, _ in self.entrants)
        )
        return (
            labels[0] if len(labels) == 1 else f"{labels[0].partition(',')[0]} in each hand's size"
        )

    def require(self, hand: str) -> None:
        """Raises a CongraspError unless captured constraints of this hand belong to all
        policies.
        """
        for one, _ in self.entrants:
            if one.hand != hand:
                raise CongraspError(
                    f"The constraint sets are for the hand '{hand}', the policy for '{one.hand}'.",
                    f"Generate them for it with 'congrasp constraints import … --hand {one.hand}'.",
                )


def read_entrant(file: pathlib.Path, method: str | None = None) -> Entrant:
    """Reads a policy file, with its method or as a given one.

    Raises:
      CongraspError: it cannot be read, or the policy has another method that learns.
    """
    policy = bundles.load(file)
    if method is not None:
        policy = dataclasses.replace(policy, task=evaluated_as(policy.task, method, file.name))
    return Entrant(policy, file)


def read_entrants(texts: Iterable[str], method: str | None = None) -> list[Entrant]:
    """Reads policies named by a user: FILE, METHOD=FILE, a name in the package, or a folder of runs
    with policies.

    Args:
      texts: arguments of the user.
      method: method of policies given without one; by default that of the policy.

    Raises:
      CongraspError: a policy cannot be read or has another method, a folder holds none, or two have
        the same hand and method.
    """
    found: list[Entrant] = []
    for text in texts:
        path, own = pathlib.Path(text), method
        if not path.exists() and "=" in text:
            own, _, rest = text.partition("=")
            path = pathlib.Path(rest)
        files = [policy_file(path)]
        if path.is_dir():
            files = sorted({*path.glob(POLICY_FILE), *path.glob(f"*/{POLICY_FILE}")})
            if not files:
                raise CongraspError(
                    f"The folder {path} holds no {POLICY_FILE}.",
                    "Pass a run's folder, or a policy file.",
                )
        found += [read_entrant(file, own) for file in files]
    for i, one in enumerate(found):
        if any((one.hand, one.method) == (other.hand, other.method) for other in found[:i]):
            raise CongraspError(
                f"Two policies have the hand '{one.hand}' and the method '{one.method}'.",
                "Evaluate one at a time.",
            )
    return found


def line_up(
    tables: Sequence[Table], given: Sequence[Entrant], hand: str, method: str | None = None
) -> Lineup:
    """Selects the policies for some tables.

    `hands` compares full systems: the given ones, or else the pretrained ones. `ablation` compares
    the methods of `ABLATION` for the hand of the first policy; the full system defaults to the
    pretrained one. `sensing` compares a student with the full system, with the same default. Every
    other table covers each given policy, or else the pretrained one of a hand.

    Args:
      tables: requested tables.
      given: policies given by the user.
      hand: hand whose pretrained policy is the default.
      method: method to evaluate.

    Raises:
      CongraspError: there is no policy for the hand.
    """
    first = list(given) or [read_entrant(policy_file(None, hand), method)]
    own = first[0].hand
    tables_of: dict[tuple[str, str], list[Table]] = {}
    known = {(one.hand, one.method): one for one in first}
    missing: list[Missing] = []
    for table in dict.fromkeys(tables):
        if table == "hands" and not given:
            for name in pretrained_hands():
                known.setdefault((name, "ours"), read_entrant(policy_file(None, name)))
        taught = table == "sensing" and any(one.method in STUDENTS for one in first)
        if (
            (taught or table == "ablation")
            and (own, "ours") not in known
            and own in pretrained_hands()
        ):
            known[own, "ours"] = read_entrant(policy_file(None, own))
        chosen = {
            "hands": [key for key in known if key[1] == "ours"],
            "ablation": [(own, name) for name in ABLATION],
        }.get(table, [(one.hand, one.method) for one in first])
        if taught and (own, "ours") in known:
            chosen = list(dict.fromkeys([(own, "ours"), *chosen]))
        for key in chosen:
            if key in known:
                tables_of.setdefault(key, []).append(
                    "single" if table in ("hands", "ablation") else table
                )
            else:
                missing.append(Missing(*key, "not trained"))
    return Lineup(
        [(known[key], tuple(dict.fromkeys(tables))) for key, tables in tables_of.items()], missing
    )


def facts(one: Entrant) -> dict[str, Any]:
    """Description of a policy in JSON files."""
    return {
        "hand": one.hand,
        "method": one.method,
        "file": one.file.name,
        "sha256": hashlib.sha256(one.file.read_bytes()).hexdigest(),
        "actor_sha256": one.policy.actor_sha256,
        "version": one.policy.version,
        "transitions": one.policy.transitions,
    }
