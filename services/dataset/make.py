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
from typing import Any

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
from congrasp.services.evaluate.experiment import Experiment
from congrasp.services.evaluate.plan import batches, plan_row
from congrasp.services.evaluate.pools import Pool, Pools, listed_pools, prepared

FORMAT = 1
_EPISODES, _OBJECTS = 8192, 128
"""Limits of a shard's episodes and objects, for the default number of objects."""


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
        return {asked: each + (i < more) for i, asked in enumerate(self.constraints)}

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
        contents = json.dumps(
            [
                dataclasses.asdict(dataclasses.replace(self.options, cache_dir="")),
                [at.digest() for at in self.objects],
            ]
        )
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
      progress: called with the number of simulated episodes; those of a running batch count by
        their share of control steps.
    """
    done = 0
    with contextlib.ExitStack() as stack, prepared(recipe.template, pools, wanted) as ready:
        running: Episodes | None = None
        for pool in ready:
            own = pool.experiment
            columns = grasp_columns(own.hand, own.task)
            counts: dict[str, collections.Counter[str]] = collections.defaultdict(
                collections.Counter
            )
            rows: list[dict[str, np.ndarray]] = [
                {c.name: np.zeros((0, *c.shape), c.kind) for c in columns}
            ]
            if pool.real:
                if running:
                    running.replace_objects(own.scaled, own.field)
                else:
                    running = stack.enter_context(own.simulator())

                def report(episodes: int, before: int = done) -> None:
                    """Reports the pool's episodes with those of earlier pools."""
                    progress(before + episodes)

                for part in _episodes(running, pool, recipe.shares, report):
                    rows.append(_counted(part, recipe.keep, counts))
                    done += len(part["episode"])
            said = {**recipe.about, "shard": own.pool, "counts": counts, "left_out": pool.left_out}
            found = {name: np.concatenate([part[name] for part in rows]) for name in rows[0]}
            of_objects = table(object_columns(), object_rows(own.scaled[: pool.real]), said)
            shards.write(own.pool, table(columns, found, said), of_objects)


def _begun(
    pool: Pool, shares: Mapping[str, int]
) -> tuple[list[InitialConditions], dict[str, np.ndarray]]:
    """Initial conditions of the real objects' episodes under each set of constraints, and columns
    (E,) of all of them.

    Each object has its share of episodes of the constraints that it allows.
    """
    own, begun = pool.experiment, list[InitialConditions]()
    names = np.array([obj.name for obj in own.scaled])
    columns: dict[str, list[np.ndarray]] = {"constraints": [], "object": [], "episode": []}
    for asked, share in shares.items():
        bank = own.bank_for(asked)
        try:
            plan = plan_row(own.task, bank, own.scaled, asked, share * len(own.scaled))
        except CongraspError:
            continue  # no object allows them
        kept = (plan.episodes.numbers < share) & (plan.episodes.objects < pool.real)
        plan = plan._replace(episodes=jax.tree.map(lambda x, kept=kept: x[kept], plan.episodes))
        for conditions, count in batches(
            own.hand, own.task, bank, plan, own.seed, share * len(own.scaled)
        ):
            begun.append(jax.tree.map(lambda x, count=count: x[:count], conditions))
        columns["constraints"].append(np.full(plan.total, asked))
        columns["object"].append(names[plan.episodes.objects])
        columns["episode"].append(plan.episodes.numbers)
    return begun, {name: np.concatenate(parts) for name, parts in columns.items() if parts}


def _episodes(
    running: Episodes, pool: Pool, shares: Mapping[str, int], progress: Callable[[int], None]
) -> Iterator[dict[str, np.ndarray]]:
    """Yields columns of the real objects' episodes, batch by batch; a batch holds episodes under
    any constraints.

    Args:
      running: simulator of the pool's objects.
      pool: the pool.
      shares: episodes of each object, by constraints.
      progress: called with the number of simulated episodes of the pool.
    """
    begun, known = _begun(pool, shares)
    if not begun:
        return
    conditions = jax.tree.map(lambda *parts: jnp.concatenate(parts), *begun)
    total = len(known["episode"])
    for start in range(0, total, running.batch):
        chosen = np.arange(start, start + running.batch).clip(max=total - 1)
        of = {name: column[chosen] for name, column in known.items()}
        count = min(running.batch, total - start)

        def report(share: float, start: int = start, count: int = count) -> None:
            """Counts the episodes of the running batch by their share of control steps."""
            progress(start + int(share * count))

        batch = running.run(
            jax.tree.map(lambda x, chosen=chosen: x[chosen], conditions),
            stressed=running.stressable,
            progress=report,
        )
        rows = grasp_rows(pool.experiment.task, of["constraints"], batch) | of
        yield {name: column[: total - start] for name, column in rows.items()}


def _counted(
    rows: Mapping[str, np.ndarray],
    keep: Sequence[str],
    counts: Mapping[str, collections.Counter[str]],
) -> dict[str, np.ndarray]:
    """Counts all rows by their constraints and outcomes; returns those to keep."""
    kept = np.all([np.ones(len(rows["episode"]), bool), *(rows[name] for name in keep)], 0)
    for asked in dict.fromkeys(rows["constraints"].tolist()):
        of = rows["constraints"] == asked
        outcomes = {name: int(rows[name][of].sum()) for name in VERDICTS}
        counts[asked].update(episodes=int(of.sum()), kept=int(kept[of].sum()), **outcomes)
    return {name: column[kept] for name, column in rows.items()}
