"""MuJoCo Warp, called once per control step: NVIDIA kernels with different objects and meshes in
each environment.

The kernels are those shipped with mujoco-mjx (`mujoco.mjx.third_party.mujoco_warp`); they also run
on a CPU, for tests. The state is a small pytree and every call can be traced, so that a whole
rollout compiles into one program.

`control_step` is the interface to JAX: a pure function of small arrays. Model and data stay in
buffers allocated once per batch, so that their addresses never change and one CUDA graph of a
control step serves every program that calls it, wherever JAX places its arrays.
"""

import concurrent.futures
import contextlib
import dataclasses
import functools
import hashlib
import itertools
import logging
import pathlib
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from typing import Any, BinaryIO, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import warp as wp
from mujoco.mjx.third_party import mujoco_warp
from warp import JaxCallableGraphMode, jax_callable

from congrasp.actors.physics.engine import (
    PhysicsState,
    ResetState,
    has_diverged,
    initial_qpos,
    initial_qvel,
    physics_state,
    where_environments,
)
from congrasp.actors.physics.scene import SENSOR_WIDTH, TABLE_AWAY, Addresses, addresses
from congrasp.actors.physics.slots import Catalogue
from congrasp.actors.physics.warp_kernels import (
    DATA_LEAVES,
    MODEL_LEAVES,
    OBJECT_FIELDS,
    Leaves,
    Objects,
    count,
    place,
)
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.io.locks import try_lock
from congrasp.common.io.opening import open_to_append
from congrasp.common.objects import procedural
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.parallel import cores
from congrasp.common.runtime.physics_library import mujoco
from congrasp.common.runtime.stages import stage
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.types import CONTACTS_PER_LINK, Array

CONTACTS_PER_ENVIRONMENT = 40
"""Average capacity of the shared contact list for each environment."""
CONSTRAINTS_PER_ENVIRONMENT = 320
"""Capacity of constraint rows for each environment."""


# Seconds until a process builds what another one builds, and until it says so
_PATIENCE, _WORD = (
    300.0,
    2.0,
)
_BLOCK = 256  # Warp's block size of a launch without one; on a CPU all are 1
_log = logging.getLogger(__name__)
_building = threading.Lock()
"""Held while one of the `WarpBuffers` lists and builds its kernels; the next then finds those they
share.
"""


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
        capacities = [
            CONTACTS_PER_ENVIRONMENT * batch,
            CONSTRAINTS_PER_ENVIRONMENT,
            substeps * batch,
        ]
        self.limits = np.array(capacities, np.float32)
        """(3,) capacities of contacts and constraint rows, and physics steps of all environments in
        a control step.
        """
        with wp.ScopedDevice(device):
            # A single row would mark the field as shared, and meshes could then never be absent.
            self._model = mujoco_warp.put_model(model, dict.fromkeys(MODEL_LEAVES, max(batch, 2)))
            self._data = mujoco_warp.make_data(
                model,
                batch,
                naconmax=CONTACTS_PER_ENVIRONMENT * batch,
                njmax=CONSTRAINTS_PER_ENVIRONMENT,
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
                np.stack(
                    [
                        model.actuator_gainprm[where.motors, 0],
                        *model.actuator_biasprm[where.motors, 1:3].T,
                    ],
                    -1,
                ),
                dtype=wp.vec3,
            )
        leaves.object_body, leaves.object_dof = where.object_body, where.object_qvel[0]
        leaves.base_body, leaves.table, leaves.anchor = (
            where.base_body,
            where.table_mocap,
            where.anchor_mocap,
        )
        leaves.weld, leaves.table_away = where.weld, TABLE_AWAY[2]
        # The kernels print every overflow; thousands of environments would flood the log.
        self._model.opt.warn_overflow = 0
        self._sensing = self._model.opt.disableflags
        self._blind = self._sensing | mujoco_warp.DisableBit.SENSOR
        self._kernels = concurrent.futures.ThreadPoolExecutor(1, "kernels").submit(
            self._load_kernels
        )
        wp.synchronize_device(device)  # JAX's stream does not wait for Warp's

    def fill(self, objects: Objects, meshes: dict[str, Any]) -> None:
        """Sets the sources of the environments' fields: rows, and the fields of the model with
        their meshes.
        """
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
        """Steps all environments on the current stream; modifies the first three arrays and writes
        the last two.
        """
        self._kernels.result()
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
        """Repeats control steps from the last state with Warp only, and waits for them; for
        benchmarks.
        """
        with wp.ScopedDevice(self._device):
            for _ in range(steps):
                self._launch()
        wp.synchronize_device(self._device)

    def _load_kernels(self) -> None:
        """Builds the kernels of a control step in parallel, or reads them from Warp's cache.

        Launches would do this one after another. Warp compiles without Python's lock.
        """
        with _building:
            with stage("list of the kernels"):
                variants = self._variants()
            with (
                stage("kernels"),
                _one_builder(variants),
                concurrent.futures.ThreadPoolExecutor(cores()) as threads,
            ):
                list(
                    threads.map(
                        lambda variant: wp.force_load(self._device, [variant[0]], variant[1]),
                        variants,
                    )
                )

    def _variants(self) -> list[tuple[wp.Module, int]]:
        """Modules with the kernels of a control step, and their block sizes, the largest modules
        first.

        Only `mujoco_warp.step` knows which kernels a model needs: here its launches are listed and
        not made. It also queries the occupancy of its largest kernels, each of which Warp would
        build for the answer.
        """
        queried, launched = list[tuple[wp.Module, int]](), [(place.module, _BLOCK)]
        me, options, conditional = (
            threading.get_ident(),
            self._model.opt,
            self._model.opt.graph_conditional,
        )
        *launches, query = replaced = wp.launch, wp.launch_tiled, wp.get_suggested_block_size

        def listed(
            launch: Callable[..., None], kernel: wp.Kernel, *given: Any, **named: Any
        ) -> None:
            if threading.get_ident() == me:
                launched.append((kernel.module, named.get("block_dim") or _BLOCK))
            else:
                launch(kernel, *given, **named)

        def suggested(kernel: wp.Kernel, device: Any = None) -> tuple[int, int]:
            if threading.get_ident() != me:
                return query(kernel, device)
            queried.append((kernel.module, kernel.module.options["block_dim"]))
            return 1, 1

        options.graph_conditional = (
            False  # a loop until the solver's kernels have converged would not end
        )
        wp.launch, wp.launch_tiled = (functools.partial(listed, launch) for launch in launches)
        wp.get_suggested_block_size = suggested
        try:
            with wp.ScopedDevice(self._device):
                self._substep_all()
        finally:
            wp.launch, wp.launch_tiled, wp.get_suggested_block_size = replaced
            options.graph_conditional, options.disableflags = conditional, self._sensing
        gpu = self._device.is_cuda
        return list(
            dict.fromkeys((module, size if gpu else 1) for module, size in (*queried, *launched))
        )

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
        model, data = self._model, self._data
        for left in reversed(range(self._substeps)):
            model.opt.disableflags = self._blind if left else self._sensing
            mujoco_warp.step(model, data)
            counts = [
                data.ncollision,
                data.nacon,
                data.nefc,
                data.solver_niter,
                model.opt.iterations,
                self._occupancy,
            ]
            wp.launch(count, data.nworld, counts, device=self._device)


