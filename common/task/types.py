"""The arrays that the task's formulas speak about.

Every array has leading batch axis B. World-frame unless said otherwise; the world's z axis points up and the table's
top is at z = 0. Quaternions are (w, x, y, z) and rotate from the named body's frame into the world (or object) frame.
F finger joints, L links, P keypoints, C contacts kept per link, N surface points, K waypoints.
"""

from typing import Any, NamedTuple

import numpy as np

Array = Any  # a jax.Array inside compiled functions, a numpy.ndarray outside

MASKS = ("affordance", "pose_finger", "pose_wrist", "trajectory")
"""Order of the bits of `Goal.mask`."""
CONTACTS_PER_LINK = 3
"""C, strongest contacts kept for each link."""


class SceneState(NamedTuple):
    """Hand and object at one moment, with what the episode started from."""

    q: Array
    """(B, F) finger joint angles, rad."""
    u: Array
    """(B, 6) virtual wrist joints relative to the base: x, y, z (m), then intrinsic x-y-z angles (rad)."""
    q_velocity: Array
    """(B, F) rad/s."""
    u_velocity: Array
    """(B, 6) m/s and rad/s."""
    q_target: Array
    """(B, F) finger targets of the previous control step."""
    u_target: Array
    """(B, 6) wrist targets of the previous control step."""
    object_position: Array
    """(B, 3) object's centre of mass, m."""
    object_quaternion: Array
    """(B, 4)."""
    object_velocity: Array
    """(B, 3) linear velocity of the centre of mass, m/s."""
    object_angular_velocity: Array
    """(B, 3) rad/s, world frame."""
    contact_force: Array
    """(B, L, C, 3) force of the object on the link, N; zero where there is no contact."""
    contact_position: Array
    """(B, L, C, 3) m; meaningless where there is no contact."""
    contact_found: Array
    """(B, L, C) bool."""
    base_position: Array
    """(B, 3) origin of the wrist's base, where the six wrist joints are zero."""
    base_quaternion: Array
    """(B, 4)."""
    q_initial: Array
    """(B, F) finger angles at the start of the episode."""
    object_position_initial: Array
    """(B, 3) object's position at the start of the episode."""
    object_quaternion_initial: Array
    """(B, 4)."""
    time: Array
    """(B,) control steps since the episode began, float."""
    table: Array
    """(B,) bool, whether the table is present."""


class Surface(NamedTuple):
    """Labelled surface points of the object."""

    points: Array
    """(B, N, 3) in the object frame, m."""
    minus: Array
    """(B, N) bool, true in the non-grasping region O-."""


class Goal(NamedTuple):
    """Active constraints after the priority rules, all in the object frame; what a zero bit gates is ignored."""

    heading_position: Array
    """(B, 3) p-bar."""
    heading_direction: Array
    """(B, 3) v-bar, unit."""
    heading_cross: Array
    """(B, 3) direction for the cross-finger axis w, unit, orthogonal to v-bar; it fixes the guidance's roll only."""
    pose_q: Array
    """(B, F) reference finger angles q-bar."""
    pose_position: Array
    """(B, 3) reference wrist position."""
    pose_quaternion: Array
    """(B, 4) reference wrist orientation (wrist frame to object frame)."""
    trajectory_position: Array
    """(B, K, 3) wrist waypoints."""
    trajectory_quaternion: Array
    """(B, K, 4)."""
    mask: Array
    """(B, 4) float 0/1 in the order of `MASKS`."""


class Action(NamedTuple):
    """Joint targets decoded from a policy's action."""

    q_target: Array
    """(B, F)."""
    u_target: Array
    """(B, 6)."""


def first(tree: Any) -> Any:
    """Element 0 of every array of a (possibly nested) NamedTuple, as NumPy."""
    return type(tree)(*(np.asarray(leaf)[0] for leaf in tree))
