"""Which constraints are active: the paper's priority rules (figure "Priority among constraints").

Each constraint says what it overrides and how it stands to weaker ones; here that is put together. Actors, servers and
viewers all call `resolve`.
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
    """What is active, and what the rules did."""

    goal: Goal
    """Active constraints; overridden headings are replaced."""
    redirected: Array
    """(B,) bool: a constraint turned the heading."""
    aligned: Array
    """(B,) bool: false where two constraints contradict of which neither overrides the other."""


class Contradiction(NamedTuple):
    """Two constraints that cannot both be met."""

    weaker: str
    stronger: str
    message: str
    """What contradicts, by how much, and what becomes of it."""
    refused: bool
    """Neither overrides the other: the request is an error."""


def _overrides(stronger: Constraint, weaker: str) -> bool:
    """Whether it overrides a constraint or one of its blocks."""
    return any(_hits(stronger, block, get_constraint(weaker)) for block in (weaker, *get_constraint(weaker).blocks))


def _hits(stronger: Constraint, block: str, owner: Constraint) -> bool:
    """Whether it overrides this block."""
    return not {block, owner.name}.isdisjoint(stronger.overrides) or stronger.name in owner.overridden_by


def active_blocks(asked: Mapping[str, Array]) -> dict[str, Array]:
    """Which blocks are active where these constraints are asked for, (B,) bool each."""
    return {
        block: asked[owner.name]
        & ~_any((asked[c.name] for c in CONSTRAINTS if c.name in asked and _hits(c, block, owner)), asked[owner.name])
        for owner in CONSTRAINTS
        if owner.name in asked
        for block in owner.blocks
    }


def _any(flags: Iterable[Array], like: Array) -> Array:
    """(B,) bool: whether any of the flags is true; as many as `like` has."""
    return functools.reduce(operator.or_, flags, like & False)


def _moot(relation: Relation, stronger: Constraint, asked: Mapping[str, Array]) -> Array:
    """(B,) bool: something else that is asked for overrides the weaker constraint anyway."""
    others = [c for c in CONSTRAINTS if c.name in asked and c is not stronger and _overrides(c, relation.weaker)]
    if _overrides(stronger, relation.weaker):
        others = [c for c in others if CONSTRAINTS.index(c) > CONSTRAINTS.index(stronger)]
    return _any((asked[c.name] for c in others), asked[stronger.name])


def _relations(asked: Iterable[str]) -> list[tuple[Constraint, Relation]]:
    """Relations between constraints that may be asked for together, those of the strongest first."""
    names = {*asked, "heading"}
    return [(c, r) for c in reversed(CONSTRAINTS) if c.name in names for r in c.relations if r.weaker in names]


def resolve(hand: Hand, surface: Surface, goal: Goal, asked: Mapping[str, Array]) -> Resolution:
    """Applies the priority rules to a batch of requests.

    Args:
      hand: the hand.
      surface: the objects' surface points.
      goal: goal arrays as asked for; those of absent constraints may hold anything finite. What it says is active is
        ignored.
      asked: (B,) bool by the name of each optional constraint of the goal.
    """
    found: dict[str, list[Array]] = {"redirected": [], "refused": []}
    for stronger, relation in _relations(asked):
        if relation.settled in found:
            both = asked[stronger.name] & ~_moot(relation, stronger, asked)
            if relation.weaker in asked:
                both = both & asked[relation.weaker]
            found[relation.settled].append(both & relation.contradicts(relation.measure(hand, surface, goal)))
    cross = orthogonal_cross(goal["heading"]).cross
    resolved = Goal(goal.values, active_blocks(asked)).replace("heading", cross=cross)
    for constraint in CONSTRAINTS:
        if constraint.name in asked:
            resolved = constraint.override(hand, surface, asked, resolved)
    none = jnp.zeros(goal["heading"].position.shape[0], bool)
    return Resolution(resolved, _any(found["redirected"], none), ~_any(found["refused"], none))


def explain(asked: Iterable[str], redirected: bool = False) -> list[str]:
    """What the rules do with a request, in sentences, strongest constraint first."""
    names = {*asked, "heading"}
    words = []
    for constraint in reversed(CONSTRAINTS):
        if constraint.name in names:
            others = [c.name for c in CONSTRAINTS if c.name in names and _overrides(c, constraint.name)]
            words += constraint.explain(others, redirected)
    return words


def contradictions(
    hand: Hand, points: np.ndarray, avoid: np.ndarray, goal: Goal, asked: Iterable[str]
) -> list[Contradiction]:
    """What of one request contradicts the rest, strongest constraint first.

    Args:
      hand: the hand.
      points: (N, 3) surface points.
      avoid: (N,) bool, those of the avoid region.
      goal: goal arrays without batch axis, as asked for.
      asked: names of the constraints that somebody asked for; the heading too, if it was.
    """
    names = set(asked)
    flags = {name: np.ones(1, bool) for name in names}
    batch = jax.tree.map(lambda array: jnp.asarray(array)[None], goal)
    surface = Surface(jnp.asarray(points, jnp.float32)[None], jnp.asarray(avoid)[None])
    result = []
    for stronger, relation in _relations(names):
        if not {stronger.name, relation.weaker} <= names or _moot(relation, stronger, flags).any():
            continue
        measured = relation.measure(hand, surface, batch)
        if relation.contradicts(measured).any():
            one = {name: np.asarray(value)[0] for name, value in measured.items()}
            refused = relation.settled == "refused"
            result.append(Contradiction(relation.weaker, stronger.name, relation.message(hand, one), refused))
    return result
