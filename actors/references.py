"""Reference poses and trajectories from the policy's own grasps (paper, section Hand Morphology).

Successful episodes under a heading alone leave their final states behind; now and then these replace poses of the task
set, so that what later episodes ask for is what this hand can do.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from actors.taskset import TaskSet, make_references
from common.config import TaskConfig
from common.constraints.poses import Poses
from common.hands.spec import Hand
from common.task.types import Array

MAX_HEADING_RAD, MAX_HEADING_M = 0.25, 0.03
"""Largest errors of a heading whose grasp becomes a reference."""


class Grasps(NamedTuple):
    """Final states of the grasps of a batch of worlds, in the object frame."""

    found: Array
    """(B,) bool: the world had a successful episode since its grasp was last taken."""
    object_index: Array
    """(B,) int."""
    variant: Array
    """(B,) int, the axis V of the task set."""
    q: Array
    """(B, F) finger angles."""
    position: Array
    """(B, 3) wrist."""
    quaternion: Array
    """(B, 4)."""


@functools.partial(jax.jit, static_argnames=("hand", "task"))
def renew(hand: Hand, task: TaskConfig, taskset: TaskSet, grasps: Grasps, key: Array) -> TaskSet:
    """The task set with each grasp in the place of a random reference pose of its object and variant.

    Places whose pose no resting pose allows are taken first.
    """
    slot_key, path_key = jax.random.split(key)
    objects = taskset.pose_q.shape[0]
    fresh = Poses(grasps.q, grasps.position, grasps.quaternion)
    path, turns, valid = make_references(
        hand, fresh, taskset.rest[grasps.object_index], path_key, task.trajectory_points
    )
    unused = ~taskset.pose_valid[grasps.object_index, grasps.variant].any(1)
    slot = jnp.argmax(unused + jax.random.uniform(slot_key, unused.shape), -1)
    place = grasps.object_index, grasps.variant, slot
    # Of several grasps for one place the last is taken, in all arrays: a scatter would mix them on a GPU.
    number = jnp.arange(slot.size)
    usable = grasps.found & valid.any(-1)
    taken = jnp.full(taskset.pose_q.shape[:3], -1).at[place].max(jnp.where(usable, number, -1))
    # What is written outside of an array is dropped.
    row = jnp.where(usable & (taken[place] == number), grasps.object_index, objects)
    where = row, grasps.variant, slot
    return taskset._replace(
        pose_q=taskset.pose_q.at[where].set(fresh.q, mode="drop"),
        pose_position=taskset.pose_position.at[where].set(fresh.position, mode="drop"),
        pose_quaternion=taskset.pose_quaternion.at[where].set(fresh.quaternion, mode="drop"),
        trajectory_position=taskset.trajectory_position.at[where].set(path, mode="drop"),
        trajectory_quaternion=taskset.trajectory_quaternion.at[where].set(turns, mode="drop"),
        pose_valid=taskset.pose_valid.at[row, grasps.variant, :, slot].set(valid, mode="drop"),
    )
