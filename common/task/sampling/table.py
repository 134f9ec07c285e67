"""Clearance of reference poses and wrist paths over the table, in the resting poses of objects."""

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common import rotations
from congrasp.common.hands import kinematics
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.spec import Hand
from congrasp.common.task.types import Array

SOFT = 0.002
"""Depth of fingers in the table that is tolerated because contacts are soft, m."""
_WAYPOINT_CLEARANCE = 0.02
"""Height over the table that every waypoint of a trajectory keeps, m."""
_STEEPEST_UP = 0.1
"""Largest upward component of a reference pose's approach direction."""
_BATCH = 2048
"""References whose heights are computed together."""


def height_over_table(hand: Hand, q: Array, path: Array, turns: Array, rest: Array) -> Array:
    """Least height (M, R) in m of a hand's capsules over the table along the path to each of M
    reference poses.

    Args:
      hand: the hand.
      q: (M, F) finger angles of the poses.
      path: (M, K, 3) wrist waypoints, in the object frame.
      turns: (M, K, 4) wrist orientations of the waypoints.
      rest: (M, R, 7) resting poses of the objects.
    """
    return jax.lax.map(
        lambda row: _height_along_path(hand, *row), (q, path, turns, rest), batch_size=_BATCH
    )


def _height_along_path(hand: Hand, q: Array, path: Array, turns: Array, rest: Array) -> Array:
    """`height_over_table` (R,) of one reference, m."""
    ends = kinematics.capsules(hand, kinematics.link_transforms(hand, q)).reshape(-1, 3)
    ends = rotations.transform(path, turns, jnp.broadcast_to(ends, (len(path), *ends.shape)))
    up = rotations.to_matrix(rest[:, 3:])[:, None, None, 2]
    height = jnp.sum(up * ends, -1) + rest[:, None, None, 2] - np.repeat(hand.capsule_radii, 2)
    return jnp.min(height, (1, 2))


def clear_of_table(hand: Hand, quaternion: Array, path: Array, rest: Array) -> Array:
    """(M, R) bool: the approach of a reference pose is from above or level, and the trajectory
    stays above the table.

    Args:
      hand: the hand, for its heading axis.
      quaternion: (M, 4) wrist orientations of the poses, in the object frame.
      path: (M, K, 3) wrist waypoints.
      rest: (M, R, 7) resting poses of the objects.
    """
    axis = jnp.array(grasp_frame(hand).heading)
    heading = rotations.rotate(quaternion, jnp.broadcast_to(axis, (*quaternion.shape[:-1], 3)))
    up = rotations.to_matrix(rest[..., 3:])[..., 2, :]
    rising = jnp.einsum("mri,mi->mr", up, heading)
    return above_table(path, rest) & (rising < _STEEPEST_UP)


def above_table(path: Array, rest: Array) -> Array:
    """(M, R) bool: all waypoints (M, K, 3) of a wrist are above the table, in resting poses (M, R,
    7) of objects.
    """
    up = rotations.to_matrix(rest[..., 3:])[..., 2, :]
    height = jnp.min(jnp.einsum("mri,mki->mrk", up, path), -1) + rest[..., 2]
    return height > _WAYPOINT_CLEARANCE
