"""Errors of one moment, with the paper's definitions (section Metrics); episodes average them over their window."""

from typing import NamedTuple

import jax.numpy as jnp

from common import rotations
from common.config import TaskConfig
from common.hands.kinematics import grasp_frame
from common.hands.spec import Hand
from common.task.control import in_world, tracked_waypoint, wrist_to_joints
from common.task.features import Features
from common.task.types import Array, Goal, SceneState


class Errors(NamedTuple):
    """Errors (B,) of one control step, whether or not their constraint is active."""

    heading_rad: Array
    """Geodesic distance between v and v-bar; averaged after the table's removal."""
    heading_m: Array
    """Length of p - p-bar projected on the plane perpendicular to v-bar; after removal."""
    pose_rad: Array
    """Mean absolute error of the finger joints and the three wrist hinges; after removal."""
    pose_m: Array
    """Distance of the wrist from its reference position; after removal."""
    trajectory_rad: Array
    """Geodesic distance between the wrist and the tracked waypoint; before removal."""
    trajectory_m: Array
    """Distance between the wrist and the tracked waypoint; before removal."""
    minus_links: Array
    """Number of links that touch O-; the affordance ratio divides sums over the steps after removal."""
    any_links: Array
    """Number of touches of links on O+ or O- (a link on both counts once)."""


def errors(hand: Hand, task: TaskConfig, state: SceneState, features: Features, goal: Goal) -> Errors:
    """The errors of a batch at one moment."""
    heading = jnp.array(grasp_frame(hand).heading)
    target = features.heading_direction
    cosine = jnp.sum(heading * target, -1)
    sine = jnp.linalg.norm(jnp.cross(jnp.broadcast_to(heading, target.shape), target), axis=-1)
    off = features.center - features.heading_position
    lateral = off - jnp.sum(off * target, -1, keepdims=True) * target

    position, quaternion = in_world(
        state.object_position, state.object_quaternion, goal.pose_position, goal.pose_quaternion
    )
    hinges = wrist_to_joints(state, position, quaternion)[..., 3:] - state.u[..., 3:]
    hinges = jnp.mod(hinges + jnp.pi, 2 * jnp.pi) - jnp.pi
    angles = jnp.concatenate([state.q - goal.pose_q, hinges], -1)
    waypoint = tracked_waypoint(state, features, goal, task.control.lookahead, current=True)
    return Errors(
        heading_rad=jnp.arctan2(sine, cosine),
        heading_m=jnp.linalg.norm(lateral, axis=-1),
        pose_rad=jnp.mean(jnp.abs(angles), -1),
        pose_m=jnp.linalg.norm(features.wrist_position - position, axis=-1),
        trajectory_rad=rotations.angle(features.wrist_quaternion, waypoint[1]),
        trajectory_m=jnp.linalg.norm(features.wrist_position - waypoint[0], axis=-1),
        minus_links=jnp.sum(features.touching_minus, -1).astype(jnp.float32),
        any_links=jnp.sum(features.touching, -1).astype(jnp.float32),
    )
