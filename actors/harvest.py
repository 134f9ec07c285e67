"""Reference poses and trajectories from the policy's grasps (paper, section Hand Morphology).

Final states of successful episodes periodically replace poses of the constraint bank, unless a
constraint excludes them (`Constraint.harvested`). Many of the goals of later episodes are thus
feasible for this hand.
"""

import functools
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from congrasp.actors.physics.engine import where_environments
from congrasp.common import rotations
from congrasp.common.hands.spec import Hand
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import get_constraint, optional
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.sampling.closed_poses import Poses
from congrasp.common.task.sampling.references import make_references
from congrasp.common.task.scene import Scene
from congrasp.common.task.types import Array


class Grasps(NamedTuple):
    """Final states of grasps in a batch of environments, in the object frame."""

    found: Array
    """(B,) bool: the environment had a successful episode since its grasp was last taken."""
    object_index: Array
    """(B,) int."""
    region: Array
    """(B,) int, index along the axis V of the constraint bank."""
    q: Array
    """(B, F) finger angles."""
    position: Array
    """(B, 3) wrist."""
    quaternion: Array
    """(B, 4)."""


def collect(
    scene: Scene,
    grasps: Grasps,
    error: Mapping[str, tuple[Array, Array]],
    up: Array,
    object_index: Array,
    region: Array,
) -> Grasps:
    """Adds the grasps that succeed in a control step.

    They must be close to their heading, and under constraints that allow references.

    Args:
      scene: the control step.
      grasps: grasps before the step.
      error: errors of the step by name: numerators and denominators (B,).
      up: (B,) bool: the object has not fallen.
      object_index: (B,) int, indices of the objects.
      region: (B,) int, indices along the axis V of the constraint bank.
    """
    task = scene.task
    now = (scene.state.time == task.approach_steps + task.hold_steps) & up
    for spec in get_constraint("heading").errors:
        now &= error[spec.name][0] < spec.tolerance
    for constraint in optional(task):
        if not constraint.harvested:
            now &= ~constraint.active(scene.goal)
    position, quaternion = rotations.relative_pose(
        scene.state.object_position,
        scene.state.object_quaternion,
        scene.features.wrist_position,
        scene.features.wrist_quaternion,
    )
    fresh = Grasps(now, object_index, region, scene.state.q, position, quaternion)
    return Grasps(grasps.found | now, *where_environments(now, fresh[1:], grasps[1:]))


@functools.partial(jax.jit, static_argnames=("hand", "task"))
def renew(
    hand: Hand, task: TaskConfig, bank: ConstraintBank, grasps: Grasps, key: Array
) -> ConstraintBank:
    """Replaces random reference poses in the constraint bank by grasps of the same objects and
    regions.

    Entries that are not allowed in any resting pose are replaced first; of the others only the
    first half. These form a reservoir (Vitter 1985, algorithm R): after n grasps of an object and
    region, a further one is stored with probability places / n, so that the references come from
    the policy at all ages, not only from the current one. A policy trained with references from its
    latest grasps only held 97 % of these, but 66 % of another policy's.
    """
    slot_key, path_key, chance_key = jax.random.split(key, 3)
    objects = bank.pose_q.shape[0]
    fresh = Poses(grasps.q, grasps.position, grasps.quaternion)
    path, turns, valid = make_references(
        hand,
        fresh,
        bank.rest[grasps.object_index],
        path_key,
        task.trajectory_points,
        task.human_paths,
    )
    objects_and_regions = (grasps.object_index, grasps.region)
    usable = grasps.found & valid.any(-1) & bank.renewable[grasps.object_index]
    counts = bank.grasps.at[objects_and_regions].add(usable.astype(bank.grasps.dtype))
    unused = ~bank.pose_valid[objects_and_regions].any(1)
    entries = unused.shape[1]
    places = entries // 2
    chance = places / jnp.maximum(bank.grasps[objects_and_regions], places)
    usable &= unused.any(1) | (jax.random.uniform(chance_key, chance.shape) < chance)
    is_in_reservoir = jnp.arange(entries) < places
    priority = is_in_reservoir * jax.random.uniform(slot_key, unused.shape)
    slot = jnp.argmax(2.0 * unused + priority, -1)
    place = (*objects_and_regions, slot)
    # Of several grasps for one entry the last is used for all arrays: a scatter would mix them on a
    # GPU.
    number = jnp.arange(slot.size)
    taken = jnp.full(bank.pose_q.shape[:3], -1).at[place].max(jnp.where(usable, number, -1))
    # Writes outside an array are dropped.
    row = jnp.where(usable & (taken[place] == number), grasps.object_index, objects)
    where = row, grasps.region, slot
    return bank._replace(
        pose_q=bank.pose_q.at[where].set(fresh.q, mode="drop"),
        pose_position=bank.pose_position.at[where].set(fresh.position, mode="drop"),
        pose_quaternion=bank.pose_quaternion.at[where].set(fresh.quaternion, mode="drop"),
        trajectory_position=bank.trajectory_position.at[where].set(path, mode="drop"),
        trajectory_quaternion=bank.trajectory_quaternion.at[where].set(turns, mode="drop"),
        pose_valid=bank.pose_valid.at[row, grasps.region, :, slot].set(valid, mode="drop"),
        grasps=counts,
    )
