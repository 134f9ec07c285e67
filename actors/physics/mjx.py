"""MJX in JAX, which XLA compiles for any device.

The state is a pytree and every call can be traced, so that a whole rollout compiles into one
program.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from congrasp.actors.physics.engine import (
    PhysicsState,
    ResetState,
    has_diverged,
    initial_qpos,
    initial_qvel,
    physics_state,
    where_environments,
)
from congrasp.actors.physics.pooled_model import PooledModel
from congrasp.actors.physics.scene import GAINS, MASS_POWERS, SENSOR_WIDTH, TABLE_AWAY, addresses
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.mjcf import CONTACT
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.physics_library import mujoco
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.types import CONTACTS_PER_LINK, Array

_PER_ENVIRONMENT = ("body_pos", "body_quat", "geom_friction", *GAINS)
"""Fields of the model that differ between environments with the same object."""
_RESET_DATA = (
    "qpos",
    "qvel",
    "ctrl",
    "qacc_warmstart",
    "mocap_pos",
    "mocap_quat",
    "eq_active",
    "time",
)
"""Fields of `mjx.Data` that a restart replaces."""


class MjxState(NamedTuple):
    """A batch of environments and its pool of objects."""

    data: Any
    """Batched `mjx.Data`."""
    leaves: dict[str, Array]
    """Fields of the model of each environment (B, ...)."""
    qpos_start: Array
    """(B, nq) initial positions, to which a diverged environment is reset."""
    pool: dict[str, Array]
    """Fields of the model for each object (N, ...); see `actors.physics.pooled_model.LEAVES`."""


class MjxPhysics:
    """A batch of environments in MJX."""

    name = "jax"
    compiled = True

    def __init__(self, hand: Hand, task: TaskConfig, objects: Sequence[GraspObject]):
        """Transfers the pool's model to the device.

        Args:
          hand: the hand.
          task: timing and collision settings.
          objects: the pool indexed by `ResetState.object_index`.

        Raises:
          CongraspError: the hand has collision shapes other than capsules, for which MJX lacks some
            pairs.
        """
        if any(link.solids for link in hand.links):
            raise CongraspError(
                f"The engine jax supports capsules only, but '{hand.name}' has solids.",
                "Use native or warp, or import a custom hand without --collision own.",
            )
        self._task = task
        self._pool = PooledModel(hand, task, objects)
        model = self._pool.model
        self._where = addresses(model, hand)
        self._links = np.array([model.body(link.name).id for link in hand.links])
        # MJX has no elliptic cones without friction: links get the hand's sliding friction, a
        # tenth.
        model.geom_condim[:] = CONTACT.condim
        # MJX has no contact sensor between bodies; contacts are read from the contact list instead.
        model.sensor_type[:] = mujoco.mjtSensor.mjSENS_CLOCK
        model.sensor_objtype[:] = mujoco.mjtObj.mjOBJ_UNKNOWN
        self._host_model = model
        self._body_of_geom = np.array(model.geom_bodyid)
        self._geoms = np.flatnonzero(model.geom_bodyid == self._where.object_body)
        self._device = jax.local_devices()[0]  # by default MJX uses the first device of all ranks
        self._model = mjx.put_model(model, device=self._device, impl="jax")
        self._objects = self._leaves(objects)
        self._shared = {}
        for name in _PER_ENVIRONMENT:
            self._shared[name] = jnp.asarray(getattr(model, name), jnp.float32)
        axes = dict.fromkeys([*self._objects, *self._shared], 0)
        self._axes = jax.tree.map(lambda _: None, self._model).replace(**axes)

    def start(self, reset_state: ResetState) -> MjxState:
        """Starts environments; see `Physics.start`."""
        batch = reset_state.object_index.shape[0]
        data = mjx.make_data(self._host_model, device=self._device, impl="jax")
        data = jax.vmap(lambda q: data.replace(qpos=q))(jnp.zeros((batch, self._host_model.nq)))
        return self._place(data, self._objects, reset_state)

    def replace_objects(self, state: MjxState, objects: Sequence[GraspObject]) -> MjxState:
        """Replaces the objects by as many others without meshes, for episodes that start from now
        on.
        """
        return state._replace(pool=self._leaves(objects))

    def reset(self, state: MjxState, mask: Array, reset_state: ResetState) -> MjxState:
        """Restarts the masked environments; see `Physics.reset`."""
        fresh = self._place(state.data, state.pool, reset_state)
        started = {name: getattr(fresh.data, name) for name in _RESET_DATA}
        continuing = {name: getattr(state.data, name) for name in _RESET_DATA}
        data = state.data.replace(**where_environments(mask, started, continuing))
        return MjxState(
            data=data,
            leaves=where_environments(mask, fresh.leaves, state.leaves),
            qpos_start=where_environments(mask, fresh.qpos_start, state.qpos_start),
            pool=state.pool,
        )

    def step(
        self, state: MjxState, target: Array, table: Array, force: Array | None = None
    ) -> tuple[MjxState, PhysicsState]:
        """Simulates one control step; see `Physics.step`."""
        where = self._where
        height = jnp.where(table, 0.0, TABLE_AWAY[2])
        data = state.data.replace(
            ctrl=target, mocap_pos=state.data.mocap_pos.at[:, where.table_mocap, 2].set(height)
        )
        if force is not None:
            data = data.replace(
                xfrc_applied=data.xfrc_applied.at[:, where.object_body, :3].set(force)
            )

        model = self._model.replace(**state.leaves)

        def substep(data: Any, _: None) -> tuple[Any, None]:
            return jax.vmap(mjx.step, in_axes=(self._axes, 0))(model, data), None

        data, _ = jax.lax.scan(substep, data, None, length=self._task.substeps)
        diverged = has_diverged(jnp, data.qpos, data.qvel)[:, None]
        data = data.replace(
            qpos=jnp.where(diverged, state.qpos_start, data.qpos),
            qvel=jnp.where(diverged, 0.0, data.qvel),
            qacc_warmstart=jnp.where(diverged, 0.0, data.qacc_warmstart),
        )
        sensors = jnp.where(diverged, 0.0, self._contacts(data))
        moved = physics_state(
            jnp, where, data.qpos, data.qvel, sensors, diverged[:, 0], jnp.zeros(3)
        )
        return state._replace(data=data), moved

    def read(self, state: MjxState) -> PhysicsState:
        """Returns the current state of the environments, without contacts; see `Physics.read`."""
        data = state.data
        batch = data.qpos.shape[0]
        none = jnp.zeros((batch, len(self._links) * CONTACTS_PER_LINK * SENSOR_WIDTH))
        return physics_state(
            jnp, self._where, data.qpos, data.qvel, none, jnp.zeros(batch, bool), jnp.zeros(3)
        )

    def close(self) -> None:
        """Does nothing: there is nothing to release."""

    def _leaves(self, objects: Sequence[GraspObject]) -> dict[str, Array]:
        """Fields (N, ...) of the model for each object, on the device."""
        leaves = {}
        for name, value in self._pool.leaves(objects).items():
            shape = (len(objects), *getattr(self._model, name).shape)
            leaves[name] = jnp.asarray(value, jnp.float32).reshape(shape)
        return leaves

    def _place(self, data: Any, pool: dict[str, Array], reset_state: ResetState) -> MjxState:
        """Places environments at their start, with the fields of their objects from the rows `pool`
        (N, ...).
        """
        where = self._where
        model = self._host_model
        batch = reset_state.object_index.shape[0]
        qpos = initial_qpos(where, model.nq, reset_state)
        mocap_pos = data.mocap_pos.at[:, where.table_mocap].set(0.0)
        stationary = reset_state.stationary.astype(data.eq_active.dtype)
        data = data.replace(
            qpos=qpos,
            qvel=initial_qvel(where, model.nv, reset_state),
            ctrl=jnp.zeros((batch, model.nu)),
            qacc_warmstart=jnp.zeros((batch, model.nv)),
            mocap_pos=mocap_pos.at[:, where.anchor_mocap].set(reset_state.object_position),
            mocap_quat=data.mocap_quat.at[:, where.anchor_mocap].set(reset_state.object_quaternion),
            eq_active=data.eq_active.at[:, where.weld].set(stationary),
        )
        return MjxState(data, self._model_leaves(pool, reset_state), qpos, pool)

    def _model_leaves(self, pool: dict[str, Array], reset_state: ResetState) -> dict[str, Array]:
        """Fields (B, ...) of the model of environments that start, see `_place`."""
        where = self._where
        batch = reset_state.object_index.shape[0]
        leaves = {name: value[reset_state.object_index] for name, value in pool.items()}
        for name, power in MASS_POWERS.items():
            leaf = leaves[name]
            rows = where.object_qvel if name.startswith("dof") else np.array([where.object_body])
            factor = reset_state.mass_scale.reshape(-1, *[1] * (leaf.ndim - 1)) ** power
            leaves[name] = leaf.at[:, rows].multiply(factor)

        def tiled(name: str) -> Array:
            """A shared field, once for each environment."""
            value = self._shared[name]
            return jnp.tile(value, (batch, *([1] * value.ndim)))

        position = tiled("body_pos").at[:, where.base_body]
        leaves["body_pos"] = position.set(reset_state.base_position)
        quaternion = tiled("body_quat").at[:, where.base_body]
        leaves["body_quat"] = quaternion.set(reset_state.base_quaternion)
        friction = tiled("geom_friction").at[:, self._geoms, 0]
        leaves["geom_friction"] = friction.set(reset_state.friction[:, None])
        for name in GAINS:
            gains = tiled(name).at[:, where.motors]
            leaves[name] = gains.multiply(reset_state.gain_scale[:, None, None])
        return leaves

    def _contacts(self, data: Any) -> Array:
        """Contacts (B, L * C * 13) in the layout of the contact sensors."""
        strongest = functools.partial(
            _strongest_contacts, self._body_of_geom, self._links, self._where.object_body
        )
        return jax.vmap(strongest)(data)


def _strongest_contacts(
    body_of_geom: np.ndarray, links: np.ndarray, object_body: int, data: Any
) -> Array:
    """Values of the contact sensors from MJX-JAX's contact list, for one environment."""
    contact = data._impl.contact
    body = jnp.asarray(body_of_geom)[contact.geom]
    index = np.asarray(contact.efc_address)
    # An elliptic contact of dimension 3 has a row for the normal and one for each tangent.
    force = jnp.where(
        (index >= 0)[:, None], data._impl.efc_force[index[:, None] + np.arange(3)], 0.0
    )
    # Normals point from the first geom to the second; the sensors need them from the link to the
    # object.
    sign = jnp.where(body[:, 1] == object_body, 1.0, -1.0)[:, None]
    found = (contact.dist < contact.includemargin).astype(jnp.float32)[:, None]
    local = jnp.concatenate([force[:, :2], force[:, 2:] * sign], -1)
    axes = contact.frame
    values = jnp.concatenate([found, local, contact.pos, axes[:, 0] * sign, axes[:, 1] * sign], -1)
    strength = jnp.where(found[:, 0] > 0, jnp.linalg.norm(force, axis=-1), -1.0)
    touches_object = jnp.any(body == object_body, -1)
    is_of_link = touches_object & jnp.any(body == links[:, None, None], -1)
    best_strength, best = jax.lax.top_k(jnp.where(is_of_link, strength, -1.0), CONTACTS_PER_LINK)
    return jnp.where(best_strength[..., None] >= 0, values[best], 0.0).reshape(-1)
