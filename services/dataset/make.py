"""Makes a dataset, shard by shard: each is a pool of objects with all their episodes.

A shard depends on the policy, the objects, the seed, the engine and the batch, never on other
shards. Any number of processes can therefore make different ones, and a stopped process resumes
with the missing ones.
"""

import collections
import contextlib
import dataclasses
import functools
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

import congrasp
from congrasp.actors.initial import InitialConditions
from congrasp.common.errors import CongraspError
from congrasp.services.assets.objects.named import ObjectAt
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.dataset.columns import (
    VERDICTS,
    Column,
    grasp_columns,
    grasp_rows,
    object_columns,
    object_rows,
    table,
)
from congrasp.services.dataset.shards import Shards
from congrasp.services.evaluate.episodes import Episodes
from congrasp.services.evaluate.experiment import Experiment, advance_from
from congrasp.services.evaluate.plan import batches, plan_row
from congrasp.services.evaluate.pools import PoolLoaders, PreparedPool, listed_pools, prepare_pools

FORMAT = 1
_T = TypeVar("_T")
_MAX_SHARD_EPISODES = 8192
"""Limit of a shard's episodes, for the default number of objects."""
_MAX_SHARD_OBJECTS = 128
"""Limit of a shard's objects, for the same."""

_Counts = dict[str, collections.Counter[str]]
"""Numbers of episodes by outcome, under each set of constraints."""


@dataclasses.dataclass(frozen=True)
class Recipe:
    """Contents of a dataset."""

    experiment: Experiment
    """Policy, engine, seed and batch; the batch changes the results by rounding."""
    policy_sha256: str
    """SHA-256 of the policy's file."""
    objects: Sequence[ObjectAt]
    """Objects with different names."""
    options: ImportOptions
    """Options of the import of meshes."""
    per_object: int
    """Episodes of each object, evenly over the constraints."""
    constraints: tuple[str, ...]
    """Sets of constraints, each with `+` between them."""
    keep: tuple[str, ...]
    """Names of `VERDICTS` that an episode needs to be kept; empty keeps all."""
    shard: int
    """Largest number of objects in a shard."""

    @property
    def shares(self) -> dict[str, int]:
        """Episodes of an object under each set of constraints."""
        each, more = divmod(self.per_object, len(self.constraints))
        shares: dict[str, int] = {}
        for index, constraints in enumerate(self.constraints):
            shares[constraints] = each + 1 if index < more else each
        return shares

    @functools.cached_property
    def template(self) -> Experiment:
        """The experiment of each shard, without its objects."""
        episodes = self.per_object * min(self.shard, len(self.objects))
        return dataclasses.replace(self.experiment, episodes=episodes)

    @property
    def columns(self) -> dict[str, list[Column]]:
        """Columns of the grasps and of the objects."""
        grasps = grasp_columns(self.experiment.hand, self.experiment.task)
        return {"grasps": grasps, "objects": object_columns()}

    @functools.cached_property
    def about(self) -> dict[str, Any]:
        """Description of the dataset in every shard, as JSON; equal for datasets with equal
        contents.
        """
        options = dataclasses.asdict(dataclasses.replace(self.options, cache_dir=""))
        digests = [source.digest() for source in self.objects]
        contents = json.dumps([options, digests])
        return {
            "format": FORMAT,
            "version": congrasp.__version__,
            "hand": self.experiment.policy.spec.hand_name,
            "policy_sha256": self.policy_sha256,
            "objects_sha256": hashlib.sha256(contents.encode()).hexdigest(),
            "objects": len(self.objects),
            "per_object": self.per_object,
            "constraints": list(self.constraints),
            "keep": list(self.keep),
            "objects_per_shard": self.shard,
            "physics": self.experiment.physics,
            "seed": self.experiment.seed,
            "batch": self.template.worlds,
        }


