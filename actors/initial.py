"""Initial conditions of episodes, and those of requested episodes.

`sampled` draws them at random.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from congrasp.actors.initial_hand import Approach, PlacedHand, initial_hand, nominal_approach
from congrasp.actors.physics.engine import ResetState
from congrasp.common import rotations
from congrasp.common.hands.spec import Hand
from congrasp.common.task.config import SensingConfig, TaskConfig
from congrasp.common.task.constraints.priority import Resolution, resolve
from congrasp.common.task.sensors import get_sensor
from congrasp.common.task.sensors.parameters import SensorParameters
from congrasp.common.task.types import Array, Goal, Surface


class InitialConditions(NamedTuple):
    """Initial conditions of B episodes."""

    reset_state: ResetState
    """Initial state of object and hand, and masses."""
    goal: Goal
    """Active constraints, after the priority rules."""
    surface: Surface
    """Labelled surface points of the objects."""
    region: Array
    """(B,) int: region of the constraint bank from which they were drawn."""
    hold: Array
    """(B,) int: control steps without the table before the end of the episode."""
    sensors: SensorParameters
    """Parameters of the sensors, for policies that do not observe the true state."""


class Dynamics(NamedTuple):
    """Objects and dynamics of B episodes; fields as in `ResetState`."""

    object_index: Array
    """(B,) int, index of the object in the pool."""
    mass_scale: Array
    """(B,) factor on the object's mass."""
    friction: Array
    """(B,) sliding friction between hand and object."""
    gain_scale: Array
    """(B,) factor on the gains of the finger servos."""
    stationary: Array
    """(B,) bool: the object is fixed."""


class RequestedEpisodes(NamedTuple):
    """A batch of requested episodes, before the priority rules; object frame."""

    goal: Goal
    """Goal arrays; those of absent constraints may hold any finite values, and the active flags are
    ignored.
    """
    requested: dict[str, Array]
    """(B,) bool for each optional constraint by name: True if requested."""
    surface: Surface
    rest: Array
    """(B, 7) pose of the object on the table, world frame."""


def requested_conditions(
    hand: Hand,
    task: TaskConfig,
    request: RequestedEpisodes,
    hold: Array | int,
    speed: Array | float,
) -> tuple[InitialConditions, Resolution]:
    """Returns the initial conditions of requested episodes of one object with nominal mass and
    friction, and the effects of the priority rules.

    The policy observes the true pose of the object, whatever tracker it was trained with.

    Args:
      hand: the hand.
      task: geometry of the approach.
      request: the episodes.
      hold: control steps without the table.
      speed: initial speed of the wrist along the heading, m/s.
    """
    resolution = resolve(hand, request.surface, request.goal, request.requested)
    goal = resolution.goal
    batch = request.rest.shape[0]
    nominal = jnp.ones(batch)
    first = jnp.zeros(batch, jnp.int32)
    dynamics = Dynamics(
        object_index=first,
        mass_scale=nominal,
        friction=nominal,
        gain_scale=nominal,
        stationary=jnp.zeros(batch, bool),
    )
    approach = nominal_approach(task, batch)._replace(speed=jnp.full(batch, speed))
    placed = initial_hand(hand, task, goal, request.surface, request.rest, approach)
    sensors = get_sensor(task).draw(SensingConfig(), task.control_dt, jax.random.key(0), batch)
    conditions = InitialConditions(
        reset_state=reset_state(goal, request.rest, placed, approach, dynamics),
        goal=goal,
        surface=request.surface,
        region=first,
        hold=jnp.full(batch, hold, jnp.int32),
        sensors=sensors,
    )
    return conditions, resolution


def reset_state(
    goal: Goal, rest: Array, placed: PlacedHand, approach: Approach, dynamics: Dynamics
) -> ResetState:
    """Returns the initial states of placed hands that approach along the heading, for objects in
    resting poses (B, 7).
    """
    direction = rotations.rotate(rest[:, 3:], goal["heading"].direction)
    velocity = approach.speed[:, None] * direction
    wrist_velocity = rotations.rotate(rotations.conjugate(placed.quaternion), velocity)
    return ResetState(
        object_index=dynamics.object_index,
        mass_scale=dynamics.mass_scale,
        friction=dynamics.friction,
        gain_scale=dynamics.gain_scale,
        base_position=placed.position,
        base_quaternion=placed.quaternion,
        u_velocity=jnp.pad(wrist_velocity, ((0, 0), (0, 3))),
        q=placed.q,
        object_position=rest[:, :3],
        object_quaternion=rest[:, 3:],
        stationary=dynamics.stationary,
    )
