"""Privileged inputs in training: those of the critic and of a teacher, which policies of robots
cannot observe.

The critic's are the true parameters of an episode, and the true state if the policy has sensors
(asymmetric actor-critic, Pinto et al. 2018, arXiv 1710.06542). Actors record these inputs; no
policy acts on them.

The teacher's are the full observation, and what converts its actions to those of a student that
observes another state. A residual is relative to the guidance of its policy. A student's guidance
differs if its tracker has errors, so that the teacher's residual would move its wrist to another
place. Both share the wrist's target: the student's label is (u_tgt - u_g) / alpha_w with the
teacher's target u_tgt and the student's guidance u_g.

Both share the fingers' targets likewise. The teacher continues from the targets m that the servos
follow, the student from its newest ones m', which the servos follow later
(`SensingConfig.latency`): its label is a_f + (m - m') / alpha_f.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp

from congrasp.common.hands.motors import motor_positions, tip_forces
from congrasp.common.hands.spec import Hand
from congrasp.common.task import observation
from congrasp.common.task.constraints.specs import ObservationField
from congrasp.common.task.control import Guided, guided, wrist_lead
from congrasp.common.task.scene import Scene
from congrasp.common.task.sensors.parameters import SensorParameters
from congrasp.common.task.settings import GRAVITY, ControlConfig, TaskSettings
from congrasp.common.task.types import Array

MAX_LOAD = 10.0
"""Upper bound of `load`."""
_WRIST_ENDS = (6, 7, 13, 14, 20)
"""Ends of the wrist's numbers: the teacher's `Guided`, then the lead of the student's guidance
alone.
"""


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
    sensors: SensorParameters | None
    """Parameters of the sensors; None if the policy observes the true state."""


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
            "load",
            1,
            "object's weight over friction times the sum of the fingertips' forces, at most 10",
        ),
        ObservationField("stationary", 1, "1 if the object is fixed"),
        ObservationField(
            "hold_remaining", 1, "remaining control steps of the hold over the longest hold"
        ),
    )
    if not task.sensed:
        return episode
    size = sum(size for _, size in observation.layout(hand, _full(task)))
    return (
        *episode,
        ObservationField("period", 1, "control steps between two samples of the tracker"),
        ObservationField("delay", 1, "control steps until a sample arrives"),
        ObservationField(
            "position_noise", 1, "m, standard deviation of each coordinate of a sample"
        ),
        ObservationField(
            "rotation_noise", 1, "rad, standard deviation of a sample's rotation about each axis"
        ),
        ObservationField("dropout", 1, "probability that a sample is lost"),
        ObservationField("observation", size, "full observation of the true state, without noise"),
    )


def observe(scene: Scene, parameters: Parameters) -> Array:
    """Privileged inputs (B, P), laid out like `fields`.

    With the control step t and the sum F of `tip_forces`, load = min(m g / (mu F), 10) and
    hold_remaining = max(min(approach_steps + hold - t, hold), 0) / max(hold_steps, hold_steps_max).

    Args:
      scene: the true control step, with the task of the policy.
      parameters: parameters of the episodes.
    """
    task = scene.task
    strength = jnp.maximum(parameters.friction * float(tip_forces(scene.hand).sum()), 1e-6)
    remaining = jnp.minimum(
        task.approach_steps + parameters.hold - scene.state.time, parameters.hold
    )
    values = [
        parameters.mass,
        parameters.friction,
        parameters.gain_scale,
        jnp.minimum(parameters.mass * GRAVITY / strength, MAX_LOAD),
        parameters.stationary,
        jnp.maximum(remaining, 0) / max(task.hold_steps, task.hold_steps_max),
    ]
    if parameters.sensors is not None:
        sensors = parameters.sensors
        values += [
            sensors.period,
            sensors.delay,
            sensors.position_noise,
            sensors.rotation_noise,
            sensors.dropout,
        ]
    numbers = jnp.stack([jnp.asarray(value, jnp.float32) for value in values], -1)
    if not task.sensed:
        return numbers
    full_observation = observation.observe(scene._replace(task=_full(task)))
    return jnp.concatenate([numbers, full_observation], -1)


def _full(task: TaskSettings) -> TaskSettings:
    """Returns the task with a policy that observes the full state."""
    return dataclasses.replace(task, observation="full")


def extra(hand: Hand) -> int:
    """Numbers after the observation: the wrist's, and the lag (M) of the motors' followed targets,
    rad.
    """
    return _WRIST_ENDS[-1] + len(hand.motors)


def observe_for_teacher(true: Scene, seen: Scene, control: ControlConfig) -> Array:
    """Returns the full observation of the true state and the numbers of `extra` (B, S).

    Args:
      true: the true scene.
      seen: the scene of the same control step as the student observes it.
      control: limits and scales.
    """
    teacher = guided(true, control)
    student_lead = guided(seen, control).bounded(control)
    lag = motor_positions(true.hand, true.state.q_target - seen.state.q_target)
    parts = [
        observation.observe(true),
        teacher.ahead,
        teacher.limit[:, None],
        teacher.velocity,
        jnp.asarray(teacher.table, teacher.ahead.dtype)[:, None],
        student_lead,
        lag,
    ]
    return jnp.concatenate(parts, -1)


def student_action(hand: Hand, control: ControlConfig, rows: Array, action: Array) -> Array:
    """Returns the action (..., M + 6) that gives a student the targets of its teacher.

    Args:
      hand: the hand, for its servos.
      control: limits and scales.
      rows: (..., S) of `observe_for_teacher`.
      action: (..., M + 6) action of the teacher.
    """
    numbers = rows[..., -extra(hand) :].astype(action.dtype)
    ahead, limit, velocity, table, student_lead, lag = jnp.split(numbers, _WRIST_ENDS, -1)
    teacher = Guided(ahead=ahead, limit=limit[..., 0], velocity=velocity, table=table[..., 0] > 0.5)
    lead = wrist_lead(hand, control, teacher, action[..., -6:])
    scale = jnp.repeat(jnp.stack([control.wrist_position_scale, control.wrist_rotation_scale]), 3)
    fingers = action[..., :-6] + lag / control.finger_scale
    return jnp.concatenate([fingers, (lead - student_lead) / scale], -1)
