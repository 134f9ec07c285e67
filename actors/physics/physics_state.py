"""Conversions from a `ResetState` to raw `qpos`, and from raw arrays to a `PhysicsState`; NumPy or JAX."""

import types
from typing import Any

import jax.numpy as jnp

from congrasp.actors.physics.engine import PhysicsState, ResetState
from congrasp.actors.physics.scene import SENSOR_WIDTH, Addresses
from congrasp.common.ranges import MAX_DISTANCE, MAX_SPEED
from congrasp.common.task.types import CONTACTS_PER_LINK, Array


def initial_qpos(where: Addresses, nq: int, reset_state: ResetState) -> Array:
    """Initial qpos (B, nq) as a JAX array; the wrist joints are zero."""
    qpos = jnp.zeros((len(reset_state.q), nq))
    qpos = qpos.at[:, where.finger_qpos].set(reset_state.q)
    return qpos.at[:, where.object_qpos].set(
        jnp.concatenate([reset_state.object_position, reset_state.object_quaternion], -1)
    )


def initial_qvel(where: Addresses, nv: int, reset_state: ResetState) -> Array:
    """Initial qvel (B, nv) as a JAX array; only the wrist moves."""
    return jnp.zeros((len(reset_state.q), nv)).at[:, where.wrist_qvel].set(reset_state.u_velocity)


def has_diverged(xp: types.ModuleType, qpos: Array, qvel: Array) -> Array:
    """(B,) bool: environments with values that are not finite, too fast or too far away."""
    # Comparisons with NaN are false, so that NaN also fails them.
    return ~(xp.all(xp.abs(qvel) < MAX_SPEED, -1) & xp.all(xp.abs(qpos) < MAX_DISTANCE, -1))


def physics_state(
    xp: Any, where: Addresses, qpos: Array, qvel: Array, sensordata: Array, diverged: Array, occupancy: Array
) -> PhysicsState:
    """Physics state of raw arrays (B, nq), (B, nv), (B, L * C * 13).

    Args:
      xp: numpy or jax.numpy.
      where: indices of the compiled scene.
      qpos: generalised positions.
      qvel: generalised velocities; the free joint's angular part is converted from the object frame to the world frame.
      sensordata: contact sensors of all links, strongest contacts first.
      diverged: (B,) bool, returned unchanged.
      occupancy: (3,), returned unchanged.
    """
    batch = qpos.shape[0]
    contacts = sensordata.reshape(batch, -1, CONTACTS_PER_LINK, SENSOR_WIDTH)
    found = contacts[..., 0] > 0
    local, normal, tangent = contacts[..., 1:4], contacts[..., 7:10], contacts[..., 10:13]
    # MuJoCo gives the force of the first body (the link) on the second (the object), in the contact frame.
    on_object = normal * local[..., 0:1] + tangent * local[..., 1:2] + xp.cross(normal, tangent) * local[..., 2:3]
    object_qpos, object_qvel = qpos[:, where.object_qpos], qvel[:, where.object_qvel]
    quaternion = object_qpos[:, 3:] / xp.linalg.norm(object_qpos[:, 3:], axis=-1, keepdims=True)
    angular = object_qvel[:, 3:]
    axis = quaternion[:, 1:]
    twice = 2.0 * xp.cross(axis, angular)
    return PhysicsState(
        q=qpos[:, where.finger_qpos],
        u=qpos[:, where.wrist_qpos],
        q_velocity=qvel[:, where.finger_qvel],
        u_velocity=qvel[:, where.wrist_qvel],
        object_position=object_qpos[:, :3],
        object_quaternion=quaternion,
        object_velocity=object_qvel[:, :3],
        object_angular_velocity=angular + quaternion[:, :1] * twice + xp.cross(axis, twice),
        contact_force=xp.where(found[..., None], -on_object, 0.0),
        contact_position=contacts[..., 4:7],
        contact_found=found,
        diverged=diverged,
        occupancy=occupancy,
    )
