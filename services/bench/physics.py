"""Control steps per second of actors and of the bare engine, measured alternately."""

import concurrent.futures
import functools
import itertools
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from mujoco import rollout
from rich.console import Console
from rich.table import Table

from congrasp.actors.physics import make_physics, resolve_physics
from congrasp.actors.physics.engine import Physics, PhysicsState
from congrasp.actors.physics.native import NativePhysics
from congrasp.actors.worker import RolloutWorker
from congrasp.common.hands import get_hand
from congrasp.common.hands.motors import motor_positions
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.pool import load_pool, scale_objects
from congrasp.common.policy.bundle import PolicyBundle, acting
from congrasp.common.runtime.engines import ENGINES, PhysicsName
from congrasp.common.runtime.physics_library import mujoco
from congrasp.common.task.sampling.build import build_bank
from congrasp.services.train.command import untrained
from congrasp.services.train.presets import get_preset

_STEPS = 75
"""Control steps of one whole episode: every repeat begins with new episodes and ends with their
reset.
"""
_DEFINITION = (
    "Actor: policy, observation, physics, reward and reset of whole episodes. Engine alone: for "
    "native, mj_step on "
    "the same models, start states and control targets, hence the same contacts, with as many "
    "threads; for others, "
    "steps that hold the actor's last targets. mujoco.rollout: the same steps in its own threads, "
    "whole episodes at "
    "once, a call for each object. mujoco_warp: its kernels from the episodes' ends on, with the "
    "last targets. Ratio: "
    "the actor's control steps/s over the engine's."
)


def engines() -> list[PhysicsName]:
    """Engines to compare on this machine: all that it has on a GPU, only the fastest one on a
    CPU.
    """
    backend = jax.default_backend()
    if backend == "cpu":
        return [resolve_physics("auto")]
    return [name for name, engine in ENGINES.items() if engine.missing(backend) is None]


_PEERS = {"native": "mujoco.rollout, no actor", "warp": "mujoco_warp without JAX, no actor"}
Rolled = Callable[[], np.ndarray]


