"""Protocol of an evaluation, and plans of the episodes of a row before any is simulated.

A row has the same number of episodes for every object that allows its constraints, and nearly the
same number for each resting pose of an object. The draws of an episode depend on the seed, the
row's constraints, the object and the episode's number, never on other rows, objects or policies of
the evaluation.
"""

import dataclasses
import math
import pathlib
import zlib
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np

from congrasp.actors import initial
from congrasp.actors.initial import InitialConditions, PlannedEpisodes
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.mjcf import CONTACT
from congrasp.common.objects.pool import object_scale
from congrasp.common.objects.spec import GraspObject
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.task.config import SensingConfig, TaskConfig
from congrasp.common.task.constraints import get_constraint, optional, require_known
from congrasp.common.task.sampling.bank import ConstraintBank

HOLD_SECONDS = 2.0
"""Required hold of a grasp without the table, beyond the paper's quarter of a second."""
NOMINAL_FRICTION = CONTACT.friction[0]
"""Default sliding friction between hand and object in evaluations."""
ALIGNED = ":aligned"
"""Suffix of rows with matching pose and trajectory; elsewhere they are drawn independently."""


def two_seconds(task: TaskConfig) -> int:
    """Control steps in `HOLD_SECONDS`."""
    return round(HOLD_SECONDS / task.control_dt)


def protocol(task: TaskConfig, hold: int, friction: float = NOMINAL_FRICTION) -> TaskConfig:
    """Returns the task with `hold` steps without the table, unscaled masses, one stiff friction and
    no disturbances.

    Servo gains are nominal, and the tracker is perfect. Rates are therefore comparable between
    policies trained with different ranges.
    """
    return dataclasses.replace(
        task.evaluated(),
        hold_steps=min(task.hold_steps, hold),
        hold_steps_max=hold,
        mass_range=(1.0, 1.0),
        friction_range=(friction, friction),
        gain_range=(1.0, 1.0),
        human_paths=0.0,
        sensing=SensingConfig(),
    )


def objects_label(bundle: PolicyBundle, folder: pathlib.Path | None, exam: str = "figures") -> str:
    """Name of the objects' source, with the factor on their lengths for the policy's hand."""
    scale = object_scale(get_hand(bundle.spec.hand), bundle.task)
    source = str(folder) if folder else f"procedural objects ({exam})"
    if scale == 1.0:
        return source
    return f"{source}, lengths x {scale:g} for the {bundle.spec.hand_name} hand"


class RowPlan(NamedTuple):
    """The episodes of a row."""

    constraint: str
    """Constraints joined by `+`."""
    aligned: bool
    """True if reference pose and trajectory match."""
    episodes: PlannedEpisodes
    """Objects in turn, repeated."""
    covered: np.ndarray
    """(N,) bool: objects that allow the constraints in some resting pose."""

    @property
    def total(self) -> int:
        """Number of episodes."""
        return len(self.episodes.objects)


def plan_row(
    task: TaskConfig, bank: ConstraintBank, objects: Sequence[GraspObject], name: str, episodes: int
) -> RowPlan:
    """Plans the episodes of a row.

    Args:
      task: the task, for its constraints.
      bank: constraint bank of the objects.
      objects: N objects.
      name: constraints joined by `+`, with `ALIGNED` for matching pose and trajectory.
      episodes: least number; rounded up to a multiple of the objects that allow the constraints.

    Raises:
      CongraspError: no object allows them, or the policy does not support them.
    """
    constraint = name.removesuffix(ALIGNED)
    aligned = name.endswith(ALIGNED)
    parts = constraint.split("+")
    require_known(parts, task)
    task = dataclasses.replace(task, aligned_references=aligned)
    allowed = np.asarray(initial.allowing(task, bank, parts))
    different = ~repeated_rests(np.asarray(bank.rest))
    approachable = np.asarray(bank.weight) > 0
    allowed = allowed & different & approachable[:, None]
    covered = allowed.any(1)
    if not covered.any():
        raise CongraspError(
            f"None of the {len(objects)} objects allows the constraint '{constraint}'.",
            "An affordance needs labelled parts; poses and trajectories need room above the table.",
        )
    return RowPlan(constraint, aligned, _plan_episodes(allowed, objects, episodes), covered)


def _plan_episodes(
    allowed: np.ndarray, objects: Sequence[GraspObject], episodes: int
) -> PlannedEpisodes:
    """Returns at least `episodes` episodes, as many for each object that has an allowed resting
    pose.

    Args:
      allowed: (N, R) bool, allowed resting poses of each object.
      objects: N objects.
      episodes: least number of episodes.
    """
    covered = np.flatnonzero(allowed.any(1))
    episodes_of_object = math.ceil(episodes / len(covered))
    index = np.tile(covered, episodes_of_object)
    number = np.repeat(np.arange(episodes_of_object), len(covered))
    rests = []
    for n, i in zip(index, number, strict=True):
        choices = np.flatnonzero(allowed[n])
        rests.append(choices[i % len(choices)])
    names = [zlib.crc32(objects[n].name.encode()) for n in index]
    return PlannedEpisodes(
        objects=index.astype(np.int32),
        rests=np.array(rests, np.int32),
        names=np.array(names, np.uint32),
        numbers=number.astype(np.int32),
    )


def from_references(name: str) -> bool:
    """True if a row's constraints are drawn from references."""
    parts = name.removesuffix(ALIGNED).split("+")
    return any(get_constraint(part).from_reference for part in parts)


def batches(
    hand: Hand, task: TaskConfig, bank: ConstraintBank, plan: RowPlan, seed: int, size: int
) -> Iterator[tuple[InitialConditions, int]]:
    """Yields the row's episodes in batches of `size`, and the number that count: the last batch is
    padded.

    Args:
      hand: the hand.
      task: ranges.
      bank: constraint bank.
      plan: plan of the row.
      seed: seed of the evaluation; draws also depend on the row's constraints.
      size: size of a batch.
    """
    parts = plan.constraint.split("+")
    requested = {constraint.name: constraint.name in parts for constraint in optional(task)}
    task = dataclasses.replace(task, aligned_references=plan.aligned)
    key = jax.random.fold_in(jax.random.key(seed), zlib.crc32(plan.constraint.encode()))
    for start in range(0, plan.total, size):
        chosen = np.minimum(np.arange(start, start + size), plan.total - 1)
        episodes = PlannedEpisodes(*(column[chosen] for column in plan.episodes))
        conditions = _planned(hand, task, bank, key, episodes, requested)
        yield conditions, min(size, plan.total - start)


_planned = jax.jit(initial.planned, static_argnums=(0, 1))
"""One program for all rows: the requested constraints are arguments."""


def repeated_rests(rest: np.ndarray) -> np.ndarray:
    """(N, R) bool: resting poses (N, R, 7) that only pad the row of an object with fewer of
    them.
    """
    same = (rest[:, :, None] == rest[:, None]).all(-1)
    repeated: np.ndarray = np.tril(same, -1).any(-1)
    return repeated
