"""Sensors of a robot instead of the simulator's state: a tracker's samples of the object's pose,
and joint encoders.

A tracker samples the object's pose periodically. A sample arrives some control steps later, with
errors, or is lost; the newest arrived sample is shown until the next one. A policy without
privileged observations (`TaskSettings.observation` "tracked") observes the last control steps of
it, with its joints and their targets, which substitute for contact forces and velocities.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common import chance, rotations
from congrasp.common.task.resting import resting_mean
from congrasp.common.task.settings import SensingConfig, TaskSettings
from congrasp.common.task.types import Array, SceneState

# In the order of their random numbers; the ranges are those of `SensingConfig`, or 0 to 1
_DRAWN = (
    "period",
    "phase",
    "delay",
    "position_noise",
    "rotation_noise",
    "dropout",
    "position_bias",
    "rotation_bias",
    "latency",
    "camera_distance",
    "camera_elevation",
    "camera_azimuth",
    "once",
)
NEVER = 20_000.0
"""Period in control steps that no episode reaches."""


class Sensors(NamedTuple):
    """Trackers or cameras of B episodes, drawn at their start."""

    key: Array
    """(B, 2) uint32 random key of errors and losses."""
    period: Array
    """(B,) control steps between two samples, at least 1."""
    phase: Array
    """(B,) share of a period passed since the last sample at the start of the episode."""
    delay: Array
    """(B,) int control steps until a sample arrives."""
    position_noise: Array
    """(B,) m, standard deviation of each coordinate."""
    rotation_noise: Array
    """(B,) rad, standard deviation of the rotation about each axis of the world frame."""
    dropout: Array
    """(B,) probability that a sample is lost."""
    position_bias: Array
    """(B, 3) m, constant error of the samples, world frame."""
    rotation_bias: Array
    """(B, 3) rad, rotation vector of a constant error of the samples, world frame."""
    latency: Array
    """(B,) int control steps until the servos follow a target."""
    eye: Array
    """(B, 3) m, from the object's resting position to the camera, world frame."""


class Tracker(NamedTuple):
    """State of the trackers after a control step; world frame."""

    sensors: Sensors
    poses: Array
    """(B, K, 7) true positions and quaternions of the object in the last K control steps, newest
    first.
    """
    first: Array
    """(B, 7) resting pose of the object: the pose shown at the start of the episode, or the mean
    since then.
    """
    rested: Array
    """(B,) number of readings in that mean; 0 once the object has moved or the table is removed."""
    shown: Array
    """(B, 7) pose shown now."""


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
    """(B, H, 3) as shown by the tracker."""
    object_quaternion: Array
    """(B, H, 4)."""


def draw_sensors(config: SensingConfig, control_dt: float, key: Array, batch: int) -> Sensors:
    """Draws trackers for B episodes, each parameter uniform in its range.

    Args:
      config: ranges of the parameters.
      control_dt: seconds of a control step.
      key: random key.
      batch: number B of episodes.
    """
    ranges = {name: getattr(config, name, (0.0, 1.0)) for name in _DRAWN}
    numbers = chance.uniforms(key, {"ranges": len(ranges), "biases": 6}, batch)
    low, high = np.array([*ranges.values()], np.float32).T
    values = low + (high - low) * numbers["ranges"]
    drawn = dict(zip(ranges, values.T, strict=True))
    position_bias, rotation_bias = jnp.split(chance.normal(numbers["biases"]), 2, -1)
    once = drawn["once"] < config.single_image
    to_camera = _direction(drawn["camera_elevation"], drawn["camera_azimuth"])
    return Sensors(
        key=jax.random.key_data(jax.random.split(key, batch)),
        period=jnp.where(once, NEVER, jnp.maximum(drawn["period"] / control_dt, 1.0)),
        phase=jnp.where(once, 0.0, drawn["phase"]),
        delay=jnp.round(drawn["delay"] / control_dt).astype(jnp.int32),
        position_noise=drawn["position_noise"],
        rotation_noise=drawn["rotation_noise"],
        dropout=drawn["dropout"],
        position_bias=drawn["position_bias"][:, None] * position_bias,
        rotation_bias=drawn["rotation_bias"][:, None] * rotation_bias,
        latency=jnp.round(drawn["latency"] / control_dt).astype(jnp.int32),
        eye=drawn["camera_distance"][:, None] * to_camera,
    )


def _direction(elevation: Array, azimuth: Array) -> Array:
    """Unit vectors (B, 3) at these angles (B,) in rad, azimuth from the x axis."""
    x = jnp.cos(elevation) * jnp.cos(azimuth)
    y = jnp.cos(elevation) * jnp.sin(azimuth)
    return jnp.stack([x, y, jnp.sin(elevation)], -1)


def longest(config: SensingConfig, control_dt: float) -> int:
    """K, the most control steps for which a pose may be in transit."""
    return math.ceil(config.delay[1] / control_dt) + 1


