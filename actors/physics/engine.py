"""Interface of physics engines: a batch of environments with one hand and one object each.

`warp` and `jax` are pure functions over pytrees that are traced into a compiled rollout; `native`
steps MuJoCo C on threads and `physx` PhysX in processes, and they mutate their state. All use the
same three calls.
"""

import types
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.actors.physics.scene import SENSOR_WIDTH, Addresses
from congrasp.common.objects.spec import GraspObject
from congrasp.common.ranges import MAX_DISTANCE, MAX_SPEED
from congrasp.common.task.types import CONTACTS_PER_LINK, Array


class ResetState(NamedTuple):
    """Initial state of episodes for a batch of B environments; world frame."""

    object_index: Array
    """(B,) int, index into the engine's objects."""
    mass_scale: Array
    """(B,) factor on the object's mass and inertia."""
    friction: Array
    """(B,) sliding friction of the object's geoms."""
    gain_scale: Array
    """(B,) factor on both gains of the finger motors' servos; their torque limits are unchanged."""
    base_position: Array
    """(B, 3) initial wrist position, where the wrist joints are zero."""
    base_quaternion: Array
    """(B, 4)."""
    u_velocity: Array
    """(B, 6) initial velocity of the wrist joints, m/s and rad/s."""
    q: Array
    """(B, F) initial finger angles."""
    object_position: Array
    """(B, 3) resting position of the object's centre of mass."""
    object_quaternion: Array
    """(B, 4)."""
    stationary: Array
    """(B,) bool: the object is welded to its position."""


class PhysicsState(NamedTuple):
    """State of the environments after a control step; see `common.task.types.SceneState` for shapes
    and frames.
    """

    q: Array
    u: Array
    q_velocity: Array
    u_velocity: Array
    object_position: Array
    object_quaternion: Array
    object_velocity: Array
    object_angular_velocity: Array
    contact_force: Array
    contact_position: Array
    contact_found: Array
    diverged: Array
    """(B,) bool: the environment diverged in this step (`has_diverged`) and was reset to its
    start.
    """
    occupancy: Array
    """(3,) contacts and constraint rows in the step's fullest substep, as shares of the engine's
    capacity: the excess over 1 was dropped from the simulation. Zero for an engine that allocates
    as needed. Third, share of physics steps whose solver reached its limit of iterations: of all on
    `warp`, of each control step's last on `native`; zero on `jax`, which does not report it."""


class Physics(Protocol):
    """A batch of environments. `state` is a pytree for compiled engines and an opaque handle for
    `native`.
    """

    name: str
    compiled: bool
    """True if JAX can trace the calls."""

    def start(self, reset_state: ResetState) -> Any:
        """Returns the state of environments at the start of their episodes."""

    def reset(self, state: Any, mask: Array, reset_state: ResetState) -> Any:
        """Restarts environments where mask (B,) is true from `reset_state`; the others continue."""

    def step(
        self, state: Any, target: Array, table: Array, force: Array | None = None
    ) -> tuple[Any, PhysicsState]:
        """Simulates one control step.

        Args:
          state: the environments.
          target: (B, 6 + M) targets of the wrist's joints and of the fingers' motors.
          table: (B,) bool, True where the table is present.
          force: (B, 3) force on the object's centre of mass throughout the step, world frame, N;
            none by default.
        """

    def replace_objects(self, state: Any, objects: Sequence[GraspObject]) -> Any:
        """Replaces the objects by as many others for environments that restart later; current
        episodes continue.
        """

    def read(self, state: Any) -> PhysicsState:
        """Returns the current state of the environments, without contacts after a reset."""

    def close(self) -> None:
        """Releases threads and memory; may be called twice."""


def host_arrays(reset_state: ResetState) -> ResetState:
    """Reset states as NumPy arrays, for an engine that steps on the CPU."""
    return ResetState(*(np.asarray(leaf) for leaf in reset_state))


def where_environments(mask: Array, new: Any, old: Any) -> Any:
    """Selects arrays (B, ...) of `new` in the masked environments (B,), those of `old` elsewhere,
    for any pytree.
    """

    def pick(a: Array, b: Array) -> Array:
        return jnp.where(mask.reshape(-1, *([1] * (a.ndim - 1))), a, b)

    return jax.tree.map(pick, new, old)


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
    xp: Any,
    where: Addresses,
    qpos: Array,
    qvel: Array,
    sensordata: Array,
    diverged: Array,
    occupancy: Array,
) -> PhysicsState:
    """Physics state of raw arrays (B, nq), (B, nv), (B, L * C * 13).

    Args:
      xp: numpy or jax.numpy.
      where: indices of the compiled scene.
      qpos: generalised positions.
      qvel: generalised velocities; the free joint's angular part is converted from the object frame
        to the world frame.
      sensordata: contact sensors of all links, strongest contacts first.
      diverged: (B,) bool, returned unchanged.
      occupancy: (3,), returned unchanged.
    """
    batch = qpos.shape[0]
    contacts = sensordata.reshape(batch, -1, CONTACTS_PER_LINK, SENSOR_WIDTH)
    found = contacts[..., 0] > 0
    local = contacts[..., 1:4]
    normal = contacts[..., 7:10]
    tangent = contacts[..., 10:13]
    # MuJoCo gives the force of the first body (the link) on the second (the object), in the contact
    # frame.
    on_object = (
        normal * local[..., 0:1]
        + tangent * local[..., 1:2]
        + xp.cross(normal, tangent) * local[..., 2:3]
    )
    object_qpos = qpos[:, where.object_qpos]
    object_qvel = qvel[:, where.object_qvel]
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
