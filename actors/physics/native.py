"""MuJoCo C on threads: one compiled scene for each object, one model and data for each world."""

import concurrent.futures
import copy
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from actors.physics.engine import Readout, World
from actors.physics.readout import diverged, readout
from actors.physics.scene import TABLE_AWAY, addresses, compile_scene
from common.config import TaskConfig
from common.hands.spec import Hand
from common.objects.spec import GraspObject


class Cell:
    """One world: its own model (base pose, mass and friction differ) and data, with views that stay valid."""

    def __init__(self, scene: mujoco.MjModel):
        """A copy of the scene."""
        self.model = copy.copy(scene)
        # MuJoCo would put a diverged world back by itself, to a pose that is no episode's start, and say nothing.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.data = mujoco.MjData(self.model)


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
        self._threads = max(1, threads)
        self._pool = concurrent.futures.ThreadPoolExecutor(self._threads, thread_name_prefix="physics")
        self._scenes: dict[int, mujoco.MjModel] = {}
        self._cells: list[Cell | None] = []
        self._where = addresses(self._scene(0), hand)

    @property
    def cells(self) -> list[Cell]:
        """The worlds, for those who look under the hood."""
        return [cell for cell in self._cells if cell is not None]

    def start(self, world: World) -> "NativePhysics":
        """Fresh worlds; see `Physics.start`."""
        batch = len(np.asarray(world.object_index))
        model = self._scene(0)
        self._cells = [None] * batch
        self._start: list[tuple[np.ndarray, np.ndarray]] = [(np.empty(0), np.empty(0))] * batch
        self._qpos = np.zeros((batch, model.nq))
        self._qvel = np.zeros((batch, model.nv))
        self._sensors = np.zeros((batch, model.nsensordata))
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
        target, table = np.asarray(target, np.float64), np.asarray(table)
        for i in np.flatnonzero(table != self._table):
            cell = self._cells[i]
            assert cell is not None
            cell.data.mocap_pos[self._where.table_mocap] = (0.0, 0.0, 0.0) if table[i] else TABLE_AWAY
        self._table = table.copy()
        chunks = np.array_split(np.arange(len(self._cells)), self._threads)
        list(self._pool.map(lambda chunk: self._step_chunk(chunk, target), chunks))
        bad = diverged(np, self._qpos, self._qvel)
        for i in np.flatnonzero(bad):
            self._restore(int(i))
        return self, self._readout(bad)

    def replace_objects(self, state: Any, objects: Sequence[GraspObject]) -> "NativePhysics":
        """Other objects; see `Physics.replace_objects`."""
        self._objects = objects
        self._scenes.clear()
        return self

    def read(self, state: Any) -> Readout:
        """The worlds as they are; see `Physics.read`."""
        return self._readout(np.zeros(len(self._cells), bool))

    def close(self) -> None:
        """Ends the threads."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _scene(self, index: int) -> mujoco.MjModel:
        if index not in self._scenes:
            self._scenes[index] = compile_scene(self._hand, self._task, self._objects[index])
        return self._scenes[index]

    def _start_world(self, i: int, world: World) -> None:
        where, scene = self._where, self._scene(int(world.object_index[i]))
        cell = self._cells[i] = Cell(scene)
        model, data = cell.model, cell.data
        model.body_pos[where.base_body] = world.base_position[i]
        model.body_quat[where.base_body] = world.base_quaternion[i]
        model.body_mass[where.object_body] *= world.mass_scale[i]
        model.body_inertia[where.object_body] *= world.mass_scale[i]
        geoms = model.geom_bodyid == where.object_body
        model.geom_friction[geoms, 0] = world.friction[i]
        data.qpos[where.finger_qpos] = world.q[i]
        data.qpos[where.object_qpos] = np.concatenate([world.object_position[i], world.object_quaternion[i]])
        data.mocap_pos[where.anchor_mocap] = world.object_position[i]
        data.mocap_quat[where.anchor_mocap] = world.object_quaternion[i]
        data.eq_active[where.weld] = world.stationary[i]
        self._table[i] = True
        self._start[i] = (data.qpos.copy(), data.qvel.copy())
        self._qpos[i], self._qvel[i], self._sensors[i] = data.qpos, data.qvel, 0.0

    def _restore(self, i: int) -> None:
        cell = self._cells[i]
        assert cell is not None
        mocap = cell.data.mocap_pos.copy(), cell.data.mocap_quat.copy()
        weld = int(cell.data.eq_active[self._where.weld])
        mujoco.mj_resetData(cell.model, cell.data)
        cell.data.qpos[:], cell.data.qvel[:] = self._start[i]
        cell.data.mocap_pos[:], cell.data.mocap_quat[:] = mocap
        cell.data.eq_active[self._where.weld] = weld
        self._qpos[i], self._qvel[i], self._sensors[i] = cell.data.qpos, cell.data.qvel, 0.0

    def _step_chunk(self, chunk: np.ndarray, target: np.ndarray) -> None:
        substeps = self._task.substeps
        for i in chunk:
            cell = self._cells[i]
            assert cell is not None
            data = cell.data
            data.ctrl[:] = target[i]
            mujoco.mj_step(cell.model, data, substeps)
            self._qpos[i], self._qvel[i], self._sensors[i] = data.qpos, data.qvel, data.sensordata

    def _readout(self, bad: np.ndarray) -> Readout:
        values = readout(np, self._where, self._qpos, self._qvel, self._sensors, bad, np.zeros(2))
        return Readout(*(np.asarray(v, bool if v.dtype == bool else np.float32) for v in values))
