"""Control steps per second of actors and of the bare engine, measured alternately."""

import functools
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from congrasp.actors.physics import make_physics, resolve_physics
from congrasp.actors.physics.engine import Physics
from congrasp.actors.physics.native import NativePhysics
from congrasp.actors.worker import RolloutWorker
from congrasp.common.hands import get_hand
from congrasp.common.hands.motors import motor_positions
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.pool import load_pool, scale_objects
from congrasp.common.objects.spec import GraspObject
from congrasp.common.policy.bundle import PolicyBundle, acting
from congrasp.common.runtime.engines import ENGINES, PhysicsName
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.sampling.build import build_bank
from congrasp.services.bench.replay import Recorder, replay, rolled
from congrasp.services.train.command import untrained
from congrasp.services.train.presets import get_preset

_STEPS = 75
"""Control steps of one whole episode: every repeat begins with new episodes and ends with their
reset.
"""
_COLUMNS = (
    "engine",
    "actor, control steps/s",
    "engine alone, control steps/s",
    "ratio of medians",
    "of bests",
)
_PEERS = {"native": "mujoco.rollout, no actor", "warp": "mujoco_warp without JAX, no actor"}
"""Rows of other programs that make the same steps."""
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


class _Setting(NamedTuple):
    """The hand, task, objects and policy of all engines."""

    hand: Hand
    task: TaskConfig
    objects: Sequence[GraspObject]
    bank: ConstraintBank
    policy: PolicyBundle
    environments: int
    threads: int
    """Threads of engines that step on the CPU."""

    def worker(self, physics: Physics) -> RolloutWorker:
        """Returns an actor's worker with an engine, after its first episodes, which compile."""
        worker = RolloutWorker(
            self.hand,
            self.task,
            physics,
            self.bank,
            acting(self.policy.spec.layout, mean=False),
            batch=self.environments,
            seed=0,
            half_precision=True,
        )
        self.collect(worker)
        return worker

    def collect(self, worker: RolloutWorker) -> None:
        """Collects one episode of every environment."""
        jax.block_until_ready(worker.collect(self.policy.inference_parameters, _STEPS).reward)


class _Seconds(NamedTuple):
    """Durations of the repeats, s."""

    actor: list[float]
    engine: list[float]
    peer: list[float]
    """Empty for an engine without a peer."""


def default_engines() -> list[PhysicsName]:
    """Engines to compare on this machine: all that it has on a GPU, only the fastest one on a
    CPU.
    """
    backend = jax.default_backend()
    if backend == "cpu":
        return [resolve_physics("auto")]
    return [name for name, engine in ENGINES.items() if engine.missing(backend) is None]


def bench_physics(
    environments: int, threads: int, repeats: int, names: Sequence[PhysicsName]
) -> None:
    """Prints control steps per second of actors (policy, observation, reward, reset) and of engines
    that only step.
    """
    setting = _setting(environments, threads)
    title = (
        f"{environments} environments, {threads} thread(s), {_STEPS} control steps, {repeats} "
        f"repeats"
    )
    table = Table(title=title)
    for column in _COLUMNS:
        table.add_column(column, justify="left" if column == "engine" else "right")
    for name in names:
        if name == "native":
            seconds = _measure_native(setting, repeats)
        else:
            seconds = _measure(name, setting, repeats)
        table.add_row(name, *_row(environments, seconds.actor, seconds.engine))
        if seconds.peer:
            table.add_row(_PEERS[name], *_row(environments, seconds.peer, seconds.engine))
    console = Console(markup=False)
    console.print(table)
    console.print(_DEFINITION)


def _setting(environments: int, threads: int) -> _Setting:
    """The hand, task and objects of the preset `quickstart`, and a policy with random weights."""
    config = get_preset("quickstart")
    hand = get_hand(config.task.hand)
    objects = scale_objects(hand, config.task, load_pool(config.objects))
    return _Setting(
        hand=hand,
        task=config.task,
        objects=objects,
        bank=build_bank(hand, config.task, objects, 0),
        policy=untrained(config),
        environments=environments,
        threads=threads,
    )


def _measure_native(setting: _Setting, repeats: int) -> _Seconds:
    """Times an actor on MuJoCo C, and the steps of its episodes without it, by `mj_step` and by
    `mujoco.rollout`.
    """
    substeps = setting.task.substeps
    recorder = Recorder(setting.hand, setting.task, setting.objects, setting.threads)
    worker = setting.worker(recorder)
    twin = NativePhysics(setting.hand, setting.task, setting.objects, setting.threads)
    seconds = _Seconds([], [], [])
    for _ in range(repeats):
        assert worker.state is not None
        twin.start(worker.state.reset_state)
        recorder.commands.clear()
        seconds.actor.append(_timed(functools.partial(setting.collect, worker)))
        seconds.peer.append(_timed(rolled(twin, recorder.commands, substeps)))
        seconds.engine.append(_timed(functools.partial(replay, twin, recorder.commands, substeps)))
    recorder.close()
    twin.close()
    return seconds


def _measure(name: PhysicsName, setting: _Setting, repeats: int) -> _Seconds:
    """Times an actor on another engine, and this engine without it."""
    physics = make_physics(
        name, setting.hand, setting.task, setting.objects, threads=setting.threads
    )
    worker = setting.worker(physics)
    loop = _compiled_loop if physics.compiled else _plain_loop
    engine_alone = loop(worker, setting.hand)
    seconds = _Seconds([], [], [])
    for _ in range(repeats):
        seconds.actor.append(_timed(functools.partial(setting.collect, worker)))
        if name == "warp":
            kernels_alone = functools.partial(
                physics.repeat,  # type: ignore[attr-defined]
                setting.environments,
                _STEPS,
            )
            seconds.peer.append(_timed(kernels_alone))
        seconds.engine.append(_timed(engine_alone))
    physics.close()
    return seconds


def _compiled_loop(worker: RolloutWorker, hand: Hand) -> Callable[[], object]:
    """Compiled control steps of the engine alone, which hold the worker's last targets."""
    physics = worker.physics

    def loop(state: object, target: jax.Array, table: jax.Array) -> object:
        """Advances the engine by whole episodes."""

        def body(carry: object, _: None) -> tuple[object, None]:
            return physics.step(carry, target, table)[0], None

        return jax.lax.scan(body, state, None, length=_STEPS)[0]

    compiled = jax.jit(loop)
    state = worker.state
    assert state is not None
    target, table = _last_targets(worker, hand)

    def run() -> object:
        """Advances the engine, and waits for it."""
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
        """Advances the engine by whole episodes."""
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


def _row(
    environments: int, seconds: Sequence[float], engine_seconds: Sequence[float]
) -> tuple[str, str, str, str]:
    """Cells of the table: control steps per second, those of the engine alone, and two ratios."""
    steps = environments * _STEPS
    median = np.median(seconds)
    engine_median = np.median(engine_seconds)
    return (
        f"{steps / median:,.0f}",
        f"{steps / engine_median:,.0f}",
        f"{engine_median / median:.2f}",
        f"{min(engine_seconds) / min(seconds):.2f}",
    )


def _timed(run: Callable[[], object]) -> float:
    """Seconds of a call."""
    began = time.perf_counter()
    run()
    return time.perf_counter() - began
