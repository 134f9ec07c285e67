"""Environments in Warp's memory: shared model, fields of their objects, and one control step of all of them.

`control_step` is the interface to JAX: a pure function of small arrays. Model and data stay in buffers allocated once
per batch, so that their addresses never change and one CUDA graph of a control step serves every program that calls it,
wherever JAX places its arrays.
"""

import dataclasses
import itertools
import weakref
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import warp as wp
from mujoco.mjx.third_party import mujoco_warp
from warp import JaxCallableGraphMode, jax_callable

from congrasp.actors.physics.scene import TABLE_AWAY, Addresses
from congrasp.actors.physics.warp_kernels import DATA_LEAVES, MODEL_LEAVES, OBJECT_FIELDS, Leaves, Objects, count, place

CONTACTS_PER_ENVIRONMENT = 40
"""Average capacity of the shared contact list for each environment."""
CONSTRAINTS_PER_ENVIRONMENT = 320
"""Capacity of constraint rows for each environment."""


class WarpBuffers:
    """Buffers of a batch of environments on one device."""

    def __init__(
        self,
        model: mujoco.MjModel,
        where: Addresses,
        geoms: np.ndarray,
        substeps: int,
        batch: int,
        device: wp.Device,
    ):
        """Allocates the buffers.

        Args:
          model: model shared by the environments.
          where: indices of the model.
          geoms: (S,) geoms of the object's slots.
          substeps: physics steps of a control step.
          batch: number B of environments.
          device: device of the buffers.
        """
        self._substeps, self._device = substeps, device
        self._graph: wp.Graph | None = None
        capacities = [CONTACTS_PER_ENVIRONMENT * batch, CONSTRAINTS_PER_ENVIRONMENT, substeps * batch]
        self.limits = np.array(capacities, np.float32)
        """(3,) capacities of contacts and constraint rows, and physics steps of all environments in a control step."""
        with wp.ScopedDevice(device):
            # A single row would mark the field as shared, and meshes could then never be absent.
            self._model = mujoco_warp.put_model(model, dict.fromkeys(MODEL_LEAVES, max(batch, 2)))
            self._data = mujoco_warp.make_data(
                model, batch, naconmax=CONTACTS_PER_ENVIRONMENT * batch, njmax=CONSTRAINTS_PER_ENVIRONMENT
            )
            self._occupancy = wp.zeros(3, dtype=int)
            self._leaves = leaves = Leaves()
            for name in MODEL_LEAVES:
                setattr(leaves, name, getattr(self._model, name))
            for name in DATA_LEAVES:
                setattr(leaves, name, getattr(self._data, name))
            leaves.geoms = wp.array(geoms, dtype=int)
            leaves.motors = wp.array(where.motors, dtype=int)
            leaves.gains = wp.array(
                np.stack([model.actuator_gainprm[where.motors, 0], *model.actuator_biasprm[where.motors, 1:3].T], -1),
                dtype=wp.vec3,
            )
        wp.synchronize_device(device)  # JAX's stream does not wait for Warp's
        leaves.object_body, leaves.object_dof = where.object_body, where.object_qvel[0]
        leaves.base_body, leaves.table, leaves.anchor = where.base_body, where.table_mocap, where.anchor_mocap
        leaves.weld, leaves.table_away = where.weld, TABLE_AWAY[2]
        # The kernels print every overflow; thousands of environments would flood the log.
        self._model.opt.warn_overflow = 0
        self._sensing = self._model.opt.disableflags
        self._blind = self._sensing | mujoco_warp.DisableBit.SENSOR

    def fill(self, objects: Objects, meshes: dict[str, Any]) -> None:
        """Sets the sources of the environments' fields: rows, and the fields of the model with their meshes."""
        self._objects, self._graph = objects, None
        for name, value in meshes.items():
            setattr(self._model, name, value)

    def control_step(
        self,
        qpos: Any,
        qvel: Any,
        qacc_warmstart: Any,
        ctrl: Any,
        placed: Sequence[Any],
        sensordata: Any,
        occupancy: Any,
    ) -> None:
        """Steps all environments on the current stream; modifies the first three arrays and writes the last two."""
        data = self._data
        state = (data.qpos, qpos), (data.qvel, qvel), (data.qacc_warmstart, qacc_warmstart)
        for mine, given in (*state, (data.ctrl, ctrl)):
            wp.copy(mine, given)
        inputs = [*placed, self._objects, self._leaves, self._occupancy]
        wp.launch(place, (data.nworld, self._leaves.geoms.size), inputs, device=self._device)
        self._launch()
        for mine, given in (*state, (data.sensordata, sensordata), (self._occupancy, occupancy)):
            wp.copy(given, mine)

    def repeat(self, steps: int) -> None:
        """Repeats control steps from the last state with Warp only, and waits for them; for benchmarks."""
        with wp.ScopedDevice(self._device):
            for _ in range(steps):
                self._launch()
        wp.synchronize_device(self._device)

    def _launch(self) -> None:
        """Launches the kernels of one control step."""
        if not self._device.is_cuda:
            self._substep_all()
            return
        if self._graph is None:
            self._graph = self._capture()
        wp.capture_launch(self._graph)

    def _capture(self) -> wp.Graph:
        """Records the kernels of one control step as a CUDA graph."""
        with wp.ScopedCapture() as capture:
            self._substep_all()
        return capture.graph

    def _substep_all(self) -> None:
        """Runs the physics steps of a control step; contacts are read in the last one."""
        model, data = self._model, self._data
        for left in reversed(range(self._substeps)):
            model.opt.disableflags = self._blind if left else self._sensing
            mujoco_warp.step(model, data)
            counts = [data.ncollision, data.nacon, data.nefc, data.solver_niter, model.opt.iterations, self._occupancy]
            wp.launch(count, data.nworld, counts, device=self._device)