@contextlib.contextmanager
def _one_builder(variants: Sequence[tuple[wp.Module, int]]) -> Iterator[None]:
    """Context that one process of this machine enters first: the others then read from Warp's cache
    what it built.

    They wait for `_PATIENCE` seconds at most, and then build, too.
    """
    names = ",".join(sorted(f"{module.name} {size}" for module, size in variants))
    name = f"builder-{hashlib.sha256(names.encode()).hexdigest()[:16]}"
    path = pathlib.Path(str(wp.config.kernel_cache_dir), name)
    with contextlib.ExitStack() as stack:
        try:
            file = stack.enter_context(open_to_append(path))
            _wait_for_lock(file)
        except (OSError, CongraspError) as error:
            _log.info("Kernels are built without waiting for other processes: %s.", error)
        yield


def _wait_for_lock(file: BinaryIO) -> None:
    """Waits for the lock of the first builder, or that of all others, for `_PATIENCE` seconds."""
    begun = time.monotonic()
    is_reported = False
    shared = False
    while (waited := time.monotonic() - begun) < _PATIENCE:
        if try_lock(file, shared=shared):
            return
        shared = True  # together, once the first is done
        if waited > _WORD and not is_reported:
            is_reported = True
            _log.info(
                "Waiting for the kernels that another process builds, at most %d s.", _PATIENCE
            )
        time.sleep(0.1)


def objects_on(device: wp.Device, rows: dict[str, np.ndarray]) -> Objects:
    """Transfers the rows of a catalogue to a device."""
    objects = Objects()
    for name, dtype in OBJECT_FIELDS.items():
        value = rows[name].reshape(len(rows[name]), -1, 2, 3) if name == "geom_aabb" else rows[name]
        setattr(objects, name, wp.array(value, dtype=dtype, device=device))
    return objects


