"""Levels of sensor and servo errors: one change at a time relative to a typical commercial tracker.

The same episodes are evaluated at every level, under the heading constraint. A policy of the full state gets the
tracker's pose instead of the true one, and keeps its contact forces and velocities.
"""

import dataclasses
import math

import jax.numpy as jnp

from congrasp.actors.initial import InitialConditions
from congrasp.common.task.config import SensingConfig, TaskConfig

CONSTRAINT = "heading"
"""Row evaluated at every level."""


@dataclasses.dataclass(frozen=True)
class Level:
    """A tracker, a friction and an error of the gains; by default a tracker with 30 Hz, 5 mm, 3 degrees and 60 ms."""

    label: str
    """Difference from the default."""
    position_noise: float = 0.005
    """Standard deviation of each coordinate, m."""
    rotation_noise: float = math.radians(3.0)
    """Standard deviation about each axis, rad."""
    delay: float = 0.06
    """s."""
    rate: float = 30.0
    """Hz."""
    dropout: float = 0.0
    """Share of lost samples."""
    friction: float | None = None
    """Sliding friction between hand and object; None: that of the evaluation."""
    gains: float = 1.0
    """Factor on the finger servos' gains."""
    latency: float = 0.0
    """Seconds until the servos follow a target."""


LEVELS = (
    Level("the true pose", position_noise=0.0, rotation_noise=0.0, delay=0.0, rate=math.inf),
    Level("5 mm 3°, 30 Hz, 60 ms"),
    Level("no noise", position_noise=0.0, rotation_noise=0.0),
    Level("10 mm 6°", position_noise=0.01, rotation_noise=math.radians(6.0)),
    Level("no delay", delay=0.0),
    Level("100 ms", delay=0.1),
    Level("10 Hz", rate=10.0),
    Level("10 % dropped", dropout=0.1),
    Level("30 % dropped", dropout=0.3),
    Level("friction 0.5", friction=0.5),
    Level("gains -20 %", gains=0.8),
    Level("gains +20 %", gains=1.2),
    Level("targets 20 ms late", latency=0.02),
    Level("targets 40 ms late", latency=0.04),
)
"""Rows of the table; each but the first differs from the second in one setting."""


def sensing_task(task: TaskConfig) -> TaskConfig:
    """Returns the task in which a policy observes trackers, with room for the longest delay."""
    delay, latency = ((0.0, max(getattr(level, name) for level in LEVELS)) for name in ("delay", "latency"))
    return dataclasses.replace(task, sensing=SensingConfig(delay=delay, latency=latency, settle=task.sensing.settle))


def at_level(conditions: InitialConditions, level: Level, control_dt: float) -> InitialConditions:
    """Returns the episodes at a level; errors and losses use the same random numbers at all levels.

    Args:
      conditions: episodes of `sensing_task`.
      level: the level.
      control_dt: seconds of a control step.
    """
    sensors, start = conditions.sensors, conditions.reset_state
    friction = start.friction if level.friction is None else jnp.full_like(start.friction, level.friction)
    return conditions._replace(
        sensors=sensors._replace(
            period=jnp.full_like(sensors.period, max(1.0 / (level.rate * control_dt), 1.0)),
            delay=jnp.full_like(sensors.delay, round(level.delay / control_dt)),
            position_noise=jnp.full_like(sensors.position_noise, level.position_noise),
            rotation_noise=jnp.full_like(sensors.rotation_noise, level.rotation_noise),
            dropout=jnp.full_like(sensors.dropout, level.dropout),
            latency=jnp.full_like(sensors.latency, round(level.latency / control_dt)),
        ),
        reset_state=start._replace(friction=friction, gain_scale=jnp.full_like(start.gain_scale, level.gains)),
    )
