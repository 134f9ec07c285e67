"""Privileged inputs of the critic: true parameters of an episode, and the true state if the policy has sensors.

The critic is only used in training, so it may observe what the actor and the robot cannot (asymmetric actor-critic,
Pinto et al. 2018, arXiv 1710.06542). Actors record these inputs; no policy acts on them.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp

from congrasp.common.hands.motors import tip_forces
from congrasp.common.hands.spec import Hand
from congrasp.common.task import observation
from congrasp.common.task.constraints.base import ObservationField, Scene
from congrasp.common.task.sensing import Sensors
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array

GRAVITY = 9.81
"""m/s^2."""
MOST_LOAD = 10.0
"""Upper bound of `load`."""


class Parameters(NamedTuple):
    """True parameters of B episodes."""

    mass: Array
    """(B,) mass of the object, kg."""
    friction: Array
    """(B,) sliding friction between the hand and the object."""
    gain_scale: Array
    """(B,) factor on the finger servos' gains."""
    stationary: Array
    """(B,) bool: the object is fixed."""
    hold: Array
    """(B,) control steps of the hold, without the table."""
    sensors: Sensors | None
    """The trackers; None if the policy observes the true poses."""


def layout(hand: Hand, task: TaskSettings) -> tuple[tuple[str, int], ...]:
    """Names and sizes of the fields, in order."""
    return tuple((field.name, field.size) for field in fields(hand, task))


def fields(hand: Hand, task: TaskSettings) -> tuple[ObservationField, ...]:
    """Description of the critic's privileged inputs, in order."""
    episode = (
        ObservationField("mass", 1, "kg, mass of the object"),
        ObservationField("friction", 1, "sliding friction between the hand and the object"),
        ObservationField("gain_scale", 1, "factor on the finger servos' gains"),
        ObservationField(
            "load", 1, "object's weight over friction times the sum of the fingertips' forces, at most 10"
        ),
        ObservationField("stationary", 1, "1 if the object is fixed"),
        ObservationField("hold_remaining", 1, "remaining control steps of the hold over the longest hold"),
    )
    if not task.sensed:
        return episode
    size = sum(size for _, size in observation.layout(hand, _full(task)))
    return (
        *episode,
        ObservationField("period", 1, "control steps between two samples of the tracker"),
        ObservationField("delay", 1, "control steps until a sample arrives"),
        ObservationField("position_noise", 1, "m, standard deviation of each coordinate of a sample"),
        ObservationField("rotation_noise", 1, "rad, standard deviation of a sample's rotation about each axis"),
        ObservationField("dropout", 1, "probability that a sample is lost"),
        ObservationField("observation", size, "full observation of the true state, without noise"),
    )


def observe(scene: Scene, parameters: Parameters) -> Array:
    """Privileged inputs (B, P), laid out like `fields`.

    With the control step t and the sum F of `tip_forces`, load = min(m g / (mu F), 10) and hold_remaining =
    max(min(approach_steps + hold - t, hold), 0) / max(hold_steps, hold_steps_max).

    Args:
      scene: the true control step, with the task of the policy.
      parameters: parameters of the episodes.
    """
    hand, task = scene.hand, scene.task
    strength = jnp.maximum(parameters.friction * float(tip_forces(hand).sum()), 1e-6)
    remaining = jnp.minimum(task.approach_steps + parameters.hold - scene.state.time, parameters.hold)
    values = [
        parameters.mass,
        parameters.friction,
        parameters.gain_scale,
        jnp.minimum(parameters.mass * GRAVITY / strength, MOST_LOAD),
        parameters.stationary,
        jnp.maximum(remaining, 0) / max(task.hold_steps, task.hold_steps_max),
    ]
    if parameters.sensors is not None:
        sensors = parameters.sensors
        values += [sensors.period, sensors.delay, sensors.position_noise, sensors.rotation_noise, sensors.dropout]
    numbers = jnp.stack([jnp.asarray(value, jnp.float32) for value in values], -1)
    if not task.sensed:
        return numbers
    return jnp.concatenate([numbers, observation.observe(scene._replace(task=_full(task)))], -1)


def _full(task: TaskSettings) -> TaskSettings:
    """Returns the task with a policy that observes the full state."""
    return dataclasses.replace(task, observation="full")
