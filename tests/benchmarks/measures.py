"""What measuring plausibility costs an evaluation, beside the same episodes without it."""

import functools
import time
from collections.abc import Callable

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from congrasp.actors.physics import make_physics, resolve_physics
from congrasp.actors.rollout import Probe
from congrasp.actors.worker import RolloutWorker
from congrasp.common.config import ObjectsConfig
from congrasp.common.hands import get_hand
from congrasp.common.objects.distance import distance_field
from congrasp.common.objects.pool import HELD_OUT_SEED, load_pool, scale_objects
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.bundle import sample_action
from congrasp.common.policy.pretrained import policy_file
from congrasp.common.runtime.engines import PhysicsName
from congrasp.common.runtime.resources import cores
from congrasp.common.task import plausibility
from congrasp.common.task.sampling.build import build_bank
from congrasp.services.evaluate.plan import protocol, required_hold_steps


def measures(
    engine: PhysicsName = "auto", environments: int = 64, threads: int = 0, repeats: int = 5
) -> int:
    """Seconds of an evaluation's episodes with measures of plausibility and without.

    The pretrained human policy grasps held-out procedural objects. Lifts and pushes after the hold
    are not part of it.

    Args:
      engine: Engine; auto takes warp on an NVIDIA GPU and native on a CPU.
      environments: Episodes that run side by side.
      threads: Threads of the native engine; 0 takes all cores.
      repeats: Measurements of each, alternating; medians and their ratio are printed.

    Examples:
      python -m tests.benchmarks measures
      python -m tests.benchmarks measures --environments 256
    """
    console, threads, physics = Console(), threads or cores(), resolve_physics(engine)
    policy = bundles.load(policy_file(None, "human"))
    task = protocol(policy.task, required_hold_steps(policy.task))
    hand = get_hand(policy.spec.hand)
    objects = scale_objects(hand, task, load_pool(ObjectsConfig(count=16, seed=HELD_OUT_SEED)))
    bank = build_bank(hand, task, objects, 0)
    steps = task.approach_steps + required_hold_steps(task)
    began = time.perf_counter()
    field = jax.block_until_ready(distance_field(objects))
    seconds = time.perf_counter() - began
    size = field.values.nbytes / 1e6
    console.print(f"Grids of {len(objects)} objects: {seconds:.1f} s, {size:.0f} MB")

    def worker(probe: Probe) -> RolloutWorker:
        rollout_worker = RolloutWorker(
            hand,
            task,
            make_physics(physics, hand, task, objects, threads=threads),
            bank,
            functools.partial(sample_action, policy.spec.layout),
            batch=environments,
            seed=0,
            half_precision=False,
            probe=probe,
        )
        rollout_worker.adjust(probe_data=field)
        return rollout_worker

    def run(worker: RolloutWorker) -> None:
        worker.restart()
        rollout = worker.collect(policy.inference_parameters, steps)
        jax.block_until_ready(rollout.reward)
        if rollout.probed is not None:
            plausibility.measures(jax.tree.map(np.asarray, rollout.probed), task.control_dt)

    workers = [worker(lambda scene, index, data: None), worker(plausibility.sample)]
    for one in workers:
        run(one)
    rounds = []
    for _ in range(repeats):
        rounds.append([_timed(functools.partial(run, one)) for one in workers])
    timed = np.array(rounds)
    table = Table(
        title=f"{physics}: {environments} episodes of {steps} control steps, medians of {repeats}"
    )
    for column in ("", "without, s", "with, s", "ratio"):
        table.add_column(column, justify="left" if not column else "right")
    for name, (without, measured) in zip(
        ("wall clock", "processor"), np.median(timed, 0).T, strict=True
    ):
        table.add_row(name, f"{without:.2f}", f"{measured:.2f}", f"{measured / without:.2f}")
    console.print(table)
    for one in workers:
        one.physics.close()
    return 0


def _timed(run: Callable[[], object]) -> tuple[float, float]:
    """Seconds of a call by the clock, and of the processor in all threads."""
    began = time.perf_counter()
    busy = time.process_time()
    run()
    return time.perf_counter() - began, time.process_time() - busy
