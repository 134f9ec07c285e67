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
from congrasp.common.task.constraints.base import Constraint
from congrasp.common.task.constraints.heading import orthogonal_cross
from congrasp.common.task.constraints.specs import Relation
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


def _overrides(stronger: Constraint, name: str) -> bool:
    """True if a constraint overrides the constraint `name` or one of its blocks."""
    weaker = get_constraint(name)
    return any(_overrides_block(stronger, block, weaker) for block in (name, *weaker.blocks))


def _overrides_block(stronger: Constraint, block: str, owner: Constraint) -> bool:
    """True if a constraint overrides a block, by the name of the block or of its owner."""
    listed = block in stronger.overrides or owner.name in stronger.overrides
    return listed or stronger.name in owner.overridden_by


def active_blocks(requested: Mapping[str, Array]) -> dict[str, Array]:
    """Active blocks for the requested constraints, (B,) bool each."""
    constraints = [constraint for constraint in CONSTRAINTS if constraint.name in requested]
    active = {}
    for owner in constraints:
        flags = requested[owner.name]
        for block in owner.blocks:
            overriding = [
                requested[constraint.name]
                for constraint in constraints
                if _overrides_block(constraint, block, owner)
            ]
            active[block] = flags & ~_any(overriding, flags)
    return active


def _any(flags: Iterable[Array], like: Array) -> Array:
    """(B,) bool: any of the flags is true; shaped like `like`."""
    return functools.reduce(operator.or_, flags, like & False)


def _is_moot(relation: Relation, stronger: Constraint, requested: Mapping[str, Array]) -> Array:
    """(B,) bool: another requested constraint overrides the weaker one anyway."""
    overriding = []
    overrides_itself = _overrides(stronger, relation.weaker)
    for constraint in CONSTRAINTS:
        if constraint.name not in requested or constraint is stronger:
            continue
        is_weaker = CONSTRAINTS.index(constraint) < CONSTRAINTS.index(stronger)
        if overrides_itself and is_weaker:
            continue
        if _overrides(constraint, relation.weaker):
            overriding.append(requested[constraint.name])
    return _any(overriding, requested[stronger.name])


def _relations(requested: Iterable[str]) -> list[tuple[Constraint, Relation]]:
    """Relations between constraints that may be requested together, strongest constraint first."""
    names = {*requested, "heading"}
    relations = []
    for constraint in reversed(CONSTRAINTS):
        if constraint.name not in names:
            continue
        relations += [
            (constraint, relation) for relation in constraint.relations if relation.weaker in names
        ]
    return relations


def resolve(hand: Hand, surface: Surface, goal: Goal, requested: Mapping[str, Array]) -> Resolution:
    """Applies the priority rules to a batch of requests.

    Args:
      hand: the hand.
      surface: surface points of the objects.
      goal: requested goal arrays; those of absent constraints may hold any finite values. Its
        active flags are ignored.
      requested: (B,) bool by the name of each optional constraint of the goal.
    """
    redirected: list[Array] = []
    refused: list[Array] = []
    for stronger, relation in _relations(requested):
        if relation.settled == "overridden":
            continue
        both = requested[stronger.name] & ~_is_moot(relation, stronger, requested)
        if relation.weaker in requested:
            both = both & requested[relation.weaker]
        contradicting = both & relation.contradicts(relation.measure(hand, surface, goal))
        if relation.settled == "redirected":
            redirected.append(contradicting)
        else:
            refused.append(contradicting)
    cross = orthogonal_cross(goal["heading"]).cross
    resolved = Goal(goal.values, active_blocks(requested)).replace("heading", cross=cross)
    for constraint in CONSTRAINTS:
        if constraint.name in requested:
            resolved = constraint.override(hand, surface, requested, resolved)
    none = jnp.zeros(goal["heading"].position.shape[0], bool)
    return Resolution(
        goal=resolved,
        redirected=_any(redirected, none),
        aligned=~_any(refused, none),
    )


def explain(requested: Iterable[str], redirected: bool = False) -> list[str]:
    """Describes the effect of the rules on a request, in sentences, strongest constraint first."""
    names = {*requested, "heading"}
    constraints = [constraint for constraint in CONSTRAINTS if constraint.name in names]
    sentences = []
    for constraint in reversed(constraints):
        overriding = [other.name for other in constraints if _overrides(other, constraint.name)]
        sentences += constraint.explain(overriding, redirected)
    return sentences


def contradictions(
    hand: Hand, points: np.ndarray, avoid: np.ndarray, goal: Goal, requested: Iterable[str]
) -> list[Contradiction]:
    """Contradictions within one request, strongest constraint first.

    Args:
      hand: the hand.
      points: (N, 3) surface points.
      avoid: (N,) bool, those of the avoid region.
      goal: requested goal arrays without batch axis.
      requested: names of the explicitly requested constraints, including the heading if it was
        requested.
    """
    names = set(requested)
    flags = {name: np.ones(1, bool) for name in names}
    batch = jax.tree.map(lambda array: np.asarray(array)[None], goal)
    surface = Surface(np.asarray(points, np.float32)[None], np.asarray(avoid)[None])
    result = []
    for stronger, relation in _relations(names):
        if not {stronger.name, relation.weaker} <= names:
            continue
        if _is_moot(relation, stronger, flags).any():
            continue
        measured = relation.measure(hand, surface, batch)
        if not relation.contradicts(measured).any():
            continue
        distances = {name: np.asarray(value)[0] for name, value in measured.items()}
        result.append(
            Contradiction(
                weaker=relation.weaker,
                stronger=stronger.name,
                message=relation.message(hand, distances),
                refused=relation.settled == "refused",
            )
        )
    return result
