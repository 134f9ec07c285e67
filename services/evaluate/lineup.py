"""Selects the policies compared in an evaluation: given ones, pretrained ones, and methods without
a policy.
"""

import dataclasses
import hashlib
import pathlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from congrasp.common.errors import CongraspError
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.policy.pretrained import policy_file, pretrained_hands
from congrasp.common.task.methods import STUDENTS, evaluated_as, get_method
from congrasp.learner.run_directory import POLICY_FILE
from congrasp.services.evaluate.choices import Table
from congrasp.services.evaluate.plan import objects_label

ABLATION = ("ours", "no-dynamic-center", "no-feedforward", "single-stage", "two-phase")
"""Methods of the table `ablation`."""


class PolicyKey(NamedTuple):
    """Hand and method of a policy."""

    hand: str
    method: str

    @property
    def name(self) -> str:
        """Name of its run in a reproduction, and in texts."""
        return f"{self.hand}-{self.method}"


class Entrant(NamedTuple):
    """A policy of a method, with the task of the method."""

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

    @property
    def key(self) -> PolicyKey:
        """Hand and method."""
        return PolicyKey(self.hand, self.method)


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
        entrant, _ = self.entrants[0]
        version = f"{entrant.file.name}, version {entrant.policy.version}"
        if entrant.method == "ours":
            return version
        if not get_method(entrant.method).learns:
            return f"method {entrant.method}"
        return f"method {entrant.method}, {version}"

    def objects(self, folder: pathlib.Path | None, exam: str) -> str:
        """Label of the objects, with their scale for the hand if there is one."""
        labels = [objects_label(entrant.policy, folder, exam) for entrant, _ in self.entrants]
        if len(set(labels)) == 1:
            return labels[0]
        source, _, _ = labels[0].partition(",")
        return f"{source} in each hand's size"

    def require(self, hand: str) -> None:
        """Raises a CongraspError unless captured constraints of this hand belong to all
        policies.
        """
        for one, _ in self.entrants:
            if one.hand != hand:
                raise CongraspError(
                    f"The constraint sets are for the hand '{hand}', but the policy is for "
                    f"'{one.hand}'.",
                    f"Import sets for the policy's hand: 'congrasp constraints import … --hand "
                    f"{one.hand}'.",
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
    entrants: list[Entrant] = []
    for text in texts:
        path = pathlib.Path(text)
        method_of_file = method
        if not path.exists() and "=" in text:
            method_of_file, _, name = text.partition("=")
            path = pathlib.Path(name)
        for file in _policy_files(path):
            entrants.append(read_entrant(file, method_of_file))
    _check_different(entrants)
    return entrants


def _policy_files(path: pathlib.Path) -> list[pathlib.Path]:
    """Returns the policy files of a path.

    Raises:
      CongraspError: a folder holds none, or a file does not exist.
    """
    if not path.is_dir():
        return [policy_file(path)]
    files = sorted({*path.glob(POLICY_FILE), *path.glob(f"*/{POLICY_FILE}")})
    if not files:
        raise CongraspError(
            f"The folder {path} contains no {POLICY_FILE}.",
            "Pass the folder of a run, or a policy file.",
        )
    return files


def _check_different(entrants: Sequence[Entrant]) -> None:
    """Raises a CongraspError if two policies have the same hand and method."""
    keys = set()
    for entrant in entrants:
        key = (entrant.hand, entrant.method)
        if key in keys:
            raise CongraspError(
                f"Two policies have the hand '{entrant.hand}' and the method '{entrant.method}'.",
                "Evaluate them with separate commands.",
            )
        keys.add(key)


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
    policies = list(given) or [read_entrant(policy_file(None, hand), method)]
    entrants_by_key = {entrant.key: entrant for entrant in policies}
    tables_of: dict[PolicyKey, list[Table]] = {}
    missing: list[Missing] = []
    for table in dict.fromkeys(tables):
        _add_pretrained(entrants_by_key, table, policies, pretrained_hands_requested=not given)
        for key in _policies_of_table(table, policies, entrants_by_key):
            if key in entrants_by_key:
                same_rows = "single" if table in ("hands", "ablation") else table
                tables_of.setdefault(key, []).append(same_rows)
            else:
                missing.append(Missing(*key, "not trained"))
    entrants = []
    for key, tables_of_policy in tables_of.items():
        entrants.append((entrants_by_key[key], tuple(dict.fromkeys(tables_of_policy))))
    return Lineup(entrants, missing)


def _add_pretrained(
    known: dict[PolicyKey, Entrant],
    table: Table,
    policies: Sequence[Entrant],
    *,
    pretrained_hands_requested: bool,
) -> None:
    """Adds the pretrained full systems with which a table compares, unless others are known."""
    if table == "hands" and pretrained_hands_requested:
        for name in pretrained_hands():
            known.setdefault(PolicyKey(name, "ours"), read_entrant(policy_file(None, name)))
    if table == "ablation" or _compares_student(table, policies):
        full_system = PolicyKey(policies[0].hand, "ours")
        if full_system not in known and full_system.hand in pretrained_hands():
            known[full_system] = read_entrant(policy_file(None, full_system.hand))


def _compares_student(table: Table, policies: Sequence[Entrant]) -> bool:
    """True if a table compares a student with the full system."""
    return table == "sensing" and any(entrant.method in STUDENTS for entrant in policies)


def _policies_of_table(
    table: Table, policies: Sequence[Entrant], known: Mapping[PolicyKey, Entrant]
) -> list[PolicyKey]:
    """Returns the policies that a table compares, some of them possibly unknown."""
    hand = policies[0].hand
    if table == "hands":
        return [key for key in known if key.method == "ours"]
    if table == "ablation":
        return [PolicyKey(hand, method) for method in ABLATION]
    keys = [entrant.key for entrant in policies]
    full_system = PolicyKey(hand, "ours")
    if _compares_student(table, policies) and full_system in known:
        keys = list(dict.fromkeys([full_system, *keys]))
    return keys


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
