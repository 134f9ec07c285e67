"""MuJoCo C on threads: one compiled scene for each object, one model and data for each world."""

import concurrent.futures
import copy
import functools
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from actors.physics.engine import Readout, World
from actors.physics.readout import diverged, readout
from actors.physics.scene import TABLE_AWAY, addresses, compile_scene
from common.config import TaskConfig
from common.hands.spec import Hand
from common.objects.spec import GraspObject


class Scene:
    """One object's compiled scene, and cells of it that no world uses now."""

    def __init__(self, model: mujoco.MjModel):
        """Nothing is copied yet."""
        # MuJoCo would put a diverged world back by itself, to a pose that is no episode's start, and say nothing.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.model = model
        self.spare: list[Cell] = []

    def take(self) -> "Cell":
        """A cell whose data are as after a reset, made only if no spare one is left."""
        if not self.spare:
            return Cell(self)
        cell = self.spare.pop()
        mujoco.mj_resetData(cell.model, cell.data)
        return cell


class Cell:
    """One world: its own model (base pose, mass and friction differ) and data, with views that stay valid."""

    def __init__(self, scene: Scene):
        """A copy of the scene."""
        self.scene = scene
        self.model = copy.copy(scene.model)
        self.data = mujoco.MjData(self.model)
        self.ctrl, self.qpos, self.qvel = self.data.ctrl, self.data.qpos, self.data.qvel
        self.sensordata = self.data.sensordata


class NativePhysics:
    """A batch of worlds in MuJoCo C. Its state is the object itself; calls mutate it."""

    name = "native"
    compiled = False

    def __init__(self, hand: Hand, task: TaskConfig, objects: Sequence[GraspObject], threads: int):
        """Objects are compiled on first use.

        Args:
          hand: the hand.
          task: timing and collision settings.
          objects: the pool that `World.object_index` points into.
          threads: threads that step worlds in parallel.
        """
        # MuJoCo would write every warning to a file in the working directory; `diverged` sees what they speak of.
        mujoco.set_mju_user_warning(lambda text: None)
        self._hand, self._task, self._objects = hand, task, objects
        self.threads = max(1, threads)
        self._pool = concurrent.futures.ThreadPoolExecutor(self.threads, thread_name_prefix="physics")
        self._scenes: dict[int, Scene] = {}
        self.cells: list[Cell] = []
        self._where = addresses(self._scene(0).model, hand)
        self._readout = jax.jit(functools.partial(readout, jnp, self._where))

    def start(self, world: World) -> "NativePhysics":
        """Fresh worlds; see `Physics.start`."""
        batch = len(np.asarray(world.object_index))
        self.cells = [self._scene(int(index)).take() for index in np.asarray(world.object_index)]
        model = self.cells[0].model
        self._start = np.zeros((batch, model.nq))
        self._qpos = np.zeros((batch, model.nq), np.float32)
        self._qvel = np.zeros((batch, model.nv), np.float32)
        self._sensors = np.zeros((batch, model.nsensordata), np.float32)
        self._table = np.ones(batch, bool)
        return self.reset(self, np.ones(batch, bool), world)

    def reset(self, state: Any, mask: Any, world: World) -> "NativePhysics":
        """Starts the masked worlds anew; see `Physics.reset`."""
        world = World(*(np.asarray(leaf) for leaf in world))
        for i in np.flatnonzero(np.asarray(mask)):
            self._start_world(int(i), world)
        return self

    def step(self, state: Any, target: Any, table: Any) -> tuple["NativePhysics", Readout]:
        """One control step; see `Physics.step`. Diverged worlds are put back to their start and marked."""
        target, table = np.asarray(target), np.asarray(table)
        self.place_tables(table)
        # Threads take world after world from one iterator: contacts make some worlds slower than others.
        worlds = iter(range(len(self.cells)))
        list(self._pool.map(self._step_worlds, [worlds] * self.threads, [target] * self.threads))
        bad = diverged(np, self._qpos, self._qvel)
        for i in np.flatnonzero(bad):
            self._restore(int(i))
        return self, self._seen(bad)

    def place_tables(self, table: np.ndarray) -> None:
        """Puts the tables (B,) where they are true, and takes the others away."""
        for i in np.flatnonzero(table != self._table):
            self.cells[i].data.mocap_pos[self._where.table_mocap] = (0.0, 0.0, 0.0) if table[i] else TABLE_AWAY
        self._table = table.copy()

    def replace_objects(self, state: Any, objects: Sequence[GraspObject]) -> "NativePhysics":
        """Other objects; see `Physics.replace_objects`."""
        self._objects = objects
        self._scenes.clear()
        return self

    def read(self, state: Any) -> Readout:
        """The worlds as they are; see `Physics.read`."""
        return self._seen(np.zeros(len(self.cells), bool))

    def close(self) -> None:
        """Ends the threads."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _scene(self, index: int) -> Scene:
        if index not in self._scenes:
            self._scenes[index] = Scene(compile_scene(self._hand, self._task, self._objects[index]))
        return self._scenes[index]

    def _start_world(self, i: int, world: World) -> None:
        where, scene = self._where, self._scene(int(world.object_index[i]))
        self.cells[i].scene.spare.append(self.cells[i])
        cell = self.cells[i] = scene.take()
        model, data = cell.model, cell.data
        model.body_pos[where.base_body] = world.base_position[i]
        model.body_quat[where.base_body] = world.base_quaternion[i]
        model.body_mass[where.object_body] = scene.model.body_mass[where.object_body] * world.mass_scale[i]
        model.body_inertia[where.object_body] = scene.model.body_inertia[where.object_body] * world.mass_scale[i]
        geoms = model.geom_bodyid == where.object_body
        model.geom_friction[geoms, 0] = world.friction[i]
        data.qpos[where.finger_qpos] = world.q[i]
        data.qpos[where.object_qpos] = np.concatenate([world.object_position[i], world.object_quaternion[i]])
        data.mocap_pos[where.anchor_mocap] = world.object_position[i]
        data.mocap_quat[where.anchor_mocap] = world.object_quaternion[i]
        data.eq_active[where.weld] = world.stationary[i]
        self._table[i] = True
        self._start[i] = data.qpos
        self._copy_out(i)

    def _restore(self, i: int) -> None:
        model, data = self.cells[i].model, self.cells[i].data
        mocap = data.mocap_pos.copy(), data.mocap_quat.copy()
        weld = int(data.eq_active[self._where.weld])
        mujoco.mj_resetData(model, data)
        data.qpos[:] = self._start[i]
        data.mocap_pos[:], data.mocap_quat[:] = mocap
        data.eq_active[self._where.weld] = weld
        self._copy_out(i)

    def _copy_out(self, i: int) -> None:
        cell = self.cells[i]
        self._qpos[i], self._qvel[i], self._sensors[i] = cell.qpos, cell.qvel, cell.sensordata

    def _step_worlds(self, worlds: Iterator[int], target: np.ndarray) -> None:
        substeps = self._task.substeps
        with np.errstate(over="ignore"):  # a diverged world's values may be too large for float32
            for i in worlds:
                cell = self.cells[i]
                cell.ctrl[:] = target[i]
                mujoco.mj_step(cell.model, cell.data, substeps)
                self._copy_out(i)

    def _seen(self, bad: np.ndarray) -> Readout:
        # Copies: the next step writes into the buffers while JAX may still read.
        return self._readout(self._qpos.copy(), self._qvel.copy(), self._sensors.copy(), bad, np.zeros(2, np.float32))
