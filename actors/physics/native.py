"""MuJoCo C on threads: one compiled scene for each object, one model and data for each
environment.
"""

import concurrent.futures
import copy
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.actors.physics.compiled_objects import CompiledObjects
from congrasp.actors.physics.engine import (
    PhysicsState,
    ResetState,
    has_diverged,
    host_arrays,
    physics_state,
)
from congrasp.actors.physics.scene import GAINS, MASS_POWERS, TABLE_AWAY, addresses
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.physics_library import mujoco
from congrasp.common.runtime.resources import memory
from congrasp.common.task.config import TaskConfig

_ENVIRONMENT_BYTES = 860_000
"""Memory of a stepped environment: model, data and their stack."""

_TABLE_PRESENT = (0.0, 0.0, 0.0)
_physics_state = jax.jit(physics_state, static_argnums=(0, 1))


class Scene:
    """Compiled scene of one object, and its unused instances."""

    def __init__(self, model: mujoco.MjModel):
        """Wraps a model; nothing is copied yet."""
        # MuJoCo would silently reset a diverged environment to a pose that is not the episode's
        # start.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.model = model
        self.spare: list[EnvInstance] = []

    def take(self) -> "EnvInstance":
        """Returns an instance in the state after a reset; creates one only if no spare one is
        left.
        """
        if not self.spare:
            return EnvInstance(self.model)
        instance = self.spare.pop()
        mujoco.mj_resetData(instance.model, instance.data)
        return instance


class EnvInstance:
    """Model and data of one environment, with views of their arrays that stay valid.

    The model is a copy, since base pose, mass, friction and gains differ between environments.
    """

    def __init__(self, model: mujoco.MjModel):
        """Copies the model of a scene."""
        self.model = copy.copy(model)
        self.data = mujoco.MjData(self.model)
        self.ctrl = self.data.ctrl
        self.qpos = self.data.qpos
        self.qvel = self.data.qvel
        self.sensordata = self.data.sensordata


