"""Builds constraint banks: resting poses, heading sets, reference poses and wrist trajectories of a
pool of objects.
"""

import functools
import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands.closure import outline
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.pool import object_scale
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.parallel import parallel_map
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import draws_references, known
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.sampling.cache import cached_bank
from congrasp.common.task.sampling.headings import Headings
from congrasp.common.task.sampling.object_headings import headings_of
from congrasp.common.task.sampling.references import (
    Grasped,
    closed_references,
    unusable_references,
)


def build_bank(
    hand: Hand, task: TaskConfig, objects: Sequence[GraspObject], seed: int
) -> ConstraintBank:
    """Builds a bank for a pool of objects: headings by the paper's rules, procedural reference
    poses and trajectories.

    References are made only for tasks with a constraint that is drawn from them. Banks of large
    pools are cached on disk.

    Args:
      hand: the hand.
      task: geometry of the approach.
      objects: N objects, scaled for the hand (`common.objects.pool.scale_objects`).
      seed: random seed.

    Raises:
      CongraspError: an object is too wide or cannot be approached in any resting pose, or all
        objects lie too flat.
    """
    build = functools.partial(_build, hand, task, objects, seed)
    bank = cached_bank(hand, task, objects, seed, build)
    return with_columns(hand, task, bank)


def bank_form(hand: Hand, task: TaskConfig, objects: Sequence[GraspObject]) -> ConstraintBank:
    """Shapes and types of the bank of a pool, for programs that are compiled while it is built.

    They are those of the object with the most resting poses. The bank of a pool in which none of
    these objects can be approached in all of its poses has a shorter axis R.

    Raises:
      CongraspError: the object is too wide, or cannot be approached in any resting pose.
    """
    example = max(objects, key=lambda obj: len(obj.rest_poses))
    # A hand's outline takes seconds
    row = headings_of(task, example, (0, 0), scale=object_scale(hand, task))
    bank = with_columns(hand, task, _bank_of(hand, task, [example], [row], 0, unusable_references))
    return jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct((len(objects), *leaf.shape[1:]), leaf.dtype), bank
    )


def with_columns(hand: Hand, task: TaskConfig, bank: ConstraintBank) -> ConstraintBank:
    """Returns the bank with the columns of the task's constraints."""
    by_constraint = {}
    for constraint in known(task):
        columns = constraint.columns(hand, bank)
        if columns is not None:
            by_constraint[constraint.name] = columns
    return bank._replace(columns=by_constraint)


def heading_arguments(
    hand: Hand, task: TaskConfig, objects: Sequence[GraspObject], seed: int
) -> list[Iterable[Any]]:
    """Returns the arguments of `headings_of` for the objects of a pool, as columns for `map`.

    The seed of an object's headings contains its index, so that the copies of an object in a pool
    have different headings.
    """
    count = len(objects)
    return [
        itertools.repeat(task, count),
        objects,
        [(seed, n) for n in range(count)],
        itertools.repeat(None, count),
        itertools.repeat(object_scale(hand, task), count),
        itertools.repeat(outline(hand), count),
    ]


def _build(
    hand: Hand, task: TaskConfig, objects: Sequence[GraspObject], seed: int
) -> ConstraintBank:
    """Builds the bank of `build_bank` without the cache."""
    rows = parallel_map(headings_of, *heading_arguments(hand, task, objects, seed))
    if not any(row["weight"] for row in rows):
        raise CongraspError(
            f"None of {len(objects)} objects can be grasped: they lie too flat on the table in "
            f"every resting pose.",
            "Add other objects.",
        )
    # Closing a hand around objects takes seconds
    make = closed_references if draws_references(task) else unusable_references
    return _bank_of(hand, task, objects, rows, seed, make)


def _bank_of(
    hand: Hand,
    task: TaskConfig,
    objects: Sequence[GraspObject],
    rows: Sequence[dict[str, np.ndarray]],
    seed: int,
    make: Callable[..., dict[str, Any]],
) -> ConstraintBank:
    """Bank of objects with the rows of `headings_of` and the references of `make`."""
    most_rests = max(len(row["rest"]) for row in rows)
    padded = [_with_rests(row, most_rests) for row in rows]
    columns = {}
    for name in padded[0]:
        columns[name] = np.stack([row[name] for row in padded])
    headings = Headings(*[columns.pop(f"chosen_{name}") for name in Headings._fields])
    grasped = Grasped(
        points=np.stack([obj.points for obj in objects]).astype(np.float32),
        normals=np.stack([obj.normals for obj in objects]).astype(np.float32),
        headings=headings,
        rest=columns["rest"],
    )
    references = make(
        hand,
        grasped,
        jax.random.key(seed),
        waypoints=task.trajectory_points,
        human_paths=task.human_paths,
    )
    bank = ConstraintBank(
        **columns,
        **references,
        mass=np.array([obj.mass for obj in objects], np.float32),
        renewable=np.ones(len(objects), bool),
        grasps=np.zeros((len(objects), 2), int),
    )
    return jax.device_put(bank)


def _with_rests(row: dict[str, np.ndarray], count: int) -> dict[str, np.ndarray]:
    """Returns the row of an object with its resting poses repeated up to `count`."""
    index = np.resize(np.arange(len(row["rest"])), count)
    return {
        **row,
        "rest": row["rest"][index],
        "has_affordance": row["has_affordance"][index],
        "heading_index": row["heading_index"][:, index],
        "heading_back": row["heading_back"][:, index],
    }
