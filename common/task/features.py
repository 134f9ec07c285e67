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

_EXACT = jax.lax.Precision.HIGHEST
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
    """(B, M, N) squared distances between points (B, M, 3) and (B, N, 3), as one matrix product."""
    cross = jnp.einsum("bmi,bni->bmn", a, b, precision=_EXACT)
    return jnp.sum(a * a, -1)[..., :, None] - 2.0 * cross + jnp.sum(b * b, -1)[..., None, :]


def _towards(points: Array, surface: Array, squared: Array) -> Array:
    """Vectors from points (B, M, 3) to the surface points (B, N, 3) of least squared distance (B, M, N)."""
    index = jnp.argmin(squared, -1)
    return jnp.take_along_axis(surface, index[..., None], -2) - points


def features(hand: Hand, task: TaskConfig, state: SceneState, surface: Surface, goal: Goal) -> Features:
    """Geometry of hand, object and goal at one moment."""
    wrist_position, wrist_quaternion = wrist_pose(state)
    object_position, object_quaternion = rotations.relative_pose(
        wrist_position, wrist_quaternion, state.object_position, state.object_quaternion
    )
    transforms = kinematics.link_transforms(hand, state.q)
    keypoints = kinematics.keypoints(hand, transforms)
    if task.dynamic_center:
        center = kinematics.hand_center(hand, keypoints)
    else:
        center = jnp.broadcast_to(jnp.array(kinematics.grasp_frame(hand).center), keypoints[..., 0, :].shape)

    # Distances in the object frame, where coordinates are small and the surface does not move.
    local = rotations.inverse_transform(object_position, object_quaternion, keypoints)
    squared = squared_distances(local, surface.points)
    to_wrist = rotations.to_matrix(object_quaternion)
    squared_minus = jnp.where(surface.minus[..., None, :], squared, jnp.inf)
    has_minus = jnp.any(surface.minus, -1)
    nearest = _towards(local, surface.points, squared)
    nearest_minus = jnp.where(has_minus[..., None, None], _towards(local, surface.points, squared_minus), 0.0)
    skin = jnp.linalg.norm(nearest_minus, axis=-1) - jnp.array(hand.keypoint_radii)
    distance_minus = jnp.where(has_minus, jnp.min(skin[..., 1:], -1), FAR)

    links = len(hand.links)
    contact_shape = state.contact_found.shape
    contacts = rotations.inverse_transform(
        state.object_position,
        state.object_quaternion,
        state.contact_position.reshape(*contact_shape[:-2], -1, 3),
    )
    squared_contact = squared_distances(contacts, surface.points)
    on_minus = (
        jnp.min(jnp.where(surface.minus[..., None, :], squared_contact, jnp.inf), -1)
        < jnp.min(jnp.where(surface.minus[..., None, :], jnp.inf, squared_contact), -1)
    ).reshape(contact_shape)
    world_to_wrist = jnp.swapaxes(rotations.to_matrix(wrist_quaternion), -1, -2)
    found = state.contact_found
    forces = jnp.einsum(
        "bij,blcj->blci", world_to_wrist, jnp.where(found[..., None], state.contact_force, 0.0), precision=_EXACT
    )
    minus_forces = jnp.sum(forces * on_minus[..., None], -2)
    force = jnp.sum(forces, -2)

    heading_position = object_position + jnp.einsum("bij,bj->bi", to_wrist, goal.heading_position, precision=_EXACT)
    reference = kinematics.keypoints(hand, kinematics.link_transforms(hand, goal.pose_q))
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
        nearest=jnp.einsum("bij,bpj->bpi", to_wrist, nearest, precision=_EXACT),
        nearest_minus=jnp.einsum("bij,bpj->bpi", to_wrist, nearest_minus, precision=_EXACT),
        distance_minus=distance_minus,
        force=force,
        touching=jnp.any(found, -1),
        touching_plus=jnp.any(found & ~on_minus, -1),
        touching_minus=jnp.any(found & on_minus, -1),
        force_plus=force - minus_forces,
        force_minus=minus_forces,
        heading_position=heading_position,
        heading_direction=jnp.einsum("bij,bj->bi", to_wrist, goal.heading_direction, precision=_EXACT),
        reference_keypoints=reference,
    )
