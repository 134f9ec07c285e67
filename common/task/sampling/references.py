"""Reference poses and wrist trajectories of a constraint bank."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common.hands.spec import Hand
from congrasp.common.task.sampling.closed_poses import Poses, closed_poses
from congrasp.common.task.sampling.headings import Headings
from congrasp.common.task.sampling.object_headings import POSES
from congrasp.common.task.sampling.table import (
    SOFT,
    above_table,
    clear_of_table,
    height_over_table,
)
from congrasp.common.task.sampling.trajectories import HUMAN, make_trajectories
from congrasp.common.task.types import Array

_OBJECTS_TOGETHER = 16
"""Objects grasped in one batch of closing hands, enough to occupy an accelerator."""
_CANDIDATES = 4
"""Human trajectories drawn for each pose, of which the one clearest of the table is taken."""


class Grasped(NamedTuple):
    """N objects that a hand closes around, and the headings of these grasps."""

    points: Array
    """(N, P, 3) surface points."""
    normals: Array
    """(N, P, 3) outward unit normals at the points."""
    headings: Headings
    """(N, V, M, 3) headings of the references."""
    rest: Array
    """(N, R, 7) resting poses."""


@functools.partial(jax.jit, static_argnames=("hand", "waypoints", "human_paths"))
def closed_references(
    hand: Hand, grasped: Grasped, key: Array, *, waypoints: int, human_paths: float
) -> dict[str, Array]:
    """Poses and trajectories of the bank, by closing the hand around the objects.

    Args:
      hand: the hand.
      grasped: the objects.
      key: random key of the trajectories.
      waypoints: number K of waypoints.
      human_paths: see `make_references`.
    """
    poses = _closed(hand, grasped)
    return reference_columns(hand, poses, grasped.rest, key, waypoints, human_paths)


def unusable_references(
    hand: Hand, grasped: Grasped, key: Array, *, waypoints: int, human_paths: float
) -> dict[str, np.ndarray]:
    """As many poses and trajectories as `closed_references` makes, none of them usable; same
    arguments.
    """
    shape = grasped.headings.direction.shape[:-1]
    count, regions, poses = shape
    rests = grasped.rest.shape[1]
    level = np.array([1.0, 0.0, 0.0, 0.0], np.float32)
    return {
        "pose_q": np.zeros((*shape, len(hand.joints)), np.float32),
        "pose_position": np.zeros((*shape, 3), np.float32),
        "pose_quaternion": np.broadcast_to(level, (*shape, 4)),
        "trajectory_position": np.zeros((*shape, waypoints, 3), np.float32),
        "trajectory_quaternion": np.broadcast_to(level, (*shape, waypoints, 4)),
        "pose_valid": np.zeros((count, regions, rests, poses), bool),
    }


@functools.partial(jax.jit, static_argnames=("hand", "waypoints", "human_paths"))
def reference_columns(
    hand: Hand,
    poses: Poses,
    rest: Array,
    key: Array,
    waypoints: int,
    human_paths: float = 0.0,
) -> dict[str, Array]:
    """Columns of the bank of poses (N, V, M, ...) and of trajectories to them, for resting poses
    (N, R, 7).
    """
    shape = poses.q.shape[:-1]
    flat = Poses(*[field.reshape(-1, field.shape[-1]) for field in poses])
    rest = jnp.repeat(rest, shape[1] * shape[2], axis=0)
    path, turns, valid = make_references(hand, flat, rest, key, waypoints, human_paths)
    return {
        "pose_q": poses.q,
        "pose_position": poses.position,
        "pose_quaternion": poses.quaternion,
        "trajectory_position": path.reshape(*shape, *path.shape[1:]),
        "trajectory_quaternion": turns.reshape(*shape, *turns.shape[1:]),
        "pose_valid": jnp.swapaxes(valid.reshape(*shape, -1), -1, -2),
    }


@functools.partial(jax.jit, static_argnames=("hand", "waypoints", "human_paths"))
def make_references(
    hand: Hand,
    poses: Poses,
    rest: Array,
    key: Array,
    waypoints: int,
    human_paths: float = 0.0,
) -> tuple[Array, Array, Array]:
    """Generates a trajectory to each of M reference poses, and checks in which resting poses they
    are usable.

    Args:
      hand: the hand.
      poses: M poses.
      rest: (M, R, 7) resting poses of the poses' objects.
      key: random key of the trajectories.
      waypoints: number K of waypoints.
      human_paths: share of the trajectories in the style `trajectories.HUMAN`.

    Returns:
      Trajectories (M, K, 3) and (M, K, 4), and a mask (M, R) of usable resting poses.
    """
    path, turns = make_trajectories(
        hand, poses.position, poses.quaternion, key, waypoints=waypoints
    )
    if human_paths:
        share_key, human_key = jax.random.split(jax.random.fold_in(key, 1))
        chosen = jax.random.uniform(share_key, (len(path), 1, 1)) < human_paths
        human_path, human_turns = _clearest_human_paths(hand, poses, rest, human_key, waypoints)
        path = jnp.where(chosen, human_path, path)
        turns = jnp.where(chosen, human_turns, turns)
    above = height_over_table(hand, poses.q, path, turns, rest) > -SOFT
    return path, turns, clear_of_table(hand, poses.quaternion, path, rest) & above


def _clearest_human_paths(
    hand: Hand, poses: Poses, rest: Array, key: Array, waypoints: int
) -> tuple[Array, Array]:
    """Draws four trajectories in the style `HUMAN` to each of M poses and returns the one that
    stays above the table in most resting poses.

    Many directions at 75 degrees to a level heading begin below the table; people come from above.

    Returns:
      Trajectories (M, K, 3) and (M, K, 4).
    """

    def candidate(key: Array) -> tuple[Array, Array]:
        return make_trajectories(
            hand, poses.position, poses.quaternion, key, waypoints=waypoints, style=HUMAN
        )

    paths, turns = jax.lax.map(candidate, jax.random.split(key, _CANDIDATES))
    clear = jax.vmap(lambda path: jnp.sum(above_table(path, rest), -1))(paths)
    best = jnp.argmax(clear, 0)
    rows = jnp.arange(len(best))
    return paths[best, rows], turns[best, rows]


def _closed(hand: Hand, grasped: Grasped) -> Poses:
    """Reference poses (N, V, M, ...) by closing the hand around the objects."""

    def of_object(row: tuple[Array, Array, Headings]) -> Poses:
        points, normals, headings = row
        rows = [field.reshape(-1, 3) for field in headings]
        flat = closed_poses(hand, points, normals, *rows)
        return Poses(*[field.reshape(2, POSES, -1) for field in flat])

    rows = grasped.points, grasped.normals, grasped.headings
    return jax.lax.map(of_object, rows, batch_size=min(_OBJECTS_TOGETHER, len(grasped.points)))
