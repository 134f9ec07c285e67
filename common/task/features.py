"""What observation, control, reward and metrics all need from a moment: geometry between hand, object and goal.

Computed once for each control step. All vectors are in the wrist frame unless said otherwise.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from common import rotations
from common.config import TaskConfig
from common.hands import kinematics
from common.hands.spec import Hand
from common.task.types import Array, Goal, SceneState, Surface

FAR = 0.3
"""Metres that stand for "no such surface point"."""


class Features(NamedTuple):
    """Geometry of one control step; batch axis B first."""

    wrist_position: Array
    """(B, 3) world frame."""
    wrist_quaternion: Array
    """(B, 4) world frame."""
    object_position: Array
    """(B, 3) object's centre of mass."""
    object_quaternion: Array
    """(B, 4) object frame to wrist frame."""
    keypoints: Array
    """(B, P, 3) link origins and fingertips."""
    center: Array
    """(B, 3) hand centre p."""
    nearest: Array
    """(B, P, 3) d: from each keypoint to the nearest surface point."""
    nearest_minus: Array
    """(B, P, 3) d-: to the nearest point of O-; zero where the object has none."""
    distance_minus: Array
    """(B,) least distance from the fingers' skin to O-, m; `FAR` where the object has none."""
    force: Array
    """(B, L, 3) f: net contact force on each link, N."""
    touching: Array
    """(B, L) bool b: the link touches the object."""
    touching_plus: Array
    """(B, L) bool: the link touches O+."""
    touching_minus: Array
    """(B, L) bool: the link touches O-."""
    force_plus: Array
    """(B, L, 3) net force from O+."""
    force_minus: Array
    """(B, L, 3) f-: net force from O-."""
    heading_position: Array
    """(B, 3) p-bar."""
    heading_direction: Array
    """(B, 3) v-bar."""
    reference_keypoints: Array
    """(B, P, 3) x-bar: keypoints of the reference pose, carried by its wrist pose in the object frame."""


def wrist_pose(state: SceneState) -> tuple[Array, Array]:
    """The wrist frame's position (B, 3) and quaternion (B, 4) in the world."""
    return rotations.compose_pose(
        state.base_position,
        state.base_quaternion,
        state.u[..., :3],
        rotations.euler_to_quaternion(state.u[..., 3:]),
    )


def squared_distances(a: Array, b: Array) -> Array:
    """(B, M, N) squared distances between points (B, M, 3) and (B, N, 3)."""
    x, y, z = jnp.moveaxis(a[..., :, None, :] - b[..., None, :, :], -1, 0)
    return x * x + y * y + z * z


def _nearest(squared: Array) -> Array:
    """(B, M) index of the least of N squared distances (B, N, M); either of two that differ by less than 0.01 %.

    Floats that are not negative are ordered as their bits are, and the last bits make room for the index: one
    minimum along a vector's lanes, several times faster than `argmin`.
    """
    n = squared.shape[-2]
    room = (1 << (n - 1).bit_length()) - 1
    key = jax.lax.bitcast_convert_type(squared, jnp.int32) & ~room | jnp.arange(n)[:, None]
    return jnp.min(key, -2) & room


def features(hand: Hand, task: TaskConfig, state: SceneState, surface: Surface, goal: Goal) -> Features:
    """Geometry of hand, object and goal at one moment."""
    wrist_position, wrist_quaternion = wrist_pose(state)
    object_position, object_quaternion = rotations.relative_pose(
        wrist_position, wrist_quaternion, state.object_position, state.object_quaternion
    )
    both = jnp.concatenate([state.q, goal.pose_q])
    keypoints, reference = jnp.split(kinematics.keypoints(hand, kinematics.link_transforms(hand, both)), 2)
    if task.dynamic_center:
        center = kinematics.hand_center(hand, keypoints)
    else:
        center = jnp.broadcast_to(jnp.array(kinematics.grasp_frame(hand).center), keypoints[..., 0, :].shape)

    # Distances in the object frame, where coordinates are small and the surface does not move.
    contact_shape = state.contact_found.shape
    local = rotations.inverse_transform(object_position, object_quaternion, keypoints)
    contacts = rotations.inverse_transform(
        state.object_position, state.object_quaternion, state.contact_position.reshape(*contact_shape[:-2], -1, 3)
    )
    squared = squared_distances(surface.points, jnp.concatenate([local, contacts], -2))
    index = _nearest(squared)
    points = len(hand.keypoints)
    index_minus = _nearest(jnp.where(surface.minus[..., None], squared[..., :points], jnp.inf))
    on_minus = jnp.take_along_axis(surface.minus, index[..., points:], -1).reshape(contact_shape)
    has_minus = jnp.any(surface.minus, -1)
    nearest = jnp.take_along_axis(surface.points, index[..., :points, None], -2) - local
    nearest_minus = jnp.take_along_axis(surface.points, index_minus[..., None], -2) - local
    nearest_minus = jnp.where(has_minus[..., None, None], nearest_minus, 0.0)
    skin = jnp.linalg.norm(nearest_minus, axis=-1) - jnp.array(hand.keypoint_radii)
    distance_minus = jnp.where(has_minus, jnp.min(skin[..., 1:], -1), FAR)

    to_wrist = rotations.to_matrix(object_quaternion)
    links = len(hand.links)
    found = state.contact_found
    force = jnp.where(found[..., None], state.contact_force, 0.0).reshape(contacts.shape)
    forces = rotations.apply(jnp.swapaxes(rotations.to_matrix(wrist_quaternion), -1, -2), force)
    forces = forces.reshape(state.contact_force.shape)
    minus_forces = jnp.sum(forces * on_minus[..., None], -2)
    force = jnp.sum(forces, -2)

    heading_position = object_position + rotations.rotate(object_quaternion, goal.heading_position)
    reference = rotations.transform(
        object_position,
        object_quaternion,
        rotations.transform(goal.pose_position, goal.pose_quaternion, reference),
    )
    assert contact_shape[-2] == links, "contact arrays do not belong to this hand"
    return Features(
        wrist_position=wrist_position,
        wrist_quaternion=wrist_quaternion,
        object_position=object_position,
        object_quaternion=object_quaternion,
        keypoints=keypoints,
        center=center,
        nearest=rotations.apply(to_wrist, nearest),
        nearest_minus=rotations.apply(to_wrist, nearest_minus),
        distance_minus=distance_minus,
        force=force,
        touching=jnp.any(found, -1),
        touching_plus=jnp.any(found & ~on_minus, -1),
        touching_minus=jnp.any(found & on_minus, -1),
        force_plus=force - minus_forces,
        force_minus=minus_forces,
        heading_position=heading_position,
        heading_direction=rotations.rotate(object_quaternion, goal.heading_direction),
        reference_keypoints=reference,
    )
