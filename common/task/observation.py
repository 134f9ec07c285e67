"""The observation: state and constraint features relative to the hand (paper, section Observation Space)."""

import jax.numpy as jnp

from common import rotations
from common.config import TaskConfig
from common.hands.spec import Hand
from common.task.control import in_world, wrist_to_joints
from common.task.features import Features
from common.task.types import MASKS, Array, Goal, SceneState

OPTIONAL = MASKS
"""Names of the optional blocks; each is gated by the mask bit of its name."""
FORCE_SCALE = 5.0
"""N at which the squashed force is one half."""


def layout(hand: Hand, task: TaskConfig) -> tuple[tuple[str, int], ...]:
    """Names and sizes of the observation's blocks, in order."""
    f, n_links, n_points = len(hand.joints), len(hand.links), len(hand.keypoints)
    return (
        ("state", 3 * f + 18 + 4 * n_links + 3 * n_points + 14),
        ("heading", 21),
        ("affordance", 3 * n_points + 3 * n_links),
        ("pose_finger", f + 3 * n_points),
        ("pose_wrist", 6),
        ("trajectory", 6 * task.trajectory_points),
        ("mask", len(MASKS)),
    )


def squash(force: Array) -> Array:
    """Forces (..., 3) in newtons to vectors shorter than one: f / (|f| + 5 N)."""
    return force / (jnp.linalg.norm(force, axis=-1, keepdims=True) + FORCE_SCALE)


def _flat(x: Array) -> Array:
    return x.reshape(x.shape[0], -1)


def observe(task: TaskConfig, state: SceneState, features: Features, goal: Goal) -> Array:
    """(B, D) observation, laid out as `layout` says; blocks of inactive constraints are zero.

    state: q, u, q_tgt - q, u_tgt - u, their velocities, contact flags, squashed contact forces and nearest-point
    vectors in the wrist frame, the object's velocities and displacement in the wrist frame, time and table.
    heading: p, p-bar, p-bar - p, v-bar and the object's rotation matrix, in the wrist frame.
    affordance: nearest-point vectors to O- and squashed forces from it. pose_finger: q-bar - q, x-bar - x.
    pose_wrist: u-bar - u. trajectory: u-bar^(k) - u for every waypoint. mask: the four bits.
    """
    to_wrist = rotations.conjugate(features.wrist_quaternion)
    turned = rotations.multiply(state.object_quaternion, rotations.conjugate(state.object_quaternion_initial))
    turned = turned * jnp.where(turned[..., :1] < 0, -1.0, 1.0)
    horizon = task.approach_steps + task.hold_steps
    state_block = [
        state.q,
        state.u,
        state.q_target - state.q,
        state.u_target - state.u,
        state.q_velocity,
        state.u_velocity,
        features.touching.astype(jnp.float32),
        _flat(squash(features.force)),
        _flat(features.nearest),
        rotations.rotate(to_wrist, state.object_velocity),
        rotations.rotate(to_wrist, state.object_angular_velocity),
        rotations.rotate(to_wrist, state.object_position - state.object_position_initial),
        rotations.rotate(to_wrist, 2.0 * turned[..., 1:]),
        jnp.stack([jnp.minimum(state.time / horizon, 1.0), state.table.astype(jnp.float32)], -1),
    ]
    heading_block = [
        features.center,
        features.heading_position,
        features.heading_position - features.center,
        features.heading_direction,
        _flat(rotations.to_matrix(features.object_quaternion)),
    ]
    u_pose = wrist_to_joints(
        state, *in_world(state.object_position, state.object_quaternion, goal.pose_position, goal.pose_quaternion)
    )
    u_waypoints = wrist_to_joints(
        state,
        *in_world(state.object_position, state.object_quaternion, goal.trajectory_position, goal.trajectory_quaternion),
    )
    optional = {
        "affordance": [_flat(features.nearest_minus), _flat(squash(features.force_minus))],
        "pose_finger": [goal.pose_q - state.q, _flat(features.reference_keypoints - features.keypoints)],
        "pose_wrist": [u_pose - state.u],
        "trajectory": [_flat(u_waypoints - state.u[..., None, :])],
    }
    gated = [
        jnp.where(goal.mask[..., i : i + 1] > 0, jnp.concatenate(optional[name], -1), 0.0)
        for i, name in enumerate(MASKS)
    ]
    return jnp.concatenate([*state_block, *heading_block, *gated, goal.mask], -1)
