"""Buffers of a batch of environments in MuJoCo Warp, and the kernels that step them."""

import concurrent.futures
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from mujoco.mjx.third_party import mujoco_warp

from congrasp.actors.physics.scene import TABLE_AWAY, Addresses
from congrasp.actors.physics.warp_build import Variant, build_kernels, variants_of
from congrasp.actors.physics.warp_kernels import (
    DATA_FIELDS,
    MODEL_FIELDS,
    EnvironmentFields,
    ObjectFields,
    record_occupancy,
    set_environments,
)
from congrasp.common.runtime.physics_library import mujoco

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
        self._substeps = substeps
        self._device = device
        self._graph: wp.Graph | None = None
        capacities = [
            CONTACTS_PER_ENVIRONMENT * batch,
            CONSTRAINTS_PER_ENVIRONMENT,
            substeps * batch,
        ]
        self.limits = np.array(capacities, np.float32)
        """(3,) limits of the occupancy's entries (`warp_kernels.CONTACTS` and following): contacts,
        constraint rows, and physics steps of all environments in a control step.
        """
        with wp.ScopedDevice(device):
            # A single row would mark the field as shared, and meshes could then never be absent.
            self._model = mujoco_warp.put_model(model, dict.fromkeys(MODEL_FIELDS, max(batch, 2)))
            self._data = mujoco_warp.make_data(
                model,
                batch,
                naconmax=CONTACTS_PER_ENVIRONMENT * batch,
                njmax=CONSTRAINTS_PER_ENVIRONMENT,
            )
            self._occupancy = wp.zeros(3, dtype=int)
            self._environments = environments = EnvironmentFields()
            for name in MODEL_FIELDS:
                setattr(environments, name, getattr(self._model, name))
            for name in DATA_FIELDS:
                setattr(environments, name, getattr(self._data, name))
            environments.slot_geoms = wp.array(geoms, dtype=int)
            environments.motors = wp.array(where.motors, dtype=int)
            gain = model.actuator_gainprm[where.motors, :1]
            bias = model.actuator_biasprm[where.motors, 1:3]
            environments.nominal_gains = wp.array(np.concatenate([gain, bias], -1), dtype=wp.vec3)
        environments.object_body = where.object_body
        environments.object_dof = where.object_qvel[0]
        environments.base_body = where.base_body
        environments.table_mocap = where.table_mocap
        environments.anchor_mocap = where.anchor_mocap
        environments.anchor_weld = where.weld
        environments.absent_table_height = TABLE_AWAY[2]
        # The kernels print every overflow; thousands of environments would flood the log.
        self._model.opt.warn_overflow = 0
        self._with_sensors = self._model.opt.disableflags
        self._without_sensors = self._with_sensors | mujoco_warp.DisableBit.SENSOR
        builder = concurrent.futures.ThreadPoolExecutor(1, "kernels")
        self._kernels = builder.submit(self._load_kernels)
        wp.synchronize_device(device)  # JAX's stream does not wait for Warp's

    def fill(self, objects: ObjectFields, meshes: dict[str, Any]) -> None:
        """Sets the sources of the environments' fields: rows, and the fields of the model with
        their meshes.
        """
        self._objects = objects
        self._graph = None
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
        """Steps all environments on the current stream; modifies the first three arrays and writes
        the last two.
        """
        self.wait_for_kernels()
        data = self._data
        for buffer, array in (
            (data.qpos, qpos),
            (data.qvel, qvel),
            (data.qacc_warmstart, qacc_warmstart),
            (data.ctrl, ctrl),
        ):
            wp.copy(buffer, array)
        inputs = [*placed, self._objects, self._environments, self._occupancy]
        threads = (data.nworld, self._environments.slot_geoms.size)
        wp.launch(set_environments, threads, inputs, device=self._device)
        self._launch()
        for array, buffer in (
            (qpos, data.qpos),
            (qvel, data.qvel),
            (qacc_warmstart, data.qacc_warmstart),
            (sensordata, data.sensordata),
            (occupancy, self._occupancy),
        ):
            wp.copy(array, buffer)

    def wait_for_kernels(self) -> None:
        """Waits until the kernels are built, or raises the error at which that failed."""
        self._kernels.result()

    def positions(self) -> np.ndarray:
        """Copies the generalised positions (B, nq) after the last control step."""
        positions: np.ndarray = self._data.qpos.numpy()
        return positions

    def repeat(self, steps: int) -> None:
        """Repeats control steps from the last state with Warp only, and waits for them; for
        benchmarks.
        """
        with wp.ScopedDevice(self._device):
            for _ in range(steps):
                self._launch()
        wp.synchronize_device(self._device)

    def _load_kernels(self) -> None:
        """Builds the kernels of a control step, or reads them from Warp's cache."""
        build_kernels(self._device, self.variants)

    def variants(self) -> list[Variant]:
        """Kernels of a control step, without building them; only `mujoco_warp.step` knows which
        ones a model needs.
        """
        options = self._model.opt
        conditional = options.graph_conditional
        # A loop until the solver's kernels have converged would not end
        options.graph_conditional = False
        try:
            return variants_of(self._device, self._substep_all)
        finally:
            options.graph_conditional = conditional
            options.disableflags = self._with_sensors

    def _launch(self) -> None:
        """Launches the kernels of one control step."""
        if not self._device.is_cuda:
            self._substep_all()
            return
        if self._graph is None:
            with wp.ScopedCapture() as capture:
                self._substep_all()
            self._graph = capture.graph
        wp.capture_launch(self._graph)

    def _substep_all(self) -> None:
        """Runs the physics steps of a control step; contacts are read in the last one."""
        model = self._model
        data = self._data
        for left in reversed(range(self._substeps)):
            is_last = left == 0
            model.opt.disableflags = self._with_sensors if is_last else self._without_sensors
            mujoco_warp.step(model, data)
            inputs = [
                data.ncollision,
                data.nacon,
                data.nefc,
                data.solver_niter,
                model.opt.iterations,
                self._occupancy,
            ]
            wp.launch(record_occupancy, data.nworld, inputs, device=self._device)
