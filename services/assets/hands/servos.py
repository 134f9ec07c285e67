"""Tracking of a hand's motors in free air: the response to a step, and closing without an object."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import numpy as np

from congrasp.actors.physics.engine import PhysicsState, ResetState
from congrasp.actors.physics.native import NativePhysics
from congrasp.common.hands.kinematics import link_transforms
from congrasp.common.hands.motors import motor_limits, motor_positions
from congrasp.common.hands.spec import Hand
from congrasp.common.task import plausibility
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.types import Array
from congrasp.services.assets.hands.grips import grip_objects

STEP = 0.1
"""Step of a target in a control step, rad."""
_STEPS = 60
_SETTLED = 10  # last control steps, in which a joint should be at rest
_FAR = (0.0, 0.0, -5.0)  # distance at which the scene's object is out of reach, m


class Response(NamedTuple):
    """Response of a motor to a step of its target."""

    overshoot: float
    """Overshoot as a share of the step."""
    unrest: float
    """Standard deviation of the motor's speed in the last tenth of a second, rad/s; zero for a slow one."""
    error: float
    """Final distance from the target, as a share of the step."""
    diverged: bool
    """True if the simulation diverged."""


def responses(hand: Hand, task: TaskConfig, threads: int) -> list[Response]:
    """Responses (M) of the motors to steps, in turn.

    A step is `STEP` or half of the range, from the open pose towards the side with more room. The other motors stay,
    and links do not collide.
    """
    task = dataclasses.replace(task, hand_self_collision=False, hand_table_collision=False)
    (lower, upper), opened = motor_limits(hand), motor_positions(hand, hand.q_open)
    size = np.minimum(STEP, (upper - lower) / 2)
    way = np.where(upper - opened >= opened - lower, size, -size)
    states = _states(hand, task, np.tile(opened + np.diag(way), (_STEPS, 1, 1)), threads)
    each = np.arange(len(hand.motors))
    gone = (motor_positions(hand, states.q)[:, each, each] - opened) / way  # (T, M) as shares of the step
    speed = motor_positions(hand, states.q_velocity)[-_SETTLED:, each, each]
    return [
        Response(
            float(max(gone[:, j].max() - 1, 0.0)),
            float(speed[:, j].std()),
            float(abs(gone[-1, j] - 1)),
            bool(states.diverged[:, j].any()),
        )
        for j in each
    ]


def closed_overlap(hand: Hand, task: TaskConfig, threads: int) -> float:
    """Greatest overlap in m of links after the empty hand has closed, as far as its contacts allow."""
    share = np.minimum(np.arange(1, 2 * _STEPS + 1) / _STEPS, 1.0)[:, None, None]
    opened, closed = (motor_positions(hand, q) for q in (hand.q_open, hand.q_closed))
    states = _states(hand, task, opened + share * (closed - opened), threads)
    return float(_overlap(hand, states.q[-1].astype(np.float32))[0])


@functools.partial(jax.jit, static_argnums=0)
def _overlap(hand: Hand, q: Array) -> Array:
    """Greatest overlap (B,) in m of two links at finger angles (B, F), compiled as one program."""
    return plausibility.hand_hand(hand, link_transforms(hand, q))


def _states(hand: Hand, task: TaskConfig, targets: np.ndarray, threads: int) -> PhysicsState:
    """States, with leading axis T, for motor targets (T, B, M) from the open pose on."""
    count = targets.shape[1]
    ones = np.ones(count)
    start = ResetState(
        object_index=np.zeros(count, int),
        mass_scale=ones,
        friction=ones,
        gain_scale=ones,
        base_position=np.zeros((count, 3)),
        base_quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        u_velocity=np.zeros((count, 6)),
        q=np.tile(hand.q_open, (count, 1)),
        object_position=np.tile(_FAR, (count, 1)),
        object_quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        stationary=ones > 0,
    )
    physics, found = NativePhysics(hand, task, grip_objects(0.04)[:1], threads), []
    try:
        physics.start(start)
        for target in targets:
            command = np.concatenate([np.zeros((count, 6)), target], -1)
            _, state = physics.step(physics, command, np.zeros(count, bool))
            found.append(jax.tree.map(np.asarray, state))
    finally:
        physics.close()
    return jax.tree.map(lambda *leaves: np.stack(leaves), *found)