class NativePhysics:
    """A batch of environments in MuJoCo C. Its state is this object; calls mutate it."""

    name = "native"
    compiled = False

    def __init__(self, hand: Hand, task: TaskConfig, objects: Sequence[GraspObject], threads: int):
        """Creates the engine; objects are compiled on first use.

        Args:
          hand: the hand.
          task: timing and collision settings.
          objects: the pool indexed by `ResetState.object_index`.
          threads: threads that step environments in parallel.
        """
        self._task = task
        self.threads = max(1, threads)
        self._pool = concurrent.futures.ThreadPoolExecutor(
            self.threads, thread_name_prefix="physics"
        )
        self._compiled = CompiledObjects(hand, task, objects, Scene)
        self.scenes: list[Scene] = []  # scene of each environment
        self.instances: list[EnvInstance] = []
        self._where = addresses(self._compiled[0].model, hand)

    def start(self, reset_state: ResetState) -> "NativePhysics":
        """Starts environments; see `Physics.start`.

        Raises:
          CongraspError: they would not fit into free memory.
        """
        batch = len(np.asarray(reset_state.object_index))
        needed = batch * _ENVIRONMENT_BYTES
        free = memory()
        if free < needed:
            raise CongraspError(
                f"{batch:,} environments of MuJoCo C need {needed / 1e9:.0f} GB of memory, but "
                f"{free / 1e9:.0f} GB are free.",
                "Pass a smaller --environments, or run the actor on a GPU.",
            )
        indices = np.asarray(reset_state.object_index)
        self.scenes = [self._compiled[int(index)] for index in indices]
        self.instances = [scene.take() for scene in self.scenes]
        model = self.instances[0].model
        self._start = np.zeros((batch, model.nq))
        self._qpos = np.zeros((batch, model.nq), np.float32)
        self._qvel = np.zeros((batch, model.nv), np.float32)
        self._sensors = np.zeros((batch, model.nsensordata), np.float32)
        self._limited = np.zeros(batch, bool)  # the solver reached its limit of iterations
        self._table = np.ones(batch, bool)
        return self.reset(self, np.ones(batch, bool), reset_state)

    def reset(self, state: Any, mask: Any, reset_state: ResetState) -> "NativePhysics":
        """Restarts the masked environments; see `Physics.reset`."""
        reset_state = host_arrays(reset_state)
        for i in np.flatnonzero(np.asarray(mask)):
            self._start_instance(int(i), reset_state)
        return self

    def step(
        self, state: Any, target: Any, table: Any, force: Any | None = None
    ) -> tuple["NativePhysics", PhysicsState]:
        """Simulates one control step; see `Physics.step`. Resets and flags diverged
        environments.
        """
        target = np.asarray(target)
        self.place_tables(np.asarray(table))
        if force is not None:
            for instance, push in zip(self.instances, np.asarray(force), strict=True):
                instance.data.xfrc_applied[self._where.object_body, :3] = push
        # Threads take environments from one shared iterator, since contacts make some slower than
        # others.
        environments = iter(range(len(self.instances)))
        steps = []
        for _ in range(self.threads):
            steps.append(self._pool.submit(self._step_instances, environments, target))
        for step in steps:
            step.result()
        diverged = has_diverged(np, self._qpos, self._qvel)
        for i in np.flatnonzero(diverged):
            self._restore(int(i))
        return self, self._current_state(diverged)

    def place_tables(self, table: np.ndarray) -> None:
        """Places the tables where `table` (B,) is true, and removes the others."""
        for i in np.flatnonzero(table != self._table):
            position = _TABLE_PRESENT if table[i] else TABLE_AWAY
            self.instances[i].data.mocap_pos[self._where.table_mocap] = position
        self._table = table.copy()

    def replace_objects(self, state: Any, objects: Sequence[GraspObject]) -> "NativePhysics":
        """Replaces the objects; see `Physics.replace_objects`."""
        self._compiled.replace(objects)
        return self

    def read(self, state: Any) -> PhysicsState:
        """Returns the current state of the environments; see `Physics.read`."""
        return self._current_state(np.zeros(len(self.instances), bool))

    def close(self) -> None:
        """Stops the threads."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _start_instance(self, i: int, reset_state: ResetState) -> None:
        """Places environment i at row i of its reset states, in an instance of its object's
        scene.
        """
        where = self._where
        scene = self._compiled[int(reset_state.object_index[i])]
        self.scenes[i].spare.append(self.instances[i])
        instance = scene.take()
        self.scenes[i] = scene
        self.instances[i] = instance
        self._set_model(instance.model, scene.model, i, reset_state)
        data = instance.data
        data.qpos[where.finger_qpos] = reset_state.q[i]
        data.qvel[where.wrist_qvel] = reset_state.u_velocity[i]
        data.qpos[where.object_qpos] = np.concatenate(
            [reset_state.object_position[i], reset_state.object_quaternion[i]]
        )
        data.mocap_pos[where.anchor_mocap] = reset_state.object_position[i]
        data.mocap_quat[where.anchor_mocap] = reset_state.object_quaternion[i]
        data.eq_active[where.weld] = reset_state.stationary[i]
        self._table[i] = True
        self._start[i] = data.qpos
        self._copy_out(i)

    def _set_model(
        self, model: mujoco.MjModel, unscaled: mujoco.MjModel, i: int, reset_state: ResetState
    ) -> None:
        """Writes base pose, mass, friction and gains of row i of the reset states into the model of
        an instance; `unscaled` is the model of its scene.
        """
        where = self._where
        model.body_pos[where.base_body] = reset_state.base_position[i]
        model.body_quat[where.base_body] = reset_state.base_quaternion[i]
        for name, power in MASS_POWERS.items():
            rows = where.object_qvel if name.startswith("dof") else where.object_body
            nominal = getattr(unscaled, name)[rows]
            getattr(model, name)[rows] = nominal * reset_state.mass_scale[i] ** power
        geoms = model.geom_bodyid == where.object_body
        model.geom_friction[geoms, 0] = reset_state.friction[i]
        for name in GAINS:
            nominal = getattr(unscaled, name)[where.motors]
            getattr(model, name)[where.motors] = nominal * reset_state.gain_scale[i]

    def _restore(self, i: int) -> None:
        """Resets a diverged environment to its start."""
        data = self.instances[i].data
        mocap_pos = data.mocap_pos.copy()
        mocap_quat = data.mocap_quat.copy()
        weld = int(data.eq_active[self._where.weld])
        mujoco.mj_resetData(self.instances[i].model, data)
        data.qpos[:] = self._start[i]
        data.mocap_pos[:] = mocap_pos
        data.mocap_quat[:] = mocap_quat
        data.eq_active[self._where.weld] = weld
        self._copy_out(i)

    def _copy_out(self, i: int) -> None:
        """Copies an instance's state into row i of the batch's arrays."""
        instance = self.instances[i]
        self._qpos[i] = instance.qpos
        self._qvel[i] = instance.qvel
        self._sensors[i] = instance.sensordata

    def _step_instances(self, environments: Iterator[int], target: np.ndarray) -> None:
        """Steps environments from a shared iterator until it is exhausted; runs in each thread."""
        substeps = self._task.substeps
        # A diverged environment's values may be too large for float32
        with np.errstate(over="ignore"):
            for i in environments:
                instance = self.instances[i]
                instance.ctrl[:] = target[i]
                mujoco.mj_step(instance.model, instance.data, substeps)
                self._limited[i] = instance.data.solver_niter.max() >= instance.model.opt.iterations
                self._copy_out(i)

    def _current_state(self, diverged: np.ndarray) -> PhysicsState:
        """Returns the physics state from the batch's arrays; `diverged` (B,) is passed through."""
        # Copies: the next step writes into the buffers while JAX may still read.
        occupancy = np.array([0.0, 0.0, self._limited.mean()], np.float32)
        state: PhysicsState = _physics_state(
            jnp,
            self._where,
            self._qpos.copy(),
            self._qvel.copy(),
            self._sensors.copy(),
            diverged,
            occupancy,
        )
        return state
