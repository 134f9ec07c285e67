"""From actions to joint targets: incremental fingers and feed-forward wrist guidance (paper, section Control Space)."""

import jax
import jax.numpy as jnp

from common import rotations
from common.config import ControlConfig
from common.hands import kinematics
from common.hands.spec import Hand
from common.task.features import Features
from common.task.types import MASKS, Action, Array, Goal, SceneState

_POSE = MASKS.index("pose_wrist")
_TRAJECTORY = MASKS.index("trajectory")

jax.tree_util.register_dataclass(
    ControlConfig,
    data_fields=[
        "finger_scale",
        "wrist_position_scale",
        "wrist_rotation_scale",
        "guidance_position_limit",
        "guidance_rotation_limit",
    ],
    meta_fields=["lookahead", "follow_object"],
)


def wrist_to_joints(state: SceneState, position: Array, quaternion: Array) -> Array:
    """Virtual wrist joints (B, ..., 6) that put the wrist at world poses (B, ..., 3), (B, ..., 4)."""
    extra = position.ndim - 2
    base_position = state.base_position.reshape(-1, *([1] * extra), 3)
    base_quaternion = state.base_quaternion.reshape(-1, *([1] * extra), 4)
    local, turned = rotations.relative_pose(
        base_position, jnp.broadcast_to(base_quaternion, quaternion.shape), position, quaternion
    )
    return jnp.concatenate([local, rotations.quaternion_to_euler(turned)], -1)


def in_world(object_position: Array, object_quaternion: Array, position: Array, quaternion: Array) -> tuple[Array, ...]:
    """Poses (B, ..., 3), (B, ..., 4) of the object frame in the world, for object poses (B, 3), (B, 4)."""
    extra = position.ndim - 2
    origin = object_position.reshape(-1, *([1] * extra), 3)
    turn = jnp.broadcast_to(object_quaternion.reshape(-1, *([1] * extra), 4), quaternion.shape)
    return rotations.compose_pose(origin, turn, position, quaternion)


def heading_wrist_pose(hand: Hand, goal: Goal, center: Array) -> tuple[Array, Array]:
    """Wrist pose in the object frame (B, 3), (B, 4) that aligns v, w and the hand centre with the heading.

    Args:
      hand: the hand.
      goal: its heading fields are used.
      center: (B, 3) hand centre in the wrist frame.
    """
    frame = kinematics.grasp_frame(hand)
    own = rotations.frame_from_axes(jnp.array(frame.heading), jnp.array(frame.cross))
    target = rotations.frame_from_axes(goal.heading_direction, goal.heading_cross)
    quaternion = rotations.multiply(target, rotations.conjugate(own))
    return goal.heading_position - rotations.rotate(quaternion, center), quaternion


def active_waypoint(wrist_position: Array, waypoints: Array, lookahead: int) -> Array:
    """(B,) index min(k* + lookahead, K - 1), with k* the waypoint (B, K, 3) nearest to the wrist (B, 3)."""
    nearest = jnp.argmin(jnp.sum((waypoints - wrist_position[..., None, :]) ** 2, -1), -1)
    return jnp.minimum(nearest + lookahead, waypoints.shape[-2] - 1)


def tracked_waypoint(
    state: SceneState, features: Features, goal: Goal, lookahead: int, *, current: bool
) -> tuple[Array, Array]:
    """World pose (B, 3), (B, 4) of the active waypoint, on the object's current or initial pose."""
    position = state.object_position if current else state.object_position_initial
    quaternion = state.object_quaternion if current else state.object_quaternion_initial
    points, turns = in_world(position, quaternion, goal.trajectory_position, goal.trajectory_quaternion)
    index = active_waypoint(features.wrist_position, points, lookahead)[..., None, None]
    return (
        jnp.take_along_axis(points, index, -2)[..., 0, :],
        jnp.take_along_axis(turns, index, -2)[..., 0, :],
    )


def guidance_pose(
    hand: Hand, control: ControlConfig, state: SceneState, features: Features, goal: Goal
) -> tuple[Array, Array]:
    """World wrist pose T^g (B, 3), (B, 4) of the highest active wrist constraint."""
    position, quaternion = heading_wrist_pose(hand, goal, features.center)
    pose = goal.mask[..., _POSE : _POSE + 1] > 0
    position = jnp.where(pose, goal.pose_position, position)
    quaternion = jnp.where(pose, goal.pose_quaternion, quaternion)
    current = control.follow_object
    position, quaternion = in_world(
        state.object_position if current else state.object_position_initial,
        state.object_quaternion if current else state.object_quaternion_initial,
        position,
        quaternion,
    )
    waypoint = tracked_waypoint(state, features, goal, control.lookahead, current=current)
    trajectory = goal.mask[..., _TRAJECTORY : _TRAJECTORY + 1] > 0
    return jnp.where(trajectory, waypoint[0], position), jnp.where(trajectory, waypoint[1], quaternion)


def decode(
    hand: Hand, control: ControlConfig, state: SceneState, features: Features, goal: Goal, action: Array
) -> Action:
    """Joint targets of a residual action (B, F + 6).

    q_tgt = clamp(q_tgt_prev + alpha_f a_f, limits); u_tgt = u_g + alpha_w a_w, where u_g is at most the guidance
    limits ahead of the wrist's present joints.
    """
    fingers = len(hand.joints)
    q_target = jnp.clip(
        state.q_target + control.finger_scale * action[..., :fingers], jnp.array(hand.lower), jnp.array(hand.upper)
    )
    u_guidance = wrist_to_joints(state, *guidance_pose(hand, control, state, features, goal))
    ahead = u_guidance - state.u
    turn = jnp.mod(ahead[..., 3:] + jnp.pi, 2 * jnp.pi) - jnp.pi
    limited = jnp.concatenate(
        [_limit(ahead[..., :3], control.guidance_position_limit), _limit(turn, control.guidance_rotation_limit)], -1
    )
    residual = jnp.concatenate(
        [
            control.wrist_position_scale * action[..., fingers : fingers + 3],
            control.wrist_rotation_scale * action[..., fingers + 3 :],
        ],
        -1,
    )
    return Action(q_target, state.u + limited + residual)


def _limit(vector: Array, length: float) -> Array:
    """Vectors (..., 3) shortened to at most `length`."""
    norm = jnp.sqrt(jnp.sum(vector**2, -1, keepdims=True) + 1e-12)
    return vector * jnp.minimum(1.0, length / norm)
