"""How a hand's motors follow their targets, in free air: the response to a step, and closing without an object."""

import dataclasses
from typing import NamedTuple

import jax
import numpy as np

from congrasp.actors.physics.engine import PhysicsState, ResetState
from congrasp.actors.physics.native import NativePhysics
from congrasp.common.config import TaskConfig
from congrasp.common.hands.kinematics import link_transforms
from congrasp.common.hands.motors import motor_limits, motor_positions
from congrasp.common.hands.spec import Hand
from congrasp.common.task import plausibility
from congrasp.services.assets.hands.grips import grip_objects

STEP = 0.1
"""rad, as far as a target moves in a control step."""
_STEPS = 60
_SETTLED = 10  # the last control steps, in which a joint should be at rest
_FAR = (0.0, 0.0, -5.0)  # m, where the object that every scene has is out of reach


class Response(NamedTuple):
    """A motor's response to a step of its target."""

    overshoot: float
    """Beyond the target, as a share of the step."""
    unrest: float
    """rad/s, the standard deviation of the motor's speed in the last tenth of a second; a slow one has none."""
    error: float
    """Distance from the target in the end, as a share of the step."""
    diverged: bool
    """The simulation broke off."""


def responses(hand: Hand, task: TaskConfig, threads: int) -> list[Response]:
    """The responses (M) of the motors, one after the other, to steps of `STEP` or half of their range from the open
    pose towards the side with more room; the other motors are to stay, and links do not collide."""
    task = dataclasses.replace(task, hand_self_collision=False, hand_table_collision=False)
    (lower, upper), opened = motor_limits(hand), motor_positions(hand, hand.q_open)
    size = np.minimum(STEP, (upper - lower) / 2)
    way = np.where(upper - opened >= opened - lower, size, -size)
    states = _states(hand, task, np.tile(opened + np.diag(way), (_STEPS, 1, 1)), threads)
    each = np.arange(len(hand.motors))
    gone = (motor_positions(hand, states.q)[:, each, each] - opened) / way  # (T, M) shares of the step
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
    """How deep in metres links are in one another once the empty hand has closed, as far as its contacts let it."""
    share = np.minimum(np.arange(1, 2 * _STEPS + 1) / _STEPS, 1.0)[:, None, None]
    opened, closed = (motor_positions(hand, q) for q in (hand.q_open, hand.q_closed))
    states = _states(hand, task, opened + share * (closed - opened), threads)
    return float(plausibility.hand_hand(hand, link_transforms(hand, np.asarray(states.q[-1], np.float32)))[0])


def _states(hand: Hand, task: TaskConfig, targets: np.ndarray, threads: int) -> PhysicsState:
    """The states, with leading axis T, under targets (T, B, M) of the motors that begin with the open pose."""
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
