"""The success protocol: the table is removed, and the object must stay up (paper, section Metrics)."""

from typing import NamedTuple

import jax.numpy as jnp

from congrasp.common.config import TaskConfig
from congrasp.common.task.constraints.base import Scene
from congrasp.common.task.reward import fallen
from congrasp.common.task.types import Array


class Success(NamedTuple):
    """What is known so far of the success of B episodes."""

    removal_height: Array
    """(B,) object's height when the table was removed, m."""
    links_at_removal: Array
    """(B,) links in contact then."""
    moved_at_removal: Array
    """(B,) metres the object had moved by then."""
    kept: Array
    """(B,) bool: the object had not fallen `hold_steps` after the removal (the paper's success)."""
    diverged: Array
    """(B,) bool: the physics diverged in this episode."""


def begin(height: Array) -> Success:
    """Episodes whose objects start at these heights (B,)."""
    zero, no = jnp.zeros_like(height), jnp.zeros(height.shape, bool)
    return Success(height, zero, zero, no, no)


def track(task: TaskConfig, success: Success, scene: Scene, diverged: Array) -> tuple[Success, Array]:
    """One control step further.

    Args:
      task: when the table is removed, and from where on an object has fallen.
      success: before the step.
      scene: after it.
      diverged: (B,) bool, in this step.

    Returns:
      After the step, and (B,) bool whether the object is up.
    """
    state = scene.state
    removed_now = state.time == task.approach_steps
    height = state.object_position[:, 2]
    links = jnp.sum(scene.features.touching, -1).astype(jnp.float32)
    moved = jnp.linalg.norm(state.object_position - state.object_position_initial, axis=-1)
    success = success._replace(
        removal_height=jnp.where(removed_now, height, success.removal_height),
        links_at_removal=jnp.where(removed_now, links, success.links_at_removal),
        moved_at_removal=jnp.where(removed_now, moved, success.moved_at_removal),
        diverged=success.diverged | diverged,
    )
    up = (height > success.removal_height - task.drop_height) & ~fallen(task, state) & ~success.diverged
    up &= success.links_at_removal > 0
    return success._replace(kept=jnp.where(state.time == task.approach_steps + task.hold_steps, up, success.kept)), up
