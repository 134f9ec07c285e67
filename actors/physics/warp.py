"""MuJoCo Warp, called once per control step: NVIDIA kernels with different objects and meshes in
each environment.

The kernels are those shipped with mujoco-mjx (`mujoco.mjx.third_party.mujoco_warp`); they also run
on a CPU, for tests. The state is a small pytree and every call can be traced, so that a whole
rollout compiles into one program.

`control_step` is the interface to JAX: a pure function of small arrays. Model and data stay in
buffers allocated once per batch (`actors.physics.warp_buffers`), so that their addresses never
change and one CUDA graph of a control step serves every program that calls it, wherever JAX places
its arrays.
"""

import dataclasses
import itertools
import weakref
from collections.abc import Sequence
from typing import Any, NamedTuple

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
from congrasp.actors.physics.object_rows import ObjectRows
from congrasp.actors.physics.scene import SENSOR_WIDTH, addresses
from congrasp.actors.physics.slots import mesh_count
from congrasp.actors.physics.warp_buffers import WarpBuffers
from congrasp.actors.physics.warp_kernels import OBJECT_FIELDS, ObjectFields
from congrasp.common.hands.spec import Hand
from congrasp.common.objects import procedural
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.physics_library import mujoco
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.types import CONTACTS_PER_LINK, Array

wp.config.log_level = wp.LOG_WARNING  # no log line for each of some 50 loaded modules

_LEAST_MESH_SLOTS = 8
"""Mesh pieces: capacity for objects other than those of the first pool."""
_SOLVER_TOLERANCE = 1e-5
"""Single precision does not reach MuJoCo's default."""
_buffers: "weakref.WeakValueDictionary[int, WarpBuffers]" = weakref.WeakValueDictionary()
_handles = itertools.count()


def objects_on(device: wp.Device, rows: dict[str, np.ndarray]) -> ObjectFields:
    """Transfers rows of objects to a device."""
    objects = ObjectFields()
    for name, dtype in OBJECT_FIELDS.items():
        value = rows[name]
        if name == "geom_aabb":
            value = value.reshape(len(value), -1, 2, 3)
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


class WarpState(NamedTuple):
    """State on which a control step of a batch of environments depends."""

    qpos: Array
    """(B, nq)."""
    qvel: Array
    """(B, nv)."""
    qacc_warmstart: Array
    """(B, nv) warm start of the solver."""
    reset_state: ResetState
    """Initial states of the episodes; `object_index` is a row of the engine's objects."""


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
            mesh_slots = max(_LEAST_MESH_SLOTS, *map(mesh_count, objects))
        self._object_rows = ObjectRows(hand, task, objects[0], mesh_slots)
        model = self._object_rows.model
        # Dense Jacobians double the solver's time with elliptic cones.
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
        model.opt.tolerance = _SOLVER_TOLERANCE
        self._where = addresses(model, hand)
        self._sensors = len(hand.links) * CONTACTS_PER_LINK * SENSOR_WIDTH
        device = jax.local_devices()[0]
        name = "cpu" if device.platform == "cpu" else f"cuda:{device.local_hardware_id}"
        self._device = wp.get_device(name)
        self._buffers: dict[int, tuple[int, WarpBuffers]] = {}
        self._load(objects)

    def start(self, reset_state: ResetState) -> WarpState:
        """Starts environments; see `Physics.start`."""
        batch = reset_state.object_index.shape[0]
        if batch not in self._buffers:
            buffers = self.allocate(batch)
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
        reset_state = state.reset_state
        batch = state.qpos.shape[0]
        if force is None:
            force = jnp.zeros((batch, 3))
        handle, buffers = self._buffers[batch]
        qpos, qvel, warmstart, sensors, counts = control_step(
            handle,
            state.qpos,
            state.qvel,
            state.qacc_warmstart,
            target.astype(jnp.float32),
            table,
            force.astype(jnp.float32),
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
        continuing = [self._objects[row] for row in used]
        self._load([*objects, *continuing])
        moved = jnp.asarray(len(objects) + index, jnp.int32)
        return state._replace(reset_state=state.reset_state._replace(object_index=moved))

    def read(self, state: WarpState) -> PhysicsState:
        """Returns the current state of the environments, without contacts; see `Physics.read`."""
        batch = state.qpos.shape[0]
        none = jnp.zeros((batch, self._sensors))
        return physics_state(
            jnp, self._where, state.qpos, state.qvel, none, jnp.zeros(batch, bool), jnp.zeros(3)
        )

    def buffers(self, batch: int) -> WarpBuffers:
        """Returns the buffers of a batch of environments that was started."""
        _, buffers = self._buffers[batch]
        return buffers

    def repeat(self, batch: int, steps: int) -> None:
        """Repeats control steps of a batch from its last state and targets; no state observes them.

        Runs only MuJoCo Warp's kernels, without JAX, as a reference for benchmarks.
        """
        self.buffers(batch).repeat(steps)

    def close(self) -> None:
        """Releases the memory of the environments."""
        self._buffers.clear()

    def allocate(self, batch: int) -> WarpBuffers:
        """Returns buffers of a batch, without objects, and begins to build their kernels."""
        return WarpBuffers(
            self._object_rows.model,
            self._where,
            self._object_rows.geoms,
            self._task.substeps,
            batch,
            self._device,
        )

    def _load(self, objects: Sequence[GraspObject]) -> None:
        """Transfers objects to the device, and points every batch's buffers to them."""
        rows, meshes = self._object_rows.rows(objects)
        self._objects = objects
        self._loaded = objects_on(self._device, rows), meshes_on(self._device, meshes)
        wp.synchronize_device(self._device)  # JAX's stream does not wait for Warp's
        for _, buffers in self._buffers.values():
            buffers.fill(*self._loaded)

    def _fresh(self, reset_state: ResetState) -> WarpState:
        """Returns the state of environments that start now, with the types that the compiled calls
        expect.
        """
        index = jnp.asarray(reset_state.object_index, jnp.int32)
        stationary = jnp.asarray(reset_state.stationary, bool)
        reset_state = ResetState(*(jnp.asarray(leaf, jnp.float32) for leaf in reset_state))
        reset_state = reset_state._replace(object_index=index, stationary=stationary)
        model = self._object_rows.model
        qvel = initial_qvel(self._where, model.nv, reset_state)
        return WarpState(
            qpos=initial_qpos(self._where, model.nq, reset_state),
            qvel=qvel,
            qacc_warmstart=jnp.zeros_like(qvel),
            reset_state=reset_state,
        )


def begin_kernels(hand: Hand, task: TaskConfig) -> None:
    """Begins to build the kernels of a hand and a task in the background.

    Objects do not change them, and the number of environments only changes the broadphase.
    """
    WarpPhysics(hand, task, [procedural.generate(0, "box")]).allocate(1)