def objects_on(device: wp.Device, rows: dict[str, np.ndarray]) -> Objects:
    """Transfers the rows of a catalogue to a device."""
    objects = Objects()
    for name, dtype in OBJECT_FIELDS.items():
        value = rows[name].reshape(len(rows[name]), -1, 2, 3) if name == "geom_aabb" else rows[name]
        setattr(objects, name, wp.array(value, dtype=dtype, device=device))
    return objects


def meshes_on(device: wp.Device, model: mujoco.MjModel) -> dict[str, Any]:
    """Transfers the mesh fields of a model to a device, by name."""
    values: dict[str, Any] = {name: getattr(model, name) for name in ("nmesh", "npolygonmax", "nmeshdegmax")}
    for field in dataclasses.fields(mujoco_warp.Model):
        if field.name.startswith("mesh_"):
            kind: Any = field.type
            values[field.name] = wp.array(getattr(model, field.name), dtype=kind.dtype, device=device)
    return values


_buffers: "weakref.WeakValueDictionary[int, WarpBuffers]" = weakref.WeakValueDictionary()
_handles = itertools.count()


def register(buffers: WarpBuffers) -> int:
    """Registers the buffers; `control_step` finds them by the returned handle while they are referenced."""
    handle = next(_handles)
    _buffers[handle] = buffers
    return handle


def _control_step(
    handle: int,
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    qacc_warmstart: wp.array2d[float],
    ctrl: wp.array2d[float],
    table: wp.array[bool],
    force: wp.array[wp.vec3],
    row: wp.array[int],
    mass_scale: wp.array[float],
    friction: wp.array[float],
    gain_scale: wp.array[float],
    base_position: wp.array[wp.vec3],
    base_quaternion: wp.array[wp.quat],
    anchor_position: wp.array[wp.vec3],
    anchor_quaternion: wp.array[wp.quat],
    stationary: wp.array[bool],
    sensordata: wp.array2d[float],
    occupancy: wp.array[int],
) -> None:
    """Target of the JAX call: finds the buffers by their handle and steps them; arrays as in `WarpPhysics.step`."""
    placed = [table, force, row, mass_scale, friction, gain_scale, base_position, base_quaternion]
    placed += [anchor_position, anchor_quaternion, stationary]
    _buffers[handle].control_step(qpos, qvel, qacc_warmstart, ctrl, placed, sensordata, occupancy)


control_step = jax_callable(
    _control_step,
    num_outputs=5,
    # `WarpBuffers` captures a separate graph: Warp's would use JAX's buffers, and be recaptured wherever those move.
    graph_mode=JaxCallableGraphMode.NONE,
    vmap_method=None,
    in_out_argnames=["qpos", "qvel", "qacc_warmstart"],
)
