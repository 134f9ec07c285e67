"""What a robot has instead of the simulator's state: a tracker's samples of the object's pose, and its own joints.

A tracker samples the object's pose now and then; a sample arrives some control steps later, with errors, or never, and
the newest that has arrived is shown until the next one. A policy without the simulator's privileges
(`TaskConfig.observation` "tracked") sees the last control steps of that beside its joints and their targets, which
stand in for contact forces and velocities.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from congrasp.common import rotations
from congrasp.common.config import SensingConfig, TaskConfig
from congrasp.common.task.resting import resting_mean
from congrasp.common.task.types import Array, SceneState


class Sensors(NamedTuple):
    """The trackers of B episodes, drawn at their beginning."""

    key: Array
    """(B, 2) uint32 random key of errors and losses."""
    period: Array
    """(B,) control steps between two samples, at least 1."""
    phase: Array
    """(B,) share of a period that has passed since the last sample when the episode begins."""
    delay: Array
    """(B,) int control steps until a sample arrives."""
    position_noise: Array
    """(B,) m, standard deviation of each coordinate."""
    rotation_noise: Array
    """(B,) rad, standard deviation of the turn about each world axis."""
    dropout: Array
    """(B,) probability that a sample never arrives."""
    position_bias: Array
    """(B, 3) m, error of every sample, world frame."""
    rotation_bias: Array
    """(B, 3) rad, rotation vector by which every sample is turned, world frame."""


class Tracker(NamedTuple):
    """The trackers after a control step; world frame."""

    sensors: Sensors
    poses: Array
    """(B, K, 7) the object's true positions and quaternions in the last K control steps, newest first."""
    first: Array
    """(B, 7) where the object rests: the pose that was shown when the episode began, or the mean since then."""
    rested: Array
    """(B,) readings in that mean; 0 once the object has moved."""
    shown: Array
    """(B, 7) the pose that is shown now."""


class Readings(NamedTuple):
    """What sensors and controller said in the last H control steps, newest first; fields as in `SceneState`."""

    q: Array
    """(B, H, F)."""
    u: Array
    """(B, H, 6)."""
    q_target: Array
    """(B, H, F)."""
    u_target: Array
    """(B, H, 6)."""
    object_position: Array
    """(B, H, 3) as the tracker shows it."""
    object_quaternion: Array
    """(B, H, 4)."""


def draw_sensors(config: SensingConfig, control_dt: float, key: Array, batch: int) -> Sensors:
    """Trackers of B episodes, each number uniform in its range.

    Args:
      config: the ranges.
      control_dt: seconds of a control step.
      key: random key.
      batch: B.
    """
    keys = jax.random.split(key, 7)

    def drawn(number: int, limits: tuple[float, float]) -> Array:
        return jax.random.uniform(keys[number], (batch,), minval=limits[0], maxval=limits[1])

    def bias(number: int, limits: tuple[float, float]) -> Array:
        size, direction = jax.random.split(jax.random.fold_in(key, number))
        deviation = jax.random.uniform(size, (batch, 1), minval=limits[0], maxval=limits[1])
        return deviation * jax.random.normal(direction, (batch, 3))

    return Sensors(
        key=jax.random.key_data(jax.random.split(keys[0], batch)),
        period=jnp.maximum(drawn(1, config.period) / control_dt, 1.0),
        phase=drawn(2, (0.0, 1.0)),
        delay=jnp.round(drawn(3, config.delay) / control_dt).astype(jnp.int32),
        position_noise=drawn(4, config.position_noise),
        rotation_noise=drawn(5, config.rotation_noise),
        dropout=drawn(6, config.dropout),
        position_bias=bias(7, config.position_bias),
        rotation_bias=bias(8, config.rotation_bias),
    )


def longest(config: SensingConfig, control_dt: float) -> int:
    """K, control steps whose poses may still be on their way."""
    return math.ceil(config.delay[1] / control_dt) + 1


