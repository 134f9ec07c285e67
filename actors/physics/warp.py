"""MuJoCo Warp, called once per control step: NVIDIA kernels with different objects and meshes in each environment.

The kernels are those shipped with mujoco-mjx (`mujoco.mjx.third_party.mujoco_warp`); they also run on a CPU, for tests.
The state is a small pytree and every call can be traced, so that a whole rollout compiles into one program.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import warp as wp

from congrasp.actors.physics.engine import (
    PhysicsState,
    ResetState,
    has_diverged,
    initial_qpos,
    initial_qvel,
    physics_state,
    where_environments,
)
from congrasp.actors.physics.scene import SENSOR_WIDTH, addresses
from congrasp.actors.physics.slots import Catalogue
from congrasp.actors.physics.warp_buffers import WarpBuffers, control_step, meshes_on, objects_on, register
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.types import CONTACTS_PER_LINK, Array

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

    The compiled calls refer to objects by row number only. A step therefore costs the same for any number of objects,
    primitives and meshes mixed, and `replace_objects` compiles nothing: neither the number of objects nor the size of
    their meshes is part of a program. No object may have more pieces of a kind than there are slots (`PRIMITIVE_SLOTS`,
    `mesh_slots`).
    """

    name = "warp"
    compiled = True

    def __init__(self, hand: Hand, task: TaskConfig, objects: Sequence[GraspObject], mesh_slots: int | None = None):
        """Transfers the objects to the device.

        Args:
          hand: the hand.
          task: timing and collision settings.
          objects: the pool indexed by `ResetState.object_index`.
          mesh_slots: most mesh pieces of an object, 0 for primitives only; by default as many as in this pool, at
            least 8.

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
        self._device = wp.get_device("cpu" if device.platform == "cpu" else f"cuda:{device.local_hardware_id}")
        self._buffers: dict[int, tuple[int, WarpBuffers]] = {}
        self._load(objects)

    def start(self, reset_state: ResetState) -> WarpState:
        """Starts environments; see `Physics.start`."""
        batch = reset_state.object_index.shape[0]
        if batch not in self._buffers:
            model, geoms = self._catalogue.model, self._catalogue.geoms
            buffers = WarpBuffers(model, self._where, geoms, self._task.substeps, batch, self._device)
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
        return state, physics_state(jnp, self._where, state.qpos, state.qvel, sensors, diverged, occupancy)

    def replace_objects(self, state: WarpState, objects: Sequence[GraspObject]) -> WarpState:
        """Replaces the objects for environments that restart from now on; must not be traced.

        Objects of continuing episodes are kept after the new ones until the next call. Waits for the step that produced
        `state`; no other may be in progress, and no other state is valid afterwards.

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
        return physics_state(jnp, self._where, state.qpos, state.qvel, none, jnp.zeros(batch, bool), jnp.zeros(3))

    def repeat(self, batch: int, steps: int) -> None:
        """Repeats control steps of a batch from its last state and targets; no state observes them.

        Runs only MuJoCo Warp's kernels, without JAX, as a reference for benchmarks.
        """
        self._buffers[batch][1].repeat(steps)

    def close(self) -> None:
        """Releases the memory of the environments."""
        self._buffers.clear()

    def _load(self, objects: Sequence[GraspObject]) -> None:
        """Transfers objects to the device, and points every batch's buffers to them."""
        rows, meshes = self._catalogue.rows(objects)
        self._objects = objects
        self._loaded = objects_on(self._device, rows), meshes_on(self._device, meshes)
        wp.synchronize_device(self._device)  # JAX's stream does not wait for Warp's
        for _, buffers in self._buffers.values():
            buffers.fill(*self._loaded)

    def _fresh(self, reset_state: ResetState) -> WarpState:
        """Returns the state of environments that start now, with the types that the compiled calls expect."""
        index, stationary = jnp.asarray(reset_state.object_index, jnp.int32), jnp.asarray(reset_state.stationary, bool)
        reset_state = ResetState(*(jnp.asarray(leaf, jnp.float32) for leaf in reset_state))
        reset_state = reset_state._replace(object_index=index, stationary=stationary)
        model = self._catalogue.model
        qpos, qvel = (
            initial_qpos(self._where, model.nq, reset_state),
            initial_qvel(self._where, model.nv, reset_state),
        )
        return WarpState(qpos, qvel, jnp.zeros_like(qvel), reset_state)
