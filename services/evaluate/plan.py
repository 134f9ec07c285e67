"""Rows of an evaluation: which episodes they consist of, decided before any is simulated.

A row has the same number of episodes for every object that allows its constraints, and as nearly as that goes the same
number for each resting pose of an object. What is drawn for an episode depends on the seed, the row's constraints, the
object and the episode's number: never on the rows, objects or policies that are evaluated beside it.
"""

import dataclasses
import zlib
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np

from congrasp.actors import initial
from congrasp.actors.initial import InitialConditions, PlannedEpisodes
from congrasp.common.config import TaskConfig
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.constraints import get_constraint, optional, require_known
from congrasp.common.task.sampling.bank import ConstraintBank

ALIGNED = ":aligned"
"""Ends the name of a row whose pose and trajectory belong together; elsewhere each is drawn for itself."""


class RowPlan(NamedTuple):
    """The episodes of a row."""

    constraint: str
    """Constraints with `+` between them."""
    aligned: bool
    """Whether reference pose and trajectory belong together."""
    episodes: PlannedEpisodes
    """One object after another, then all of them again."""
    covered: np.ndarray
    """(N,) bool: objects that allow the constraints in some resting pose."""

    @property
    def total(self) -> int:
        """Number of episodes."""
        return len(self.episodes.objects)


def plan_row(
    task: TaskConfig, bank: ConstraintBank, objects: Sequence[GraspObject], name: str, episodes: int
) -> RowPlan:
    """The episodes of a row.

    Args:
      task: the task; which constraints there are.
      bank: constraints of the objects.
      objects: N objects.
      name: constraints with `+` between them, and `ALIGNED` if pose and trajectory are to belong together.
      episodes: least number; rounded up to a multiple of the objects that allow the constraints.

    Raises:
      CongraspError: no object allows them, or the policy does not know them.
    """
    constraint, aligned = name.removesuffix(ALIGNED), name.endswith(ALIGNED)
    require_known(constraint.split("+"), task)
    allowed = initial.allowing(dataclasses.replace(task, aligned_references=aligned), bank, constraint.split("+"))
    allowed = allowed & ~repeated_rests(np.asarray(bank.rest)) & (np.asarray(bank.weight) > 0)[:, None]
    covered = np.asarray(allowed.any(1))
    if not covered.any():
        raise CongraspError(
            f"None of the {len(objects)} objects allows the constraint '{constraint}'.",
            "An affordance needs labelled parts, poses and trajectories need room above the table.",
        )
    which = np.flatnonzero(covered)
    each = -(-episodes // len(which))
    number = np.repeat(np.arange(each), len(which))
    index = np.tile(which, each)
    rests = [np.flatnonzero(row) for row in allowed]
    return RowPlan(
        constraint,
        aligned,
        PlannedEpisodes(
            objects=index.astype(np.int32),
            rests=np.array([rests[n][i % len(rests[n])] for n, i in zip(index, number, strict=True)], np.int32),
            names=np.array([zlib.crc32(objects[n].name.encode()) for n in index], np.uint32),
            numbers=number.astype(np.int32),
        ),
        covered,
    )


def from_references(name: str) -> bool:
    """Whether a row's constraints are drawn from references."""
    return any(get_constraint(part).from_reference for part in name.removesuffix(ALIGNED).split("+"))


def batches(
    hand: Hand, task: TaskConfig, bank: ConstraintBank, plan: RowPlan, seed: int, size: int
) -> Iterator[tuple[InitialConditions, int]]:
    """The row's episodes in batches of `size`, and how many of each batch count: the last one is filled up.

    Args:
      hand: the hand.
      task: ranges.
      bank: what is drawn from.
      plan: the row.
      seed: of the evaluation; the row's constraints are part of what draws depend on.
      size: of a batch.
    """
    asked = tuple(c.name for c in optional(task) if c.name in plan.constraint.split("+"))
    task = dataclasses.replace(task, aligned_references=plan.aligned)
    key = jax.random.fold_in(jax.random.key(seed), zlib.crc32(plan.constraint.encode()))
    for start in range(0, plan.total, size):
        chosen = np.minimum(np.arange(start, start + size), plan.total - 1)
        conditions = _planned(hand, task, bank, key, jax.tree.map(lambda x, c=chosen: x[c], plan.episodes), asked)
        yield conditions, min(size, plan.total - start)


_planned = jax.jit(initial.planned, static_argnums=(0, 1, 5))


def repeated_rests(rest: np.ndarray) -> np.ndarray:
    """(N, R) bool: resting poses (N, R, 7) that only fill the row of an object with fewer of them."""
    same = (rest[:, :, None] == rest[:, None]).all(-1)
    repeated: np.ndarray = np.tril(same, -1).any(-1)
    return repeated