def meshes_on(device: wp.Device, model: mujoco.MjModel) -> dict[str, Any]:
    """Transfers the mesh fields of a model to a device, by name."""
    values: dict[str, Any] = {
        name: getattr(model, name) for name in ("nmesh", "npolygonmax", "nmeshdegmax")
    }
    for field in dataclasses.fields(mujoco_warp.Model):
        if field.name.startswith("mesh_"):
            kind: Any = field.type
            values[field.name] = wp.array(
                getattr(model, field.name), dtype=kind.dtype, device=device
            )
    return values


_buffers: "weakref.WeakValueDictionary[int, WarpBuffers]" = weakref.WeakValueDictionary()
_handles = itertools.count()


def register(buffers: WarpBuffers) -> int:
    """Registers the buffers; `control_step` finds them by the returned handle while they are
    referenced.
    """
    handle = next(_handles)
    _buffers[handle] = buffers
    return handle


def _control_step(  # noqa: PLR0913
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
    """Target of the JAX call: finds the buffers by their handle and steps them; arrays as in
    `WarpPhysics.step`.
    """
    placed = [table, force, row, mass_scale, friction, gain_scale, base_position, base_quaternion]
    placed += [anchor_position, anchor_quaternion, stationary]
    _buffers[handle].control_step(qpos, qvel, qacc_warmstart, ctrl, placed, sensordata, occupancy)


control_step = jax_callable(
    _control_step,
    num_outputs=5,
    # `WarpBuffers` captures a separate graph: Warp's would use JAX's buffers, and be recaptured
    # wherever those move.
    graph_mode=JaxCallableGraphMode.NONE,
    vmap_method=None,
    in_out_argnames=["qpos", "qvel", "qacc_warmstart"],
)


wp.config.log_level = wp.LOG_WARNING  # no log line for each of some 50 loaded modules


class WarpState(NamedTuple):
    """State on which a control step of a batch of environments depends."""

    qpos: Array
    """(B, nq)."""
    qvel: Array
    """(B, nv)."""
    qacc_warmstart: Array
    """(B, nv) warm start of the solver."""
    reset_state: ResetState
    """Initial states of the episodes; `object_index` is a row of the engine's catalogue."""


_LEAST_SLOTS = 8  # mesh pieces: capacity for objects other than those of the first pool


class WarpPhysics:
    """A batch of environments in MuJoCo Warp.

    The compiled calls refer to objects by row number only. A step therefore costs the same for any
    number of objects, primitives and meshes mixed, and `replace_objects` compiles nothing: neither
    the number of objects nor the size of their meshes is part of a program. No object may have more
    pieces of a kind than there are slots (`PRIMITIVE_SLOTS`, `mesh_slots`).
    """

    name = "warp"
    compiled = True

    def __init__(
        self,
        hand: Hand,
        task: TaskConfig,
        objects: Sequence[GraspObject],
        mesh_slots: int | None = None,
    ):
        """Transfers the objects to the device.

        Args:
          hand: the hand.
          task: timing and collision settings.
          objects: the pool indexed by `ResetState.object_index`.
          mesh_slots: most mesh pieces of an object, 0 for primitives only; by default as many as in
            this pool, at least 8.

        Raises:
          CongraspError: an object has more pieces than slots.
        """
        self._task = task
        if mesh_slots is None:
            most = max(sum(piece.kind == "mesh" for piece in obj.pieces) for obj in objects)
            mesh_slots = max(most, _LEAST_SLOTS)
        self._catalogue = Catalogue(hand, task, objects[0], mesh_slots)
        model = self._catalogue.model
        # Dense Jacobians double the solver's time with elliptic cones.
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
        model.opt.tolerance = 1e-5  # single precision does not reach the default
        self._where = addresses(model, hand)
        self._sensors = len(hand.links) * CONTACTS_PER_LINK * SENSOR_WIDTH
        device = jax.local_devices()[0]
        self._device = wp.get_device(
            "cpu" if device.platform == "cpu" else f"cuda:{device.local_hardware_id}"
        )
        self._buffers: dict[int, tuple[int, WarpBuffers]] = {}
        self._load(objects)

    def start(self, reset_state: ResetState) -> WarpState:
        """Starts environments; see `Physics.start`."""
        batch = reset_state.object_index.shape[0]
        if batch not in self._buffers:
            buffers = self._allocated(batch)
            buffers.fill(*self._loaded)
            self._buffers[batch] = register(buffers), buffers
        return self._fresh(reset_state)

    def reset(self, state: WarpState, mask: Array, reset_state: ResetState) -> WarpState:
        """Restarts the masked environments; see `Physics.reset`."""
        return where_environments(mask, self._fresh(reset_state), state)

    def step(
        self, state: WarpState, target: Array, table: Array, force: Array | None = None
    ) -> tuple[WarpState, PhysicsState]:
        """Simulates one control step; see `Physics.step`."""
        reset_state, batch = state.reset_state, state.qpos.shape[0]
        force = jnp.zeros((batch, 3)) if force is None else force.astype(jnp.float32)
        handle, buffers = self._buffers[batch]
        qpos, qvel, warmstart, sensors, counts = control_step(
            handle,
            state.qpos,
            state.qvel,
            state.qacc_warmstart,
            target.astype(jnp.float32),
            table,
            force,
            reset_state.object_index,
            reset_state.mass_scale,
            reset_state.friction,
            reset_state.gain_scale,
            reset_state.base_position,
            reset_state.base_quaternion,
            reset_state.object_position,
            reset_state.object_quaternion,
            reset_state.stationary,
            output_dims={"sensordata": (batch, self._sensors), "occupancy": (3,)},
        )
        diverged = has_diverged(jnp, qpos, qvel)
        moved = WarpState(qpos, qvel, warmstart, reset_state)
        state = where_environments(diverged, self._fresh(reset_state), moved)
        sensors = jnp.where(diverged[:, None], 0.0, sensors)
        occupancy = counts / buffers.limits
        return state, physics_state(
            jnp, self._where, state.qpos, state.qvel, sensors, diverged, occupancy
        )

    def replace_objects(self, state: WarpState, objects: Sequence[GraspObject]) -> WarpState:
        """Replaces the objects for environments that restart from now on; must not be traced.

        Objects of continuing episodes are kept after the new ones until the next call. Waits for
        the step that produced `state`; no other may be in progress, and no other state is valid
        afterwards.

        Args:
          state: current state of the environments.
          objects: the new pool, of any size.

        Raises:
          CongraspError: an object has more pieces than slots.
        """
        index = np.asarray(jax.block_until_ready(state).reset_state.object_index)
        used, index = np.unique(index, return_inverse=True)
        going = [self._objects[row] for row in used]
        self._load([*objects, *going])
        moved = jnp.asarray(len(objects) + index, jnp.int32)
        return state._replace(reset_state=state.reset_state._replace(object_index=moved))

    def read(self, state: WarpState) -> PhysicsState:
        """Returns the current state of the environments, without contacts; see `Physics.read`."""
        batch = state.qpos.shape[0]
        none = jnp.zeros((batch, self._sensors))
        return physics_state(
            jnp, self._where, state.qpos, state.qvel, none, jnp.zeros(batch, bool), jnp.zeros(3)
        )

    def repeat(self, batch: int, steps: int) -> None:
        """Repeats control steps of a batch from its last state and targets; no state observes them.

        Runs only MuJoCo Warp's kernels, without JAX, as a reference for benchmarks.
        """
        self._buffers[batch][1].repeat(steps)

    def close(self) -> None:
        """Releases the memory of the environments."""
        self._buffers.clear()

    def _allocated(self, batch: int) -> WarpBuffers:
        """Returns buffers of a batch, without objects, and begins to build their kernels."""
        model, geoms = self._catalogue.model, self._catalogue.geoms
        return WarpBuffers(model, self._where, geoms, self._task.substeps, batch, self._device)

    def _load(self, objects: Sequence[GraspObject]) -> None:
        """Transfers objects to the device, and points every batch's buffers to them."""
        rows, meshes = self._catalogue.rows(objects)
        self._objects = objects
        self._loaded = objects_on(self._device, rows), meshes_on(self._device, meshes)
        wp.synchronize_device(self._device)  # JAX's stream does not wait for Warp's
        for _, buffers in self._buffers.values():
            buffers.fill(*self._loaded)

    def _fresh(self, reset_state: ResetState) -> WarpState:
        """Returns the state of environments that start now, with the types that the compiled calls
        expect.
        """
        index, stationary = (
            jnp.asarray(reset_state.object_index, jnp.int32),
            jnp.asarray(reset_state.stationary, bool),
        )
        reset_state = ResetState(*(jnp.asarray(leaf, jnp.float32) for leaf in reset_state))
        reset_state = reset_state._replace(object_index=index, stationary=stationary)
        model = self._catalogue.model
        qpos, qvel = (
            initial_qpos(self._where, model.nq, reset_state),
            initial_qvel(self._where, model.nv, reset_state),
        )
        return WarpState(qpos, qvel, jnp.zeros_like(qvel), reset_state)


def begin_kernels(hand: Hand, task: TaskConfig) -> None:
    """Begins to build the kernels of a hand and a task in the background.

    Objects do not change them, and the number of environments only changes the broadphase.
    """
    WarpPhysics(hand, task, [procedural.generate(0, "box")])._allocated(1)
