"""Random parameters of an episode's sensors, and the control steps in which their samples arrive.

A sensor samples periodically. A sample is taken in control step n where floor(n / period + phase)
rises, and arrives `delay` control steps later.
"""

import math
from typing import NamedTuple

import numpy as np

from congrasp.common import chance
from congrasp.common.runtime.lazy_jax import jax, jnp
from congrasp.common.task.settings import SensingConfig
from congrasp.common.task.types import Array

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


class SensorParameters(NamedTuple):
    """Parameters of the sensors of B episodes, drawn at their start."""

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


def draw_parameters(
    config: SensingConfig, control_dt: float, key: Array, batch: int
) -> SensorParameters:
    """Draws the parameters of B episodes, each uniform in its range.

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
    return SensorParameters(
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


def arrival(
    parameters: SensorParameters, poses: Array, time: Array, pose: Array
) -> tuple[Array, Array, Array]:
    """Returns the poses in transit (B, K, 7) after a control step, the oldest (B, 7), and a mask
    (B,) of due samples.

    Args:
      parameters: periods and delays.
      poses: (B, K, 7) poses in transit before the step, newest first.
      time: (B,) int control steps since the start of the episodes, including this one.
      pose: (B, 7) true poses after the step.
    """
    poses = jnp.concatenate([pose[:, None], poses[:, :-1]], 1)
    arrived = jnp.take_along_axis(poses, parameters.delay[:, None, None], 1)[:, 0]
    taken = time - parameters.delay
    period_before = jnp.floor((taken - 1) / parameters.period + parameters.phase)
    period = jnp.floor(taken / parameters.period + parameters.phase)
    return poses, arrived, period > period_before
