"""Protocol of an evaluation, and plans of the episodes of a row before any is simulated.

A row is a line of an evaluation's table: the episodes of all objects under one combination of
constraints. Its name is the constraints joined by `+`, followed by `ALIGNED` for matching pairs. It
has the same number of episodes for every object that allows its constraints, and nearly the same
number for each resting pose of an object.

The draws of an episode depend on the seed, the row's name, the object and the episode's number,
never on other rows, objects or policies of the evaluation. The order of the constraints in the name
counts: `pose+trajectory` and `trajectory+pose` have the same constraints and different draws.
"""

import dataclasses
import math
import pathlib
import zlib
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np

from congrasp.actors import draws
from congrasp.actors.draws import PlannedEpisodes
from congrasp.actors.initial import InitialConditions
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

REQUIRED_HOLD_S = 2.0
"""Required hold of a grasp without the table; the paper requires a quarter of a second."""
NOMINAL_FRICTION = CONTACT.friction[0]
"""Default sliding friction between hand and object in evaluations."""
ALIGNED = ":aligned"
"""Suffix of rows whose trajectories lead to their poses; in other rows both are drawn
independently."""


def required_hold_steps(task: TaskConfig) -> int:
    """Control steps in `REQUIRED_HOLD_S`."""
    return round(REQUIRED_HOLD_S / task.control_dt)


def protocol(task: TaskConfig, hold: int, friction: float = NOMINAL_FRICTION) -> TaskConfig:
    """Returns the task of an evaluation: unscaled masses, nominal servo gains, one stiff friction,
    a perfect tracker and no disturbances.

    Rates are therefore comparable between policies trained with different ranges.

    Args:
      task: the task of the policy.
      hold: control steps without the table. The draws of episodes vary it from the task's hold up
        to this; `Episodes` replaces it by this one in every episode.
      friction: sliding friction between hand and object.
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
    """True if trajectories lead to the reference poses (`ALIGNED`)."""
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
      name: name of the row.
      episodes: least number; rounded up to a multiple of the objects that allow the constraints.

    Raises:
      CongraspError: no object allows them, or the policy does not support them.
    """
    constraint = name.removesuffix(ALIGNED)
    aligned = name.endswith(ALIGNED)
    constraint_names = constraint.split("+")
    require_known(constraint_names, task)
    task = dataclasses.replace(task, aligned_references=aligned)
    is_samplable = draws.samplable(task, bank, constraint_names)
    is_distinct = ~repeated_rests(np.asarray(bank.rest))
    is_graspable = np.asarray(bank.weight) > 0  # does not lie too flat
    allowed = is_samplable & is_distinct & is_graspable[:, None]
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
    object_indices = np.tile(covered, episodes_of_object)
    episode_numbers = np.repeat(np.arange(episodes_of_object), len(covered))
    rests = []
    for object_index, episode_number in zip(object_indices, episode_numbers, strict=True):
        choices = np.flatnonzero(allowed[object_index])
        rests.append(choices[episode_number % len(choices)])
    seeds = [_seed_of_text(objects[object_index].name) for object_index in object_indices]
    return PlannedEpisodes(
        objects=object_indices.astype(np.int32),
        rests=np.array(rests, np.int32),
        object_seeds=np.array(seeds, np.uint32),
        episode_numbers=episode_numbers.astype(np.int32),
    )


def _seed_of_text(text: str) -> int:
    """Returns a seed of 32 bits that is the same for the same text."""
    return zlib.crc32(text.encode())


def from_references(name: str) -> bool:
    """True if a row's constraints are drawn from references."""
    constraint_names = name.removesuffix(ALIGNED).split("+")
    return any(get_constraint(constraint).from_reference for constraint in constraint_names)


def batches(
    hand: Hand, task: TaskConfig, bank: ConstraintBank, plan: RowPlan, seed: int, size: int
) -> Iterator[tuple[InitialConditions, int]]:
    """Yields the row's episodes in batches of `size`, each with the number of its episodes that
    count: the last batch is padded with repetitions.

    Args:
      hand: the hand.
      task: ranges.
      bank: constraint bank.
      plan: plan of the row.
      seed: seed of the evaluation; draws also depend on the row's constraints, in their order.
      size: size of a batch.
    """
    constraint_names = plan.constraint.split("+")
    requested = {}
    for constraint in optional(task):
        requested[constraint.name] = constraint.name in constraint_names
    task = dataclasses.replace(task, aligned_references=plan.aligned)
    key = jax.random.fold_in(jax.random.key(seed), _seed_of_text(plan.constraint))
    for start in range(0, plan.total, size):
        rows = np.minimum(np.arange(start, start + size), plan.total - 1)
        episodes = jax.tree.map(lambda column, rows=rows: column[rows], plan.episodes)
        conditions = _sample_planned(hand, task, bank, key, episodes, requested)
        yield conditions, min(size, plan.total - start)


_sample_planned = jax.jit(draws.sample_planned, static_argnums=(0, 1))
"""One program for all rows of a task without `ALIGNED`, and one for those with it: the requested
constraints are arguments."""


def repeated_rests(rest: np.ndarray) -> np.ndarray:
    """(N, R) bool: resting poses (N, R, 7) that only pad the row of an object with fewer of
    them.
    """
    same = (rest[:, :, None] == rest[:, None]).all(-1)
    repeated: np.ndarray = np.tril(same, -1).any(-1)
    return repeated
