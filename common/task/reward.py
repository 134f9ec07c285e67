"""The reward, term by term (paper, section Reward Function). Every term is already weighted and signed."""

import dataclasses

import jax
import jax.numpy as jnp

from common import rotations
from common.config import RewardWeights, TaskConfig
from common.hands.kinematics import grasp_frame
from common.hands.spec import Hand
from common.task.control import in_world, tracked_waypoint
from common.task.features import FAR, Features
from common.task.types import MASKS, Array, Goal, SceneState

jax.tree_util.register_dataclass(
    RewardWeights, data_fields=[field.name for field in dataclasses.fields(RewardWeights)], meta_fields=[]
)

AFFORDANCE_MARGIN = 0.01
"""m, metres the fingers should keep from O-."""
AFFORDANCE_SHARPNESS = 0.002
"""tau, metres."""
_FAR, _TURNED = 0.15, 0.5
"""Errors (m, rad) beyond which tracking costs no more: what a fallen object carries away must not drown all else."""
_GATE_FAR, _GATE_NEAR = 0.10, 0.03
_AFFORDANCE, _FINGER, _WRIST, _TRAJECTORY = range(len(MASKS))

TERMS = tuple(field.name for field in dataclasses.fields(RewardWeights) if field.name != "force_max")
"""Names of the terms; each has the name of its weight."""


def pose_gate(distance: Array) -> Array:
    """g(d): rises linearly from 0 at 0.10 m to 1 at 0.03 m between hand and object."""
    return jnp.clip((_GATE_FAR - distance) / (_GATE_FAR - _GATE_NEAR), 0.0, 1.0)


def fallen(task: TaskConfig, state: SceneState) -> Array:
    """(B,) bool I_drop: the object is `drop_height` below where it started."""
    return state.object_position[..., 2] < state.object_position_initial[..., 2] - task.drop_height


def _square(x: Array) -> Array:
    return jnp.sum(x * x, -1)


def reward_terms(
    hand: Hand, task: TaskConfig, weights: RewardWeights, state: SceneState, features: Features, goal: Goal
) -> dict[str, Array]:
    """Weighted terms (B,) by the names in `TERMS`; the reward is their sum.

    With an affordance active only contacts on O+ earn the contact and force terms: a link that presses on O- must not
    be paid for it.
    """
    link_weights = jnp.array(hand.contact_weights)
    affordance = goal.mask[..., _AFFORDANCE, None] > 0
    rewarded = jnp.where(affordance, features.touching_plus, features.touching)
    rewarded_force = jnp.linalg.norm(jnp.where(affordance[..., None], features.force_plus, features.force), axis=-1)
    total_force = jnp.linalg.norm(features.force, axis=-1)
    minus_force = jnp.linalg.norm(features.force_minus, axis=-1)
    distances = jnp.linalg.norm(features.nearest, axis=-1)
    near = jnp.min(distances, -1)

    turned = rotations.angle(state.object_quaternion, state.object_quaternion_initial)
    position, quaternion = features.wrist_position, features.wrist_quaternion
    pose_position, pose_quaternion = in_world(
        state.object_position, state.object_quaternion, goal.pose_position, goal.pose_quaternion
    )
    waypoint = tracked_waypoint(state, features, goal, task.control.lookahead, current=True)
    mask = goal.mask
    gate = pose_gate(near) * mask[..., _FINGER]
    own_heading = jnp.array(grasp_frame(hand).heading)
    terms = {
        "distance": -jnp.sum(jnp.array(hand.keypoint_weights) * jnp.minimum(distances, FAR), -1),
        "contact": jnp.sum(link_weights * rewarded, -1),
        "force": jnp.sum(
            link_weights * rewarded * jnp.minimum(rewarded_force, weights.force_max) / weights.force_max, -1
        ),
        "force_excess": -jnp.sum(jnp.clip(total_force - weights.force_max, 0.0, 50.0), -1),
        "object_position": -jnp.minimum(_square(state.object_position - state.object_position_initial), 0.04),
        "object_rotation": -jnp.minimum(turned**2, 1.0),
        "wrist_velocity": -jnp.minimum(_square(state.u_velocity), 100.0),
        "finger_deviation": -_square(state.q - state.q_initial),
        "drop": -fallen(task, state).astype(jnp.float32),
        "heading_direction": jnp.sum(own_heading * features.heading_direction, -1),
        "heading_position": -jnp.minimum(jnp.linalg.norm(features.center - features.heading_position, axis=-1), _FAR),
        "pose_finger": -gate * _square(state.q - goal.pose_q),
        "pose_link": -gate * jnp.sum(_square(features.reference_keypoints - features.keypoints), -1),
        "pose_wrist_position": -mask[..., _WRIST] * jnp.minimum(_square(position - pose_position), _FAR**2),
        "pose_wrist_rotation": -mask[..., _WRIST]
        * jnp.minimum(rotations.angle(quaternion, pose_quaternion), _TURNED) ** 2,
        "trajectory_position": -mask[..., _TRAJECTORY] * jnp.minimum(_square(position - waypoint[0]), _FAR**2),
        "trajectory_rotation": -mask[..., _TRAJECTORY]
        * jnp.minimum(rotations.angle(quaternion, waypoint[1]), _TURNED) ** 2,
        "affordance_distance": -mask[..., _AFFORDANCE]
        * jax.nn.softplus((AFFORDANCE_MARGIN - features.distance_minus) / AFFORDANCE_SHARPNESS),
        "affordance_force": -mask[..., _AFFORDANCE] * jnp.sum(jnp.minimum(minus_force, 10.0), -1),
    }
    return {name: getattr(weights, name) * value for name, value in terms.items()}