class Recorder(NativePhysics):
    """A native engine that records its commands, so that another engine can reproduce its
    states.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        """Takes the arguments of `NativePhysics`."""
        super().__init__(*args, **kwargs)
        self.commands: list[tuple[np.ndarray, np.ndarray]] = []
        """Targets (B, 6 + F) and tables (B,) of every control step."""

    def step(
        self, state: Any, target: Any, table: Any, force: Any | None = None
    ) -> tuple[NativePhysics, PhysicsState]:
        """Advances one control step, and records its commands."""
        self.commands.append((np.array(target), np.array(table)))
        return super().step(state, target, table, force)


def replay(
    physics: NativePhysics, commands: Sequence[tuple[np.ndarray, np.ndarray]], substeps: int
) -> None:
    """Repeats recorded control steps by `mj_step` alone; threads share the worlds and only wait
    when tables move.
    """

    def run(environments: np.ndarray, targets: Sequence[np.ndarray]) -> None:
        for target in targets:
            for i in environments:
                instance = physics.instances[i]
                instance.ctrl[:] = target[i]
                mujoco.mj_step(instance.model, instance.data, substeps)

    shares = np.array_split(np.arange(len(physics.instances)), physics.threads)
    with concurrent.futures.ThreadPoolExecutor(physics.threads) as pool:
        for _, group in itertools.groupby(commands, key=lambda command: command[1].tobytes()):
            targets, tables = zip(*group, strict=True)
            physics.place_tables(tables[0])
            list(pool.map(run, shares, itertools.repeat(targets)))


def rolled(
    physics: NativePhysics, commands: Sequence[tuple[np.ndarray, np.ndarray]], substeps: int
) -> Rolled:
    """Prepares recorded control steps as calls of `mujoco.rollout`, with threads and the loop over
    the steps in C.

    Each object needs a call, since the models of a call must have one size. A policy that acts in
    all environments between two steps could therefore not use it.

    Returns:
      A function without arguments that makes the calls, and returns the final positions (nq,) of
      every environment.
    """
    given = mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_EQ_ACTIVE
    given |= mujoco.mjtState.mjSTATE_MOCAP_POS | mujoco.mjtState.mjSTATE_MOCAP_QUAT
    whole = mujoco.mjtState.mjSTATE_FULLPHYSICS
    first, instances = physics.instances[0].model, physics.instances
    starts = np.zeros((len(instances), mujoco.mj_stateSize(first, whole)))
    controls = np.zeros((len(instances), len(commands), mujoco.mj_stateSize(first, given)))
    for i, instance in enumerate(instances):
        mujoco.mj_getState(instance.model, instance.data, starts[i], whole)
    for step, (target, table) in enumerate(commands):
        physics.place_tables(table)
        for i, instance in enumerate(instances):
            instance.ctrl[:] = target[i]
            mujoco.mj_getState(instance.model, instance.data, controls[i, step], given)
    controls = np.repeat(controls, substeps, 1)
    scenes = list(map(id, physics.scenes))
    groups = [np.flatnonzero(np.array(scenes) == scene) for scene in dict.fromkeys(scenes)]
    scratch = [
        [mujoco.MjData(instances[rows[0]].model) for _ in range(physics.threads)] for rows in groups
    ]

    def run() -> np.ndarray:
        found = np.zeros((len(instances), first.nq))
        with rollout.Rollout(nthread=physics.threads) as threads:
            for rows, data in zip(groups, scratch, strict=True):
                models = [instances[i].model for i in rows]
                states, _ = threads.rollout(
                    models, data, starts[rows], controls[rows], control_spec=int(given)
                )
                found[rows] = states[:, -1, 1 : 1 + first.nq]  # the time is first
        return found

    return run


def bench_physics(environments: int, threads: int, repeats: int, names: list[PhysicsName]) -> None:
    """Prints control steps per second of actors (policy, observation, reward, reset) and of engines
    that only step.
    """
    console = Console(markup=False)
    config = get_preset("quickstart")
    hand = get_hand(config.task.hand)
    objects = scale_objects(hand, config.task, load_pool(config.objects))
    bank = build_bank(hand, config.task, objects, 0)
    policy = untrained(config)
    table = Table(
        title=(
            f"{environments} environments, {threads} thread(s), {_STEPS} control steps, {repeats} "
            f"repeats"
        )
    )
    for column in (
        "engine",
        "actor, control steps/s",
        "engine alone, control steps/s",
        "ratio of medians",
        "of bests",
    ):
        table.add_column(column, justify="left" if column == "engine" else "right")
    for name in names:
        if name == "native":
            physics: Physics = Recorder(hand, config.task, objects, threads)
        else:
            physics = make_physics(name, hand, config.task, objects, threads=threads)
        worker = RolloutWorker(
            hand,
            config.task,
            physics,
            bank,
            acting(policy.spec.layout, mean=False),
            batch=environments,
            seed=0,
            half_precision=True,
        )
        _collect(worker, policy)
        twin = (
            NativePhysics(hand, config.task, objects, threads)
            if isinstance(physics, Recorder)
            else None
        )
        bare: Callable[[], object]
        actor_seconds, bare_seconds, peer_seconds = [], [], []
        for _ in range(repeats):
            if isinstance(physics, Recorder) and twin is not None:
                assert worker.state is not None
                twin.start(worker.state.reset_state)
                physics.commands.clear()
                bare = functools.partial(replay, twin, physics.commands, config.task.substeps)
            elif physics.compiled:
                bare = _compiled_loop(worker, hand)
            else:
                bare = _plain_loop(worker, hand)
            actor_seconds.append(_timed(functools.partial(_collect, worker, policy)))
            if isinstance(physics, Recorder) and twin is not None:
                peer_seconds.append(_timed(rolled(twin, physics.commands, config.task.substeps)))
            if name == "warp":
                peer_seconds.append(_timed(functools.partial(physics.repeat, environments, _STEPS)))  # type: ignore[attr-defined]
            bare_seconds.append(_timed(bare))
        table.add_row(
            name, *_row(environments * _STEPS, np.array(actor_seconds), np.array(bare_seconds))
        )
        if peer_seconds:
            peer = _row(environments * _STEPS, np.array(peer_seconds), np.array(bare_seconds))
            table.add_row(_PEERS[name], *peer)
        physics.close()
        if twin is not None:
            twin.close()
    console.print(table)
    console.print(_DEFINITION)


def _row(steps: int, actor: np.ndarray, bare: np.ndarray) -> list[str]:
    """Cells of the table, from the seconds of every repeat."""
    a, b = np.median(actor), np.median(bare)
    return [
        f"{steps / a:,.0f}",
        f"{steps / b:,.0f}",
        f"{b / a:.2f}",
        f"{bare.min() / actor.min():.2f}",
    ]


def _timed(run: Callable[[], object]) -> float:
    """Seconds of a call."""
    began = time.perf_counter()
    run()
    return time.perf_counter() - began


def _collect(worker: RolloutWorker, policy: PolicyBundle) -> None:
    """Collects one episode of every environment."""
    jax.block_until_ready(worker.collect(policy.inference_parameters, _STEPS).reward)


@functools.lru_cache(maxsize=1)
def _compiled_loop(worker: RolloutWorker, hand: Hand) -> Callable[[], object]:
    """Compiled control steps of the engine alone."""
    physics = worker.physics

    def loop(state: object, target: jax.Array, table: jax.Array) -> object:
        def body(carry: object, _: None) -> tuple[object, None]:
            return physics.step(carry, target, table)[0], None

        return jax.lax.scan(body, state, None, length=_STEPS)[0]

    compiled = jax.jit(loop)
    state = worker.state
    assert state is not None
    target, table = _last_targets(worker, hand)

    def run() -> object:
        return jax.block_until_ready(compiled(state.physics, target, table))

    run()
    return run


def _plain_loop(worker: RolloutWorker, hand: Hand) -> Callable[[], object]:
    """Control steps of an engine that is not compiled, alone."""
    physics = worker.physics
    assert worker.state is not None
    running = worker.state.physics
    target, table = _last_targets(worker, hand)

    def run() -> object:
        for _ in range(_STEPS):
            physics.step(running, target, table)
        return running

    return run


def _last_targets(worker: RolloutWorker, hand: Hand) -> tuple[jax.Array, jax.Array]:
    """Last targets (B, 6 + M) of an actor, and tables (B,) that are all present."""
    state = worker.state
    assert state is not None
    target = jax.numpy.concatenate([state.u_target, motor_positions(hand, state.q_target)], -1)
    return target, jax.numpy.ones(len(target), bool)
