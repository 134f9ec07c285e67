"""Sensors and late servos of B environments, between the engine and the policy.

Nothing here depends on which sensor it is: the hooks of `common.task.sensors.base.Sensor` do the
rest.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp

from congrasp.actors.initial import InitialConditions
from congrasp.common.hands.spec import Hand
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.readings import Readings, push, still
from congrasp.common.task.sensors import get_sensor
from congrasp.common.task.sensors.base import EpisodeStart, Moment
from congrasp.common.task.sensors.parameters import SensorParameters
from congrasp.common.task.types import Action


class Sensing(NamedTuple):
    """Sensors of B environments after a control step."""

    parameters: SensorParameters
    """Random parameters of the episodes."""
    sensor: Any
    """State of the sensors (`common.task.sensors.base.Sensor.step`)."""
    readings: Readings
    """Readings of the last control steps."""


def begin_sensing(hand: Hand, task: TaskConfig, initial: InitialConditions) -> Sensing | None:
    """Returns the sensors at the start of episodes; None if the policy observes the true state."""
    if not task.sensed:
        return None
    sensor = get_sensor(task)
    reset_state = initial.reset_state
    pose = jnp.concatenate([reset_state.object_position, reset_state.object_quaternion], -1)
    start = EpisodeStart(
        hand=hand, task=task, pose=pose, surface=initial.surface, goal=initial.goal
    )
    state = sensor.begin(initial.sensors, start)
    sensed_pose = sensor.pose(state, jnp.zeros((len(pose), 3)))
    wrist = jnp.zeros((len(pose), 6))
    first = Readings(
        q=reset_state.q,
        u=wrist,
        q_target=reset_state.q,
        u_target=wrist,
        object_position=sensed_pose[:, :3],
        object_quaternion=sensed_pose[:, 3:],
    )
    return Sensing(initial.sensors, state, still(first, task.history))


def sense(sensing: Sensing, moment: Moment, newest: Action) -> Sensing:
    """Returns the sensors after a control step whose policy set the `newest` targets."""
    sensor = get_sensor(moment.task)
    state = sensor.step(sensing.parameters, sensing.sensor, moment)
    sensed_pose = sensor.pose(state, moment.lift)
    reading = Readings(
        q=moment.state.q,
        u=moment.state.u,
        q_target=newest.q_target,
        u_target=newest.u_target,
        object_position=sensed_pose[:, :3],
        object_quaternion=sensed_pose[:, 3:],
    )
    return sensing._replace(sensor=state, readings=push(sensing.readings, reading))


def targets_followed(task: TaskConfig, sensing: Sensing | None, newest: Action) -> Action:
    """Returns the targets that the servos follow in a control step.

    Args:
      task: the task.
      sensing: state of the sensors; None without sensors.
      newest: targets that the policy sets in this control step. They arrive
        `SensorParameters.latency` control steps late.
    """
    if sensing is None or not task.sensing.latency[1]:
        return newest
    readings = sensing.readings
    targets = Action(
        q_target=jnp.concatenate([newest.q_target[:, None], readings.q_target], 1),
        u_target=jnp.concatenate([newest.u_target[:, None], readings.u_target], 1),
    )
    return _late(sensing, targets)


def targets_last_followed(task: TaskConfig, sensing: Sensing | None, newest: Action) -> Action:
    """Returns the targets that the servos followed in the last control step.

    Args:
      task: the task.
      sensing: state of the sensors; None without sensors.
      newest: targets that the policy set in the last control step.
    """
    if sensing is None or not task.sensing.latency[1]:
        return newest
    return _late(sensing, Action(sensing.readings.q_target, sensing.readings.u_target))


def _late(sensing: Sensing, targets: Action) -> Action:
    """Selects the targets that have arrived from targets (B, H, ...), newest first."""
    steps = sensing.parameters.latency[:, None, None]
    return Action(
        q_target=jnp.take_along_axis(targets.q_target, steps, 1)[:, 0],
        u_target=jnp.take_along_axis(targets.u_target, steps, 1)[:, 0],
    )
