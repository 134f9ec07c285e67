"""Geometry between hand, object and goal in a control step, shared by observation, control, reward
and metrics.

It is computed once for each control step. Vectors are in the wrist frame unless stated otherwise.
"""

import jax.numpy as jnp

from congrasp.common import rotations
from congrasp.common.hands import kinematics
from congrasp.common.hands.spec import Hand
from congrasp.common.task.constraints import center_fingers, known
from congrasp.common.task.constraints.base import Scene
from congrasp.common.task.geometry import hand_center, nearest_index, squared_distances, wrist_pose
from congrasp.common.task.sensing import Readings
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Contacts, Features, Goal, SceneState, Surface


def features(
    hand: Hand, task: TaskSettings, state: SceneState, surface: Surface, goal: Goal
) -> Features:
    """Computes the geometry of hand, object and goal in one control step."""
    wrist_position, wrist_quaternion = wrist_pose(state)
    object_position, object_quaternion = rotations.relative_pose(
        wrist_position, wrist_quaternion, state.object_position, state.object_quaternion
    )
    keypoints = kinematics.keypoints(hand, kinematics.link_transforms(hand, state.q))
    fingers = keypoints
    if not task.dynamic_center:
        fingers = kinematics.keypoints(hand, kinematics.link_transforms(hand, state.q_initial))

    # Distances are computed in the object frame, where coordinates are small and the surface does
    # not move.
    contact_shape = state.contact_found.shape
    local = rotations.inverse_transform(object_position, object_quaternion, keypoints)
    contacts = rotations.inverse_transform(
        state.object_position,
        state.object_quaternion,
        state.contact_position.reshape(*contact_shape[:-2], -1, 3),
    )
    squared = squared_distances(surface.points, jnp.concatenate([local, contacts], -2))
    index = nearest_index(squared)
    points = len(hand.keypoints)
    nearest = jnp.take_along_axis(surface.points, index[..., :points, None], -2) - local

    normal = height = None
    if surface.normals is not None:
        normal = jnp.take_along_axis(surface.normals, index[..., :points, None], -2)
        height = -jnp.sum(normal * nearest, -1)
        normal = rotations.apply(rotations.to_matrix(object_quaternion), normal)

    found = state.contact_found
    assert contact_shape[-2] == len(hand.links), "contact arrays do not belong to this hand"
    force = jnp.where(found[..., None], state.contact_force, 0.0).reshape(contacts.shape)
    forces = rotations.apply(jnp.swapaxes(rotations.to_matrix(wrist_quaternion), -1, -2), force)
    forces = forces.reshape(state.contact_force.shape)

    common = Features(
        wrist_position=wrist_position,
        wrist_quaternion=wrist_quaternion,
        object_position=object_position,
        object_quaternion=object_quaternion,
        keypoints=keypoints,
        center=hand_center(hand, fingers, center_fingers(task, goal)),
        nearest=rotations.apply(rotations.to_matrix(object_quaternion), nearest),
        normal=normal,
        height=height,
        force=jnp.sum(forces, -2),
        touching=jnp.any(found, -1),
        of={},
    )
    made = Contacts(
        surface,
        local,
        squared[..., :points],
        index[..., points:].reshape(contact_shape),
        found,
        forces,
    )
    return common._replace(of={c.name: c.features(hand, made, common, goal) for c in known(task)})


def scene_of(
    hand: Hand,
    task: TaskSettings,
    state: SceneState,
    surface: Surface,
    goal: Goal,
    readings: Readings | None = None,
) -> Scene:
    """Returns one control step as input of the constraints."""
    return Scene(hand, task, state, features(hand, task, state, surface, goal), goal, readings)
