"""The test on unseen geometry: the heading constraint over as many different objects as there is time for."""

import concurrent.futures
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from common.engines import PhysicsName
from common.objects import procedural
from common.objects.spec import GraspObject
from common.parallel import parallel_map
from common.policy.bundle import PolicyBundle
from services.evaluate.evaluator import Evaluator
from services.evaluate.protocol import two_seconds
from services.evaluate.scores import Row, Sample, joined, object_groups

POOL = 4096
"""Most objects that the worlds draw from at a time; then others take their place."""


def procedural_pools(count: int, seed: int, largest: int = POOL) -> Iterator[list[GraspObject]]:
    """Pools of equal size, at most `largest`, of at least `count` procedural objects of the seeds from `seed`.

    Each pool is made while the one before it is in use.
    """
    number = -(-count // largest)
    size = -(-count // number)
    families = procedural.family_turns(number * size, seed)
    with concurrent.futures.ThreadPoolExecutor(1) as background:

        def make(start: int) -> list[GraspObject]:
            """One pool."""
            return parallel_map(procedural.generate, range(seed + start, seed + start + size), families[start:][:size])

        coming = background.submit(make, 0)
        for start in range(size, number * size + size, size):
            pool = coming.result()
            if start < number * size:
                coming = background.submit(make, start)
            yield pool


def evaluate_objects(
    bundle: PolicyBundle,
    pools: Iterator[Sequence[GraspObject]],
    episodes: int,
    *,
    physics: PhysicsName,
    batch: int,
    threads: int,
    seed: int,
    friction: float,
    progress: Callable[[int], None] = lambda done: None,
) -> list[Row]:
    """Rows of the heading constraint: all objects, then by size, mass and family.

    Args:
      bundle: the policy.
      pools: the objects; see `Evaluator.samples_of_pools`.
      episodes: on each pool.
      physics: engine; not `auto`.
      batch: worlds that run side by side; 0 chooses by the engine.
      threads: threads of the `native` engine.
      seed: seed of constraints and episodes.
      friction: sliding friction between hand and object.
      progress: is told how many episodes there are.
    """
    evaluator = Evaluator(
        bundle,
        next(pools),
        physics=physics,
        batch=batch,
        threads=threads,
        seed=seed,
        friction=friction,
        hold_steps=two_seconds(bundle.task),
        paper="objects",
    )
    samples: list[Sample] = []
    traits: list[tuple[float, float, str]] = []
    names: list[str] = []

    def report(done: int) -> None:
        """Adds the episodes of earlier pools."""
        progress(len(samples) * episodes + done)

    for sample in evaluator.samples_of_pools("heading", pools, episodes, report):
        sample.values["object_index"] = sample.values["object_index"] + len(traits)
        samples.append(sample)
        traits += [_traits(obj) for obj in evaluator.objects]
        names += [obj.name for obj in evaluator.objects]
    whole = joined(samples)
    index = whole.values["object_index"].astype(int)
    sizes, masses, families = (np.array(column) for column in zip(*traits, strict=True))
    rows = [evaluator.row("heading", whole, objects=names)]
    for label, members in object_groups(sizes, masses, families):
        chosen = members[index]
        if chosen.any():
            rows.append(evaluator.row("heading", whole.where(chosen), label, names))
    return rows


def _traits(obj: GraspObject) -> tuple[float, float, str]:
    """Largest side (m), mass (kg) and family."""
    return float(np.ptp(obj.visual_vertices, axis=0).max()), obj.mass, obj.family
