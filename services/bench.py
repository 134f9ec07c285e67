"""Benchmarks that print ratios against a reference measured in the same run."""

import functools
import os
import time
from collections.abc import Callable

import jax
import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

from actors.physics import make_physics
from actors.physics.native import NativePhysics
from actors.rollout import RolloutWorker
from actors.taskset import build_taskset
from common.config import PhysicsName
from common.hands import get_hand
from common.objects.pool import load_pool
from common.policy.bundle import PolicyBundle, sample_action
from services.presets import get_preset
from services.quickstart import untrained

_STEPS = 75


def engines() -> list[PhysicsName]:
    """Engines that this machine has; `jax` only where it is not a CPU's second choice."""
    return ["native"] if jax.default_backend() == "cpu" else ["native", "warp", "jax"]


def bench_physics(environments: int, threads: int, repeats: int, names: list[PhysicsName]) -> None:
    """Control steps a second of actors (policy, observation, reward, reset) beside engines that only step.

    The bare engine steps the same models with the same controls as the actor just did, on as many threads.
    """
    console = Console()
    config = get_preset("quickstart")
    hand = get_hand(config.task.hand)
    objects = load_pool(config.objects)
    taskset = build_taskset(hand, config.task, objects, 0)
    policy = untrained(config)
    table = Table(
        title=f"{environments} environments, {threads} thread(s), {_STEPS} control steps, median of {repeats}"
    )
    for column in ("engine", "actor, control steps/s", "engine alone, control steps/s", "ratio"):
        table.add_column(column, justify="left" if column == "engine" else "right")
    for name in names:
        physics = make_physics(name, hand, config.task, objects, threads=threads)
        worker = RolloutWorker(
            hand,
            config.task,
            physics,
            taskset,
            functools.partial(sample_action, policy.spec.layout),
            batch=environments,
            seed=0,
            half=True,
        )
        _collect(worker, policy)
        actor, bare = [], []
        for _ in range(repeats):
            actor.append(environments * _STEPS / _timed(functools.partial(_collect, worker, policy)))
            run: Callable[[], object]
            if isinstance(physics, NativePhysics):
                run = functools.partial(_bare_native, physics, config.task.substeps, threads)
            else:
                run = functools.partial(_bare_compiled, worker)
                run()
            bare.append(environments * _STEPS / _timed(run))
        a, b = float(np.median(actor)), float(np.median(bare))
        table.add_row(name, f"{a:,.0f}", f"{b:,.0f}", f"{a / b:.2f}")
        physics.close()
    console.print(table)


def _timed(run: Callable[[], object]) -> float:
    began = time.perf_counter()
    run()
    return time.perf_counter() - began


def _collect(worker: RolloutWorker, policy: PolicyBundle) -> None:
    jax.block_until_ready(worker.collect(policy.acting, _STEPS).reward)


def _bare_native(physics: NativePhysics, substeps: int, threads: int) -> None:
    """Nothing but `mj_step` on the actor's own worlds, from where they are, on as many threads."""
    import concurrent.futures

    cells = physics.cells

    def run(chunk: np.ndarray) -> None:
        for _ in range(_STEPS):
            for i in chunk:
                mujoco.mj_step(cells[i].model, cells[i].data, substeps)

    with concurrent.futures.ThreadPoolExecutor(threads) as pool:
        list(pool.map(run, np.array_split(np.arange(len(cells)), threads)))


@functools.lru_cache(maxsize=1)
def _compiled_loop(worker: RolloutWorker) -> Callable[[], object]:
    physics = worker.physics

    def loop(state: object, target: jax.Array, table: jax.Array) -> object:
        def body(carry: object, _: None) -> tuple[object, None]:
            return physics.step(carry, target, table)[0], None

        return jax.lax.scan(body, state, None, length=_STEPS)[0]

    compiled = jax.jit(loop)
    target = jax.numpy.concatenate([worker.env.u_target, worker.env.q_target], -1)
    table = jax.numpy.ones(len(target), bool)
    return lambda: jax.block_until_ready(compiled(worker.state, target, table))


def _bare_compiled(worker: RolloutWorker) -> object:
    return _compiled_loop(worker)()


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
