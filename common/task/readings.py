"""Readings of a robot in the last control steps: joint encoders, targets, and the object's shown
pose.
"""

from typing import NamedTuple

from congrasp.common.runtime.lazy_jax import jnp
from congrasp.common.task.types import Array, SceneState


class Readings(NamedTuple):
    """Readings of sensors and controller in the last H control steps, newest first; fields as in
    `SceneState`.
    """

    q: Array
    """(B, H, F)."""
    u: Array
    """(B, H, 6)."""
    q_target: Array
    """(B, H, F)."""
    u_target: Array
    """(B, H, 6)."""
    object_position: Array
    """(B, H, 3) as shown by the sensor."""
    object_quaternion: Array
    """(B, H, 4)."""


def still(reading: Readings, steps: int) -> Readings:
    """Readings at the start of an episode: the same (B, ...) in all H `steps`."""
    return Readings(*[jnp.repeat(field[:, None], steps, 1) for field in reading])


def push(readings: Readings, newest: Readings) -> Readings:
    """Prepends the newest readings (B, ...) and drops the oldest."""
    fields = []
    for new, old in zip(newest, readings, strict=True):
        fields.append(jnp.concatenate([new[:, None], old[:, :-1]], 1))
    return Readings(*fields)


def with_readings(state: SceneState, readings: Readings) -> SceneState:
    """Replaces the targets by the newest ones, and the object's pose by the one shown."""
    return state._replace(
        q_target=readings.q_target[:, 0],
        u_target=readings.u_target[:, 0],
        object_position=readings.object_position[:, 0],
        object_quaternion=readings.object_quaternion[:, 0],
    )


def without_privileged(state: SceneState, readings: Readings, control_dt: float) -> SceneState:
    """Clears what only a simulator knows: forces, contacts and velocities.

    The wrist's velocity, on which its targets depend (`common.task.control`), is its displacement
    in the last control step over the duration of one, `control_dt` seconds.
    """
    moved = readings.u[:, 0] - readings.u[:, 1]
    return state._replace(
        q_velocity=jnp.zeros_like(state.q_velocity),
        u_velocity=moved / control_dt,
        object_velocity=jnp.zeros_like(state.object_velocity),
        object_angular_velocity=jnp.zeros_like(state.object_angular_velocity),
        contact_force=jnp.zeros_like(state.contact_force),
        contact_position=jnp.zeros_like(state.contact_position),
        contact_found=jnp.zeros_like(state.contact_found),
    )
