"""Success protocol of an episode: the object is held after the table's removal."""

from typing import NamedTuple

import jax.numpy as jnp

from congrasp.common.task.config import TaskConfig
from congrasp.common.task.reward import fallen
from congrasp.common.task.scene import Scene
from congrasp.common.task.types import Array


class Success(NamedTuple):
    """Progress of the success protocol in B episodes."""

    removal_height: Array
    """(B,) height of the object when the table was removed, m."""
    links_at_removal: Array
    """(B,) number of links in contact at that time."""
    moved_at_removal: Array
    """(B,) displacement of the object up to that time, m."""
    succeeded: Array
    """(B,) bool: the object had not fallen `hold_steps` after the removal (the paper's success)."""
    diverged: Array
    """(B,) bool: the physics diverged in this episode."""


def begin_success(height: Array) -> Success:
    """Returns the initial progress of episodes whose objects start at these heights (B,)."""
    zero = jnp.zeros_like(height)
    no = jnp.zeros(height.shape, bool)
    return Success(
        removal_height=height,
        links_at_removal=zero,
        moved_at_removal=zero,
        succeeded=no,
        diverged=no,
    )


def track_success(
    task: TaskConfig, success: Success, scene: Scene, diverged: Array
) -> tuple[Success, Array]:
    """Advances the protocol by one control step.

    Args:
      task: the task, for the time of the table's removal and the drop height.
      success: progress before the step.
      scene: scene after the step.
      diverged: (B,) bool, True if the physics diverged in this step.

    Returns:
      Progress after the step, and (B,) bool, True if the object is up.
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
    above_drop = height > success.removal_height - task.drop_height
    up = above_drop & ~fallen(task, state) & ~success.diverged
    up &= success.links_at_removal > 0
    ends_now = state.time == task.approach_steps + task.hold_steps
    return success._replace(succeeded=jnp.where(ends_now, up, success.succeeded)), up