def shard_objects(per_object: int) -> int:
    """Default of the largest number of objects in a shard; the same for every engine and batch."""
    return max(1, min(_MAX_SHARD_EPISODES // per_object, _MAX_SHARD_OBJECTS))


def pools_of(recipe: Recipe) -> PoolLoaders:
    """The objects of each shard."""
    return listed_pools(recipe.objects, recipe.shard, recipe.options)


def make(
    recipe: Recipe,
    shards: Shards,
    pools: PoolLoaders,
    numbers: Sequence[int],
    progress: Callable[[int], None] = lambda episodes: None,
) -> None:
    """Makes and writes shards.

    Args:
      recipe: contents of the dataset.
      shards: locations of the shards.
      pools: result of `pools_of` for the recipe.
      numbers: numbers of the shards to make.
      progress: called with the number of simulated episodes; those of a running batch count by
        their share of control steps.
    """
    done = 0
    with (
        contextlib.ExitStack() as stack,
        prepare_pools(recipe.template, pools, numbers) as prepared_pools,
    ):
        running: Episodes | None = None
        for pool in prepared_pools:
            experiment = pool.experiment
            if pool.real_count:
                running = _simulator_for(experiment, running, stack)
            columns = grasp_columns(experiment.hand, experiment.task)
            counts: _Counts = collections.defaultdict(collections.Counter)
            chunks = [_no_rows(columns)]
            report = functools.partial(advance_from, progress, done)
            for rows in _episodes(running, pool, recipe.shares, report):
                chunks.append(_count_and_filter(rows, recipe.keep, counts))
                done += len(rows["episode"])
            about = {
                **recipe.about,
                "shard": experiment.pool,
                "counts": counts,
                "left_out": pool.left_out,
            }
            grasps = table(columns, _joined(chunks), about)
            objects = table(
                object_columns(), object_rows(experiment.scaled[: pool.real_count]), about
            )
            shards.write(experiment.pool, grasps, objects)


def _simulator_for(
    experiment: Experiment, running: Episodes | None, stack: contextlib.ExitStack
) -> Episodes:
    """The simulator of all pools with the objects of one; opened in `stack` for the first pool."""
    if running is None:
        return stack.enter_context(experiment.simulator())
    running.replace_objects(experiment.scaled, experiment.field)
    return running


def _no_rows(columns: Sequence[Column]) -> dict[str, np.ndarray]:
    """Columns without rows."""
    return {column.name: np.zeros((0, *column.shape), column.kind) for column in columns}


def _joined(parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Columns of the rows of all parts."""
    columns: dict[str, np.ndarray] = {}
    for name in parts[0]:
        columns[name] = np.concatenate([part[name] for part in parts])
    return columns


def _initial_conditions(
    pool: PreparedPool, shares: Mapping[str, int]
) -> tuple[list[InitialConditions], dict[str, np.ndarray]]:
    """Initial conditions of the real objects' episodes under each set of constraints, and columns
    (E,) of all of them.

    Each object has its share of episodes of the constraints that it allows.
    """
    experiment = pool.experiment
    conditions: list[InitialConditions] = []
    names = np.array([obj.name for obj in experiment.scaled])
    parts: list[dict[str, np.ndarray]] = []
    for constraints, share in shares.items():
        bank = experiment.bank_for(constraints)
        total = share * len(experiment.scaled)
        try:
            plan = plan_row(experiment.task, bank, experiment.scaled, constraints, total)
        except CongraspError:
            continue  # no object allows them
        is_real = (plan.episodes.episode_numbers < share) & (
            plan.episodes.objects < pool.real_count
        )
        plan = plan._replace(episodes=_selected(plan.episodes, is_real))
        for batch, count in batches(
            experiment.hand, experiment.task, bank, plan, experiment.seed, total
        ):
            conditions.append(_selected(batch, slice(count)))
        parts.append(
            {
                "constraints": np.full(plan.total, constraints),
                "object": names[plan.episodes.objects],
                "episode": plan.episodes.episode_numbers,
            }
        )
    if not parts:
        return conditions, {}
    return conditions, _joined(parts)


def _selected(tree: _T, rows: Any) -> _T:
    """Some rows of every array of a tree."""
    selected: _T = jax.tree.map(lambda array: array[rows], tree)
    return selected


def _episodes(
    running: Episodes | None,
    pool: PreparedPool,
    shares: Mapping[str, int],
    progress: Callable[[int], None],
) -> Iterator[dict[str, np.ndarray]]:
    """Yields columns of the real objects' episodes, batch by batch; a batch holds episodes under
    any constraints.

    Args:
      running: simulator of the pool's objects; None if no pool so far had objects.
      pool: the pool.
      shares: episodes of each object, by constraints.
      progress: called with the number of simulated episodes of the pool.
    """
    if running is None or not pool.real_count:
        return
    parts, columns = _initial_conditions(pool, shares)
    if not parts:
        return
    conditions = jax.tree.map(lambda *arrays: jnp.concatenate(arrays), *parts)
    total = len(columns["episode"])
    for start in range(0, total, running.batch):
        count = min(running.batch, total - start)
        # The last batch is filled with its last episode
        indices = np.arange(start, start + running.batch).clip(max=total - 1)

        def report(share: float, start: int = start, count: int = count) -> None:
            """Counts the episodes of the running batch by their share of control steps."""
            progress(start + int(share * count))

        batch = running.run(
            _selected(conditions, indices),
            stressed=running.stressable,
            progress=report,
        )
        planned = {name: column[indices] for name, column in columns.items()}
        rows = grasp_rows(pool.experiment.task, planned["constraints"], batch) | planned
        yield {name: column[:count] for name, column in rows.items()}


def _count_and_filter(
    rows: Mapping[str, np.ndarray],
    keep: Sequence[str],
    counts: Mapping[str, collections.Counter[str]],
) -> dict[str, np.ndarray]:
    """Counts all rows by their constraints and outcomes; returns those to keep."""
    is_kept = np.ones(len(rows["episode"]), bool)
    for verdict in keep:
        is_kept &= rows[verdict]
    for constraints in dict.fromkeys(rows["constraints"].tolist()):
        is_under = rows["constraints"] == constraints
        numbers = {"episodes": int(is_under.sum()), "kept": int(is_kept[is_under].sum())}
        for verdict in VERDICTS:
            numbers[verdict] = int(rows[verdict][is_under].sum())
        counts[constraints].update(numbers)
    return {name: column[is_kept] for name, column in rows.items()}
