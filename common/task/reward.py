"""The reward, term by term (paper, section Reward Function). Every term is already weighted and signed."""

import dataclasses

import jax
import jax.numpy as jnp

from common import rotations
from common.config import GraspWeights, RewardWeights, TaskConfig
from common.task.constraints import known
from common.task.constraints.base import Scene
from common.task.geometry import FAR, square
from common.task.types import Array, SceneState

jax.tree_util.register_dataclass(
    RewardWeights, data_fields=[field.name for field in dataclasses.fields(RewardWeights)], meta_fields=[]
)

_GRASP = tuple(field.name for field in dataclasses.fields(GraspWeights) if field.name != "force_max")


def terms(task: TaskConfig) -> tuple[str, ...]:
    """Names of the terms, each of which has the name of its weight: the grasp's, then those of the constraints."""
    return (*_GRASP, *(weight.name for constraint in known(task) for weight in constraint.weights))


def fallen(task: TaskConfig, state: SceneState) -> Array:
    """(B,) bool I_drop: the object is `drop_height` below where it started."""
    return state.object_position[..., 2] < state.object_position_initial[..., 2] - task.drop_height


def reward_terms(scene: Scene, weights: RewardWeights) -> dict[str, Array]:
    """Weighted terms (B,) by the names in `terms`; the reward is their sum."""
    found = _grasp_terms(scene, weights)
    for constraint in known(scene.task):
        found |= constraint.reward(scene)
    return {name: getattr(weights, name) * value for name, value in found.items()}


def _grasp_terms(scene: Scene, weights: RewardWeights) -> dict[str, Array]:
    """r^grasp before the weights; contacts that an active constraint forbids earn nothing."""
    hand, task, state, features = scene.hand, scene.task, scene.state, scene.features
    touching, force = features.touching, features.force
    for constraint in known(task):
        touching, force = constraint.earning(scene, touching, force)
    link_weights = jnp.array(hand.contact_weights)
    earned = jnp.linalg.norm(force, axis=-1)
    total = jnp.linalg.norm(features.force, axis=-1)
    distances = jnp.linalg.norm(features.nearest, axis=-1)
    turned = rotations.angle(state.object_quaternion, state.object_quaternion_initial)
    return {
        "distance": -jnp.sum(jnp.array(hand.keypoint_weights) * jnp.minimum(distances, FAR), -1),
        "contact": jnp.sum(link_weights * touching, -1),
        "force": jnp.sum(link_weights * touching * jnp.minimum(earned, weights.force_max) / weights.force_max, -1),
        "force_excess": -jnp.sum(jnp.clip(total - weights.force_max, 0.0, 50.0), -1),
        "object_position": -jnp.minimum(square(state.object_position - state.object_position_initial), 0.04),
        "object_rotation": -jnp.minimum(turned**2, 1.0),
        "wrist_velocity": -jnp.minimum(square(state.u_velocity), 100.0),
        "finger_deviation": -square(state.q - state.q_initial),
        "drop": -fallen(task, state).astype(jnp.float32),
    }