def begin(sensors: Sensors, steps: int, position: Array, quaternion: Array) -> Tracker:
    """Returns trackers of objects that have rested at poses (B, 3), (B, 4), with `steps` (K)
    samples in transit.
    """
    pose = jnp.concatenate([position, quaternion], -1)
    batch = len(pose)
    first, _ = _sampled(sensors, jnp.zeros(batch, jnp.int32), pose)
    return Tracker(
        sensors=sensors,
        poses=jnp.broadcast_to(pose[:, None], (batch, steps, 7)),
        first=first,
        rested=jnp.ones(batch, jnp.int32),
        shown=first,
    )


def track(
    tracker: Tracker,
    time: Array,
    position: Array,
    quaternion: Array,
    table: Array | bool = True,
    settle: float = 0.0,
) -> Tracker:
    """Advances the trackers by one control step.

    A sample is taken in control step n where floor(n / period + phase) rises, and is shown from
    step n + delay on.

    Args:
      tracker: state after the previous step.
      time: (B,) int control steps since the start of the episodes, including this one.
      position: (B, 3) true position of the object after this step.
      quaternion: (B, 4) true orientation of the object.
      table: (B,) bool: the table is present.
      settle: see `SensingConfig`.
    """
    pose = jnp.concatenate([position, quaternion], -1)
    poses, arrived, due = arrival(tracker.sensors, tracker.poses, time, pose)
    sample, lost = _sampled(tracker.sensors, time, arrived)
    shown = jnp.where((due & ~lost)[:, None], sample, tracker.shown)
    if settle:
        first, rested = resting_mean(
            jnp, tracker.first, tracker.rested, shown, jnp.asarray(table), settle
        )
        tracker = tracker._replace(first=first, rested=rested)
    return tracker._replace(poses=poses, shown=shown)


def arrival(sensors: Sensors, poses: Array, time: Array, pose: Array) -> tuple[Array, Array, Array]:
    """Returns the poses in transit (B, K, 7) after a control step, the oldest (B, 7), and a mask
    (B,) of due samples.

    Args:
      sensors: periods and delays.
      poses: (B, K, 7) poses in transit before the step, newest first.
      time: (B,) int, see `track`.
      pose: (B, 7) true poses after the step.
    """
    poses = jnp.concatenate([pose[:, None], poses[:, :-1]], 1)
    arrived = jnp.take_along_axis(poses, sensors.delay[:, None, None], 1)[:, 0]
    taken = time - sensors.delay
    period_before = jnp.floor((taken - 1) / sensors.period + sensors.phase)
    period = jnp.floor(taken / sensors.period + sensors.phase)
    return poses, arrived, period > period_before


def _sampled(sensors: Sensors, time: Array, pose: Array) -> tuple[Array, Array]:
    """Samples (B, 7) of true poses with errors, and a mask (B,) of lost ones."""

    def noise(key: Array, time: Array) -> tuple[Array, Array]:
        errors, loss = jax.random.split(jax.random.fold_in(jax.random.wrap_key_data(key), time))
        return jax.random.normal(errors, (6,)), jax.random.uniform(loss)

    errors, luck = jax.vmap(noise)(sensors.key, time)
    position = pose[:, :3] + sensors.position_bias + sensors.position_noise[:, None] * errors[:, :3]
    noise_turn = rotations.from_rotation_vector(sensors.rotation_noise[:, None] * errors[:, 3:])
    turn = rotations.multiply(noise_turn, rotations.from_rotation_vector(sensors.rotation_bias))
    sample = jnp.concatenate([position, rotations.multiply(turn, pose[:, 3:])], -1)
    return sample, luck < sensors.dropout


def still(reading: Readings, steps: int) -> Readings:
    """Readings at the start of an episode: the same (B, ...) in all H `steps`."""
    return Readings(*[jnp.repeat(field[:, None], steps, 1) for field in reading])


def push(readings: Readings, newest: Readings) -> Readings:
    """Prepends the newest readings (B, ...) and drops the oldest."""
    fields = []
    for new, old in zip(newest, readings, strict=True):
        fields.append(jnp.concatenate([new[:, None], old[:, :-1]], 1))
    return Readings(*fields)


def seen_by(task: TaskSettings, state: SceneState, readings: Readings) -> SceneState:
    """Returns a control step as observed by the policy: the tracker's pose and the newest targets.

    In a tracked observation, forces and velocities are unknown except the wrist's velocity, on
    which its targets depend (`common.task.control`): it is the wrist's displacement in the last
    control step over its duration.

    Args:
      task: the task.
      state: the true state, except for the object's initial pose, which must be the first shown by
        the tracker.
      readings: the last control steps.
    """
    state = state._replace(
        q_target=readings.q_target[:, 0],
        u_target=readings.u_target[:, 0],
        object_position=readings.object_position[:, 0],
        object_quaternion=readings.object_quaternion[:, 0],
    )
    if task.observation == "full":
        return state
    moved = readings.u[:, 0] - readings.u[:, 1]
    return state._replace(
        q_velocity=jnp.zeros_like(state.q_velocity),
        u_velocity=moved / task.control_dt,
        object_velocity=jnp.zeros_like(state.object_velocity),
        object_angular_velocity=jnp.zeros_like(state.object_angular_velocity),
        contact_force=jnp.zeros_like(state.contact_force),
        contact_position=jnp.zeros_like(state.contact_position),
        contact_found=jnp.zeros_like(state.contact_found),
    )