def begin(sensors: Sensors, steps: int, position: Array, quaternion: Array) -> Tracker:
    """Trackers of objects that have rested at poses (B, 3), (B, 4), with `steps` (K) of them on their way."""
    pose = jnp.concatenate([position, quaternion], -1)
    shown = _sampled(sensors, jnp.zeros(pose.shape[0], jnp.int32), pose)[0]
    rested = jnp.ones(len(pose), jnp.int32)
    return Tracker(sensors, jnp.broadcast_to(pose[:, None], (len(pose), steps, 7)), shown, rested, shown)


def track(
    tracker: Tracker, time: Array, position: Array, quaternion: Array, table: Array | bool = True, settle: float = 0.0
) -> Tracker:
    """The trackers one control step later.

    A sample is taken in control step n where floor(n / period + phase) rises, and is shown from step n + delay on.

    Args:
      tracker: after the step before.
      time: (B,) int control steps since the episodes began, this one counted.
      position: (B, 3) the object's true position after this step.
      quaternion: (B, 4).
      table: (B,) bool: the table is there.
      settle: see `SensingConfig`.
    """
    sensors = tracker.sensors
    pose = jnp.concatenate([position, quaternion], -1)
    poses = jnp.concatenate([pose[:, None], tracker.poses[:, :-1]], 1)
    taken = time - sensors.delay
    periods = [jnp.floor(n / sensors.period + sensors.phase) for n in (taken - 1, taken)]
    arrived = jnp.take_along_axis(poses, sensors.delay[:, None, None], 1)[:, 0]
    sample, lost = _sampled(sensors, time, arrived)
    fresh = (periods[1] > periods[0]) & ~lost
    shown = jnp.where(fresh[:, None], sample, tracker.shown)
    if settle:
        first, rested = resting_mean(jnp, tracker.first, tracker.rested, shown, jnp.asarray(table), settle)
        tracker = tracker._replace(first=first, rested=rested)
    return tracker._replace(poses=poses, shown=shown)


def _sampled(sensors: Sensors, time: Array, pose: Array) -> tuple[Array, Array]:
    """Samples (B, 7) of true poses, with their errors, and whether (B,) they are lost."""

    def noise(key: Array, time: Array) -> tuple[Array, Array]:
        errors, loss = jax.random.split(jax.random.fold_in(jax.random.wrap_key_data(key), time))
        return jax.random.normal(errors, (6,)), jax.random.uniform(loss)

    errors, luck = jax.vmap(noise)(sensors.key, time)
    position = pose[:, :3] + sensors.position_bias + sensors.position_noise[:, None] * errors[:, :3]
    noise_turn = rotations.from_rotation_vector(sensors.rotation_noise[:, None] * errors[:, 3:])
    turn = rotations.multiply(noise_turn, rotations.from_rotation_vector(sensors.rotation_bias))
    return jnp.concatenate([position, rotations.multiply(turn, pose[:, 3:])], -1), luck < sensors.dropout


def still(reading: Readings, steps: int) -> Readings:
    """The readings of an episode that begins: the same (B, ...) in all H `steps`."""
    return Readings(*(jnp.repeat(field[:, None], steps, 1) for field in reading))


def push(readings: Readings, newest: Readings) -> Readings:
    """The readings with the newest (B, ...) in front, the oldest left out."""
    return Readings(
        *(jnp.concatenate([new[:, None], old[:, :-1]], 1) for new, old in zip(newest, readings, strict=True))
    )


def seen_by(task: TaskConfig, state: SceneState, readings: Readings) -> SceneState:
    """A control step as the policy sees it: with the pose that the tracker shows.

    In a tracked observation forces and velocities are unknown, but that of the wrist, on which its targets depend
    (`common.task.control`): it is the wrist's way in the last control step over its time.

    Args:
      task: the task.
      state: the true state, but for the object's initial pose, which must be what the tracker showed first.
      readings: the last control steps.
    """
    state = state._replace(
        object_position=readings.object_position[:, 0], object_quaternion=readings.object_quaternion[:, 0]
    )
    if task.observation == "full":
        return state
    blind = ("q_velocity", "object_velocity", "object_angular_velocity", "contact_force", "contact_position")
    state = state._replace(**{name: jnp.zeros_like(getattr(state, name)) for name in blind})
    moved = readings.u[:, 0] - readings.u[:, 1]
    return state._replace(contact_found=jnp.zeros_like(state.contact_found), u_velocity=moved / task.control_dt)
