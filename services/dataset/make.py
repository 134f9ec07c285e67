"""Makes a dataset, shard by shard: each is a pool of objects with all their episodes.

A shard depends on the policy, the objects, the seed, the engine and the batch, never on other shards. Any number of
processes can therefore make different ones, and a stopped process resumes with the missing ones.
"""

import collections
import contextlib
import dataclasses
import functools
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import numpy as np

import congrasp
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.runtime.engines import ENGINES, PhysicsName
from congrasp.common.runtime.parallel import cores
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.services.assets.objects.named import ObjectAt
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.dataset.columns import (
    VERDICTS,
    grasp_columns,
    grasp_rows,
    object_columns,
    object_rows,
    table,
)
from congrasp.services.dataset.shards import Shards
from congrasp.services.evaluate import references
from congrasp.services.evaluate.episodes import Episodes
from congrasp.services.evaluate.evaluator import batch_of
from congrasp.services.evaluate.plan import RowPlan, batches, from_references, plan_row
from congrasp.services.evaluate.pools import Pool, Pools, listed_pools, one_ahead, prepared
from congrasp.services.evaluate.protocol import protocol, two_seconds

FORMAT = 1
_EPISODES, _OBJECTS = 8192, 128
"""Limits of a shard's episodes and objects, for the default number of objects."""


@dataclasses.dataclass(frozen=True)
class Recipe:
    """Contents of a dataset."""

    policy: PolicyBundle
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
    physics: PhysicsName
    """Engine, except `auto`."""
    seed: int
    batch: int = 0
    """Largest number of parallel worlds; 0 uses the engine's default. It changes the results by rounding."""

    @property
    def worlds(self) -> int:
        """Number of parallel worlds."""
        objects = min(self.shard, len(self.objects))
        return batch_of(self.shares[0] * objects, self.batch or ENGINES[self.physics].batch)

    @property
    def shares(self) -> list[int]:
        """Episodes of an object under each set of constraints."""
        sets = len(self.constraints)
        return [self.per_object // sets + (i < self.per_object % sets) for i in range(sets)]

    @functools.cached_property
    def about(self) -> dict[str, Any]:
        """Description of the dataset in every shard, as JSON; equal for datasets with equal contents."""
        contents = json.dumps(
            [dataclasses.asdict(dataclasses.replace(self.options, cache_dir="")), [at.digest() for at in self.objects]]
        )
        return {
            "format": FORMAT,
            "version": congrasp.__version__,
            "hand": self.policy.spec.hand_name,
            "policy_sha256": self.policy_sha256,
            "objects_sha256": hashlib.sha256(contents.encode()).hexdigest(),
            "objects": len(self.objects),
            "per_object": self.per_object,
            "constraints": list(self.constraints),
            "keep": list(self.keep),
            "objects_per_shard": self.shard,
            "physics": self.physics,
            "seed": self.seed,
            "batch": self.worlds,
        }


def shard_objects(per_object: int) -> int:
    """Default of the largest number of objects in a shard; the same for every engine and batch."""
    return max(1, min(_EPISODES // per_object, _OBJECTS))


def pools_of(recipe: Recipe) -> Pools:
    """The objects of each shard."""
    return listed_pools(recipe.objects, recipe.shard, recipe.options)


def make(
    recipe: Recipe,
    shards: Shards,
    pools: Pools,
    wanted: Sequence[int],
    progress: Callable[[int], None] = lambda episodes: None,
) -> None:
    """Makes and writes shards.

    Args:
      recipe: contents of the dataset.
      shards: locations of the shards.
      pools: result of `pools_of` for the recipe.
      wanted: numbers of the shards to make.
      progress: called with the number of finished episodes.
    """
    policy, hand = recipe.policy, get_hand(recipe.policy.spec.hand)
    hold = two_seconds(policy.task)
    task = protocol(policy.task, hold)
    settings: dict[str, Any] = {"hold": hold, "batch": recipe.worlds, "physics": recipe.physics, "threads": cores()}
    done = 0
    with contextlib.ExitStack() as stack:
        running: Episodes | None = None
        for pool in stack.enter_context(one_ahead(prepared(hand, task, pools, recipe.seed, wanted, True))):
            columns = grasp_columns(hand, task)
            counts: dict[str, collections.Counter[str]] = {}
            none: dict[str, np.ndarray] = {c.name: np.zeros((0, *c.shape), c.kind) for c in columns}
            rows = [none]
            if pool.bank is not None:
                if running is None:
                    running = stack.enter_context(Episodes(policy, task, pool.objects, field=pool.field, **settings))
                else:
                    running.replace_objects(pool.objects, pool.field)
                for asked, bank, plan in _plans(recipe, task, pool):
                    for part in _episodes(running, recipe.seed, hand, task, asked, bank, plan, pool):
                        rows.append(_counted(part, recipe.keep, counts.setdefault(asked, collections.Counter())))
                        done += len(part["episode"])
                        progress(done)
            said = {**recipe.about, "shard": pool.number, "counts": counts, "left_out": pool.left_out}
            found = {name: np.concatenate([part[name] for part in rows]) for name in rows[0]}
            of_objects = table(object_columns(), object_rows(pool.objects[: pool.real]), said)
            shards.write(pool.number, table(columns, found, said), of_objects)


def _plans(recipe: Recipe, task: TaskConfig, pool: Pool) -> Iterator[tuple[str, ConstraintBank, RowPlan]]:
    """Yields the sets of constraints that some object of a pool allows, with their bank and their planned episodes."""
    assert pool.bank is not None
    bank = pool.bank
    if any(map(from_references, recipe.constraints)):
        maker, _ = references.reference_policy(recipe.policy)
        made = references.make(maker, task, pool.objects, bank, physics=recipe.physics, threads=cores())
        bank = made.bank
    for asked, share in zip(recipe.constraints, recipe.shares, strict=True):
        with contextlib.suppress(CongraspError):  # no object allows these
            plan = plan_row(task, bank, pool.objects, asked, share * len(pool.objects))
            own = plan.episodes.numbers < share
            yield asked, bank, plan._replace(episodes=jax.tree.map(lambda x, own=own: x[own], plan.episodes))


def _episodes(
    running: Episodes,
    seed: int,
    hand: Hand,
    task: TaskConfig,
    asked: str,
    bank: ConstraintBank,
    plan: RowPlan,
    pool: Pool,
) -> Iterator[dict[str, np.ndarray]]:
    """Yields the columns of a plan's episodes on the real objects of the pool, batch by batch."""
    names, first = np.array([obj.name for obj in pool.objects]), 0
    for conditions, count in batches(hand, task, bank, plan, seed, running.batch):
        batch = running.run(conditions, stressed=True)
        objects, numbers = (x[first : first + count] for x in (plan.episodes.objects, plan.episodes.numbers))
        rows = grasp_rows(hand, task, asked, conditions, batch)
        rows = {"object": names[objects], "episode": numbers, **{n: column[:count] for n, column in rows.items()}}
        yield {name: column[objects < pool.real] for name, column in rows.items()}
        first += count


def _counted(
    rows: Mapping[str, np.ndarray], keep: Sequence[str], counts: collections.Counter[str]
) -> dict[str, np.ndarray]:
    """Counts all rows by their outcomes; returns those to keep."""
    kept = np.all([np.ones(len(rows["episode"]), bool), *(rows[name] for name in keep)], 0)
    counts.update(episodes=len(kept), kept=int(kept.sum()), **{name: int(rows[name].sum()) for name in VERDICTS})
    return {name: column[kept] for name, column in rows.items()}
