"""Resolves which constraints are active: the paper's priority rules (figure "Priority among
constraints").

Each constraint declares what it overrides and its relations to weaker ones; this module combines
them. Actors, servers and viewers all call `resolve`.
"""

import functools
import operator
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common.hands.spec import Hand
from congrasp.common.task.constraints import CONSTRAINTS, get_constraint
from congrasp.common.task.constraints.base import Constraint, Relation
from congrasp.common.task.constraints.heading import orthogonal_cross
from congrasp.common.task.types import Array, Goal, Surface


class Resolution(NamedTuple):
    """Active constraints, and the effects of the rules."""

    goal: Goal
    """Active constraints; overridden headings are replaced."""
    redirected: Array
    """(B,) bool: a constraint redirected the heading."""
    aligned: Array
    """(B,) bool: false where two constraints contradict and neither overrides the other."""


class Contradiction(NamedTuple):
    """Two constraints that cannot both be met."""

    weaker: str
    stronger: str
    message: str
    """Description of the contradiction, its size and its effect."""
    refused: bool
    """True if neither overrides the other: the request is an error."""


def _overrides(stronger: Constraint, weaker: str) -> bool:
    """True if it overrides a constraint or one of its blocks."""
    return any(
        _hits(stronger, block, get_constraint(weaker))
        for block in (weaker, *get_constraint(weaker).blocks)
    )


def _hits(stronger: Constraint, block: str, owner: Constraint) -> bool:
    """True if it overrides this block."""
    return (
        not {block, owner.name}.isdisjoint(stronger.overrides)
        or stronger.name in owner.overridden_by
    )


def active_blocks(asked: Mapping[str, Array]) -> dict[str, Array]:
    """Active blocks for the requested constraints, (B,) bool each."""
    return {
        block: asked[owner.name]
        & ~_any(
            (asked[c.name] for c in CONSTRAINTS if c.name in asked and _hits(c, block, owner)),
            asked[owner.name],
        )
        for owner in CONSTRAINTS
        if owner.name in asked
        for block in owner.blocks
    }


def _any(flags: Iterable[Array], like: Array) -> Array:
    """(B,) bool: any of the flags is true; shaped like `like`."""
    return functools.reduce(operator.or_, flags, like & False)


def _moot(relation: Relation, stronger: Constraint, asked: Mapping[str, Array]) -> Array:
    """(B,) bool: another requested constraint overrides the weaker one anyway."""
    others = [
        c
        for c in CONSTRAINTS
        if c.name in asked and c is not stronger and _overrides(c, relation.weaker)
    ]
    if _overrides(stronger, relation.weaker):
        others = [c for c in others if CONSTRAINTS.index(c) > CONSTRAINTS.index(stronger)]
    return _any((asked[c.name] for c in others), asked[stronger.name])


def _relations(asked: Iterable[str]) -> list[tuple[Constraint, Relation]]:
    """Relations between constraints that may be requested together, those of the strongest
    first.
    """
    names = {*asked, "heading"}
    return [
        (c, r)
        for c in reversed(CONSTRAINTS)
        if c.name in names
        for r in c.relations
        if r.weaker in names
    ]


def resolve(hand: Hand, surface: Surface, goal: Goal, asked: Mapping[str, Array]) -> Resolution:
    """Applies the priority rules to a batch of requests.

    Args:
      hand: the hand.
      surface: surface points of the objects.
      goal: requested goal arrays; those of absent constraints may hold any finite values. Its
        active flags are ignored.
      asked: (B,) bool by the name of each optional constraint of the goal.
    """
    found: dict[str, list[Array]] = {"redirected": [], "refused": []}
    for stronger, relation in _relations(asked):
        if relation.settled in found:
            both = asked[stronger.name] & ~_moot(relation, stronger, asked)
            if relation.weaker in asked:
                both = both & asked[relation.weaker]
            found[relation.settled].append(
                both & relation.contradicts(relation.measure(hand, surface, goal))
            )
    cross = orthogonal_cross(goal["heading"]).cross
    resolved = Goal(goal.values, active_blocks(asked)).replace("heading", cross=cross)
    for constraint in CONSTRAINTS:
        if constraint.name in asked:
            resolved = constraint.override(hand, surface, asked, resolved)
    none = jnp.zeros(goal["heading"].position.shape[0], bool)
    return Resolution(resolved, _any(found["redirected"], none), ~_any(found["refused"], none))


def explain(asked: Iterable[str], redirected: bool = False) -> list[str]:
    """Describes the effect of the rules on a request, in sentences, strongest constraint first."""
    names = {*asked, "heading"}
    words = []
    for constraint in reversed(CONSTRAINTS):
        if constraint.name in names:
            others = [
                c.name for c in CONSTRAINTS if c.name in names and _overrides(c, constraint.name)
            ]
            words += constraint.explain(others, redirected)
    return words


def contradictions(
    hand: Hand, points: np.ndarray, avoid: np.ndarray, goal: Goal, asked: Iterable[str]
) -> list[Contradiction]:
    """Contradictions within one request, strongest constraint first.

    Args:
      hand: the hand.
      points: (N, 3) surface points.
      avoid: (N,) bool, those of the avoid region.
      goal: requested goal arrays without batch axis.
      asked: names of the explicitly requested constraints, including the heading if it was
        requested.
    """
    names = set(asked)
    flags = {name: np.ones(1, bool) for name in names}
    batch = jax.tree.map(lambda array: np.asarray(array)[None], goal)
    surface = Surface(np.asarray(points, np.float32)[None], np.asarray(avoid)[None])
    result = []
    for stronger, relation in _relations(names):
        if not {stronger.name, relation.weaker} <= names or _moot(relation, stronger, flags).any():
            continue
        measured = relation.measure(hand, surface, batch)
        if relation.contradicts(measured).any():
            one = {name: np.asarray(value)[0] for name, value in measured.items()}
            refused = relation.settled == "refused"
            result.append(
                Contradiction(relation.weaker, stronger.name, relation.message(hand, one), refused)
            )
    return result
