"""Initial hand of an episode: open or preshaped fingers, and a wrist that approaches along the
heading or takes the first pose of a constraint (paper, section Hand Initialization).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from congrasp.common import rotations
from congrasp.common.hands import kinematics
from congrasp.common.hands.closure import PRESHAPE_MARGIN_M, preshape
from congrasp.common.hands.spec import Hand
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import known
from congrasp.common.task.sampling.headings import Headings, local_width
from congrasp.common.task.types import Array, Goal, Surface

_MIN_HEIGHT_M = 0.005
"""Least initial height of the hand's lowest point over the table."""
_HANDOVER_SHARE = 0.9
"""Speed at the end of a planned reach, as a share of the speed at which the guidance then moves the
wrist. A slower reach has a second peak of the speed after it."""


class Approach(NamedTuple):
    """Start of B approaches, apart from their constraints."""

    back_off: Array
    """(B,) distance back from the aligned wrist where the heading guides it, m."""
    margin: Array
    """(B,) distance by which the fingers are opened wider than the object, m."""
    speed: Array
    """(B,) speed of the wrist along the heading, m/s."""


class PlacedHand(NamedTuple):
    """Initial hands of B episodes."""

    q: Array
    """(B, F) finger angles, rad."""
    position: Array
    """(B, 3) wrist, world frame, m."""
    quaternion: Array
    """(B, 4) wrist, world frame."""


def nominal_approach(task: TaskConfig, batch: int) -> Approach:
    """Returns the approaches of evaluation and requests: at rest, without random variation."""
    return Approach(
        back_off=jnp.full(batch, task.back_off),
        margin=jnp.full(batch, PRESHAPE_MARGIN_M),
        speed=jnp.zeros(batch),
    )


def handover_speed(hand: Hand, task: TaskConfig) -> float:
    """Returns the wrist speed (m/s) at which a planned reach hands over to the policy.

    The guidance's target leads by d, and moves the wrist at d stiffness / damping.
    """
    stiffness, damping = hand.wrist_servos[:, 0]
    lead = task.control.approach_position_limit
    return float(_HANDOVER_SHARE * lead * stiffness / damping)


def initial_hand(
    hand: Hand,
    task: TaskConfig,
    goal: Goal,
    surface: Surface,
    rest: Array,
    approach: Approach | None = None,
) -> PlacedHand:
    """Returns the initial hands, determined by the constraints.

    With `TaskConfig.preshape` the fingers are opened to the object's width at the heading, unless a
    constraint sets them. A hand that would be in the table is raised.

    Args:
      hand: the hand.
      task: geometry of the approach.
      goal: goal after the priority rules.
      surface: surface of the objects.
      rest: (B, 7) resting poses of the objects.
      approach: start of the approach; nominal by default.
    """
    approach = approach or nominal_approach(task, len(rest))
    q = jnp.broadcast_to(jnp.array(hand.q_open), (rest.shape[0], len(hand.joints)))
    if task.preshape:
        heading = Headings(*(axis[:, None] for axis in goal["heading"]))
        width = local_width(heading, surface.points)[:, 0]
        q = preshape(hand, width, approach.margin)
    # A later constraint overrides an earlier one, here and below.
    for constraint in known(task):
        fingers = constraint.initial_fingers(goal)
        if fingers is not None:
            is_set, angles = fingers
            q = jnp.where(is_set[:, None], angles, q)
    position = jnp.zeros_like(rest[:, :3])
    quaternion = jnp.zeros_like(rest[:, 3:])
    for constraint in known(task):
        wrist = constraint.initial_wrist(hand, approach.back_off, goal, q)
        if wrist is not None:
            is_set, wrist_position, wrist_quaternion = wrist
            position = jnp.where(is_set[:, None], wrist_position, position)
            quaternion = jnp.where(is_set[:, None], wrist_quaternion, quaternion)
    position, quaternion = rotations.compose_pose(rest[:, :3], rest[:, 3:], position, quaternion)
    missing_height = _MIN_HEIGHT_M - _lowest_height(hand, q, position, quaternion)
    position = position.at[:, 2].add(jnp.maximum(missing_height, 0.0))
    return PlacedHand(q, position, quaternion)


def _lowest_height(hand: Hand, q: Array, position: Array, quaternion: Array) -> Array:
    """Height (B,) in m over the table of the lowest point of hands at wrist poses (B, 3), (B, 4),
    world frame.
    """
    ends = kinematics.capsules(hand, kinematics.link_transforms(hand, q)).reshape(len(q), -1, 3)
    height = jnp.sum(rotations.to_matrix(quaternion)[:, None, 2] * ends, -1) + position[:, 2:]
    return jnp.min(height - np.repeat(hand.capsule_radii, 2), -1)
