"""Repeats recorded control steps of the native engine by MuJoCo alone, to compare the speed of an
actor with it.
"""

import concurrent.futures
import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from mujoco import rollout

from congrasp.actors.physics.engine import PhysicsState
from congrasp.actors.physics.native import NativePhysics
from congrasp.common.runtime.physics_library import mujoco

_CONTROLS = (
    mujoco.mjtState.mjSTATE_CTRL
    | mujoco.mjtState.mjSTATE_EQ_ACTIVE
    | mujoco.mjtState.mjSTATE_MOCAP_POS
    | mujoco.mjtState.mjSTATE_MOCAP_QUAT
)
"""Inputs of a physics step: targets, the weld of a stationary object, and the table's pose."""
_WHOLE_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS


class Command(NamedTuple):
    """Inputs of one control step of B environments."""

    target: np.ndarray
    """(B, 6 + F) targets of the servos."""
    table: np.ndarray
    """(B,) True if the table is present."""


class Recorder(NativePhysics):
    """A native engine that records its commands, so that another engine can reproduce its
    states.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        """Takes the arguments of `NativePhysics`."""
        super().__init__(*args, **kwargs)
        self.commands: list[Command] = []
        """Commands of every control step."""

    def step(
        self, state: Any, target: Any, table: Any, force: Any | None = None
    ) -> tuple[NativePhysics, PhysicsState]:
        """Advances one control step, and records its commands."""
        self.commands.append(Command(np.array(target), np.array(table)))
        return super().step(state, target, table, force)


def replay(physics: NativePhysics, commands: Sequence[Command], substeps: int) -> None:
    """Repeats recorded control steps by `mj_step` alone; threads share the worlds and only wait
    when tables move.
    """

    def run(environments: np.ndarray, targets: Sequence[np.ndarray]) -> None:
        """Advances some environments by the control steps of these targets."""
        for target in targets:
            for i in environments:
                instance = physics.instances[i]
                instance.ctrl[:] = target[i]
                mujoco.mj_step(instance.model, instance.data, substeps)

    shares = np.array_split(np.arange(len(physics.instances)), physics.threads)
    with concurrent.futures.ThreadPoolExecutor(physics.threads) as pool:
        for group in _with_equal_tables(commands):
            physics.place_tables(group[0].table)
            targets = [command.target for command in group]
            list(pool.map(run, shares, itertools.repeat(targets)))


def _with_equal_tables(commands: Iterable[Command]) -> Iterable[list[Command]]:
    """Yields successive commands between which no table moves."""
    for _, group in itertools.groupby(commands, key=lambda command: command.table.tobytes()):
        yield list(group)


def rolled(
    physics: NativePhysics, commands: Sequence[Command], substeps: int
) -> Callable[[], np.ndarray]:
    """Prepares recorded control steps as calls of `mujoco.rollout`, with threads and the loop over
    the steps in C.

    Each object needs a call, since the models of a call must have one size. A policy that acts in
    all environments between two steps could therefore not use it.

    Returns:
      A function without arguments that makes the calls, and returns the final positions (nq,) of
      every environment.
    """
    instances = physics.instances
    starts = _starts(physics)
    controls = np.repeat(_controls(physics, commands), substeps, 1)
    calls = []
    for rows in _rows_by_object(physics):
        model = instances[rows[0]].model
        scratch = [mujoco.MjData(model) for _ in range(physics.threads)]
        calls.append((rows, scratch))
    position_count = instances[0].model.nq

    def run() -> np.ndarray:
        """Makes the calls."""
        ends = np.zeros((len(instances), position_count))
        with rollout.Rollout(nthread=physics.threads) as threads:
            for rows, scratch in calls:
                models = [instances[i].model for i in rows]
                states, _ = threads.rollout(
                    models, scratch, starts[rows], controls[rows], control_spec=int(_CONTROLS)
                )
                ends[rows] = states[:, -1, 1 : 1 + position_count]  # the time is first
        return ends

    return run


def _starts(physics: NativePhysics) -> np.ndarray:
    """(B, S) current states of the environments."""
    instances = physics.instances
    size = mujoco.mj_stateSize(instances[0].model, _WHOLE_STATE)
    starts = np.zeros((len(instances), size))
    for i, instance in enumerate(instances):
        mujoco.mj_getState(instance.model, instance.data, starts[i], _WHOLE_STATE)
    return starts


def _controls(physics: NativePhysics, commands: Sequence[Command]) -> np.ndarray:
    """(B, T, C) inputs of T control steps."""
    instances = physics.instances
    size = mujoco.mj_stateSize(instances[0].model, _CONTROLS)
    controls = np.zeros((len(instances), len(commands), size))
    for step, command in enumerate(commands):
        physics.place_tables(command.table)
        for i, instance in enumerate(instances):
            instance.ctrl[:] = command.target[i]
            mujoco.mj_getState(instance.model, instance.data, controls[i, step], _CONTROLS)
    return controls


def _rows_by_object(physics: NativePhysics) -> list[np.ndarray]:
    """Environments of each scene, in the order in which the scenes are first used."""
    scenes = np.array([id(scene) for scene in physics.scenes])
    return [np.flatnonzero(scenes == scene) for scene in dict.fromkeys(scenes.tolist())]
