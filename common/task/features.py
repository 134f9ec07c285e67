"""Geometry between hand, object and goal in a control step, shared by observation, control, reward
and metrics.

It is computed once for each control step. Vectors are in the wrist frame unless stated otherwise.
"""

from typing import NamedTuple

import jax.numpy as jnp

from congrasp.common import rotations
from congrasp.common.hands import kinematics
from congrasp.common.hands.spec import Hand
from congrasp.common.task.constraints import center_fingers, known
from congrasp.common.task.geometry import hand_center, nearest_index, squared_distances, wrist_pose
from congrasp.common.task.readings import Readings
from congrasp.common.task.scene import Scene
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array, Contacts, Features, Goal, SceneState, Surface


class _NearestPoints(NamedTuple):
    """Surface points nearest to the keypoints, object frame."""

    offset: Array
    """(B, P, 3) from each keypoint to its nearest surface point, m."""
    normal: Array | None
    """(B, P, 3) outward unit normals there; None if the surface has no normals."""
    height: Array | None
    """(B, P) signed height of the keypoints above the tangent planes there, m."""


def features(
    hand: Hand, task: TaskSettings, state: SceneState, surface: Surface, goal: Goal
) -> Features:
    """Computes the geometry of hand, object and goal in one control step."""
    assert state.contact_found.shape[-2] == len(hand.links), (
        "contact arrays do not belong to this hand"
    )
    wrist_position, wrist_quaternion = wrist_pose(state)
    object_position, object_quaternion = rotations.relative_pose(
        wrist_position, wrist_quaternion, state.object_position, state.object_quaternion
    )
    keypoints = kinematics.keypoints(hand, kinematics.link_transforms(hand, state.q))
    center_keypoints = keypoints
    if not task.dynamic_center:
        initial_transforms = kinematics.link_transforms(hand, state.q_initial)
        center_keypoints = kinematics.keypoints(hand, initial_transforms)

    # Distances are computed in the object frame, where coordinates are small and the surface does
    # not move.
    local = rotations.inverse_transform(object_position, object_quaternion, keypoints)
    points = jnp.concatenate([local, _contact_points(state)], -2)
    squared = squared_distances(surface.points, points)
    index = nearest_index(squared)
    count = len(hand.keypoints)
    nearest = _nearest_points(surface, local, index[..., :count])
    to_wrist = rotations.to_matrix(object_quaternion)
    normal = nearest.normal
    if normal is not None:
        normal = rotations.apply(to_wrist, normal)

    contact_forces = _contact_forces(state, wrist_quaternion)
    shared = Features(
        wrist_position=wrist_position,
        wrist_quaternion=wrist_quaternion,
        object_position=object_position,
        object_quaternion=object_quaternion,
        keypoints=keypoints,
        center=hand_center(hand, center_keypoints, center_fingers(task, goal)),
        nearest=rotations.apply(to_wrist, nearest.offset),
        normal=normal,
        height=nearest.height,
        force=jnp.sum(contact_forces, -2),
        touching=jnp.any(state.contact_found, -1),
        by_constraint={},
    )
    contacts = Contacts(
        surface=surface,
        keypoints=local,
        squared=squared[..., :count],
        nearest=index[..., count:].reshape(state.contact_found.shape),
        found=state.contact_found,
        force=contact_forces,
    )
    by_constraint = {}
    for constraint in known(task):
        by_constraint[constraint.name] = constraint.features(hand, contacts, shared, goal)
    return shared._replace(by_constraint=by_constraint)


def _contact_points(state: SceneState) -> Array:
    """Positions (B, L C, 3) of the contacts, object frame."""
    batch = state.contact_position.shape[:-3]
    return rotations.inverse_transform(
        state.object_position,
        state.object_quaternion,
        state.contact_position.reshape(*batch, -1, 3),
    )


def _contact_forces(state: SceneState, wrist_quaternion: Array) -> Array:
    """Forces (B, L, C, 3) of the contacts, wrist frame; zero where there is no contact."""
    batch = state.contact_force.shape[:-3]
    force = jnp.where(state.contact_found[..., None], state.contact_force, 0.0)
    to_wrist = jnp.swapaxes(rotations.to_matrix(wrist_quaternion), -1, -2)
    turned = rotations.apply(to_wrist, force.reshape(*batch, -1, 3))
    return turned.reshape(state.contact_force.shape)


def _nearest_points(surface: Surface, keypoints: Array, index: Array) -> _NearestPoints:
    """Surface points of these indices (B, P), relative to keypoints (B, P, 3), object frame."""
    offset = jnp.take_along_axis(surface.points, index[..., None], -2) - keypoints
    if surface.normals is None:
        return _NearestPoints(offset, None, None)
    normal = jnp.take_along_axis(surface.normals, index[..., None], -2)
    return _NearestPoints(offset, normal, -jnp.sum(normal * offset, -1))


def scene_of(
    hand: Hand,
    task: TaskSettings,
    state: SceneState,
    surface: Surface,
    goal: Goal,
    readings: Readings | None = None,
) -> Scene:
    """Returns one control step as input of the constraints."""
    geometry = features(hand, task, state, surface, goal)
    return Scene(hand, task, state, geometry, goal, surface, readings)
