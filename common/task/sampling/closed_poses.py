"""Generates reference poses by closing the hand around an object, without physics.

They substitute for the final states of a trained policy's grasps until there is a policy. The wrist
is aligned with the heading, and every finger closes from the widest pose until its skin touches the
surface.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common import rotations
from congrasp.common.hands import kinematics
from congrasp.common.hands.closure import closure_pose
from congrasp.common.hands.motors import transmission
from congrasp.common.hands.spec import Hand, chain_of
from congrasp.common.task.constraints.heading import HeadingGoal, heading_wrist_pose
from congrasp.common.task.geometry import squared_distances
from congrasp.common.task.types import Array

_STEPS = 40
"""Steps of the fingers' range at which contact is tested."""


class Poses(NamedTuple):
    """M reference poses in the object frame."""

    q: Array
    """(M, F) finger angles."""
    position: Array
    """(M, 3) wrist."""
    quaternion: Array
    """(M, 4) wrist."""


class FingerGroups(NamedTuple):
    """Groups of fingers that close independently. Fingers of one motor are one group."""

    of_joint: np.ndarray
    """(F,) index of the group of each joint; -1 for none."""
    of_keypoint: np.ndarray
    """(P,) index of the group of each keypoint; -1 for the palm."""
    number: int
    """Number of groups."""


@functools.cache
def finger_groups(hand: Hand) -> FingerGroups:
    """Returns the groups of a hand's fingers."""
    # A finger is named by the first link of its chain; the palm has no name.
    root_of_link = [next(iter(chain_of(hand, link.name)), "") for link in hand.links]
    first_joints = np.cumsum([len(link.joints) for link in hand.links])[:-1]
    motors_of_link = np.split(transmission(hand).motor, first_joints)
    for motor in range(len(hand.motors)):
        moved = dict.fromkeys(
            root
            for root, motors in zip(root_of_link, motors_of_link, strict=True)
            if motor in motors
        )
        first, *others = moved
        root_of_link = [first if root in others else root for root in root_of_link]
    names = [name for name in dict.fromkeys(root_of_link) if name]
    group_of_link = np.array([names.index(root) if root else -1 for root in root_of_link])
    return FingerGroups(
        of_joint=group_of_link[hand.joint_links],
        of_keypoint=group_of_link[hand.keypoint_links],
        number=len(names),
    )


@functools.partial(jax.jit, static_argnums=0)
def closed_poses(
    hand: Hand,
    points: Array,
    normals: Array,
    heading_position: Array,
    direction: Array,
    cross: Array,
) -> Poses:
    """Closes the hand at M headings on one object.

    Args:
      hand: the hand.
      points: (N, 3) surface points in the object frame.
      normals: (N, 3) outward unit normals.
      heading_position: (M, 3) p-bar.
      direction: (M, 3) v-bar.
      cross: (M, 3) direction of the cross-finger axis.
    """
    count = direction.shape[0]
    groups = finger_groups(hand)
    radii = jnp.array(hand.keypoint_radii)
    goal = HeadingGoal(heading_position, direction, cross)

    def close(center: Array) -> Array:
        """Angles (M, F) of fingers closed until they touch, with the hand centre (M, 3) at the
        heading.
        """
        position, quaternion = heading_wrist_pose(hand, goal, center)

        def clear(fraction: Array) -> Array:
            """(M, groups) bool: fingers at this fraction of their range do not penetrate the
            object.
            """
            q = closure_pose(hand, fraction[None])
            local = kinematics.keypoints(hand, kinematics.link_transforms(hand, q))
            keypoints = rotations.transform(
                position, quaternion, jnp.broadcast_to(local, (count, *local.shape))
            )
            surface = jnp.broadcast_to(points, (count, *points.shape))
            nearest = jnp.argmin(squared_distances(keypoints, surface), -1)
            offset = keypoints - points[nearest]
            inside = jnp.sum(offset * normals[nearest], -1) < 0
            gap = jnp.where(inside, -1.0, jnp.linalg.norm(offset, axis=-1)) - radii
            clears = []
            for group in range(groups.number):
                gap_of_group = jnp.where(groups.of_keypoint == group, gap, 1.0)
                clears.append(jnp.all(gap_of_group > 0, -1))
            return jnp.stack(clears, -1)

        fractions = jnp.linspace(-1.0, 1.0, _STEPS)
        free = jax.lax.map(clear, fractions)
        steps_before_touch = jnp.sum(jnp.cumprod(free, 0), 0)
        fraction = fractions[jnp.clip(steps_before_touch, 0, _STEPS - 1)]
        return closure_pose(hand, fraction[:, groups.of_joint])

    open_center = jnp.broadcast_to(jnp.array(kinematics.grasp_frame(hand).center), (count, 3))
    q = close(open_center)
    # Closing moves the hand centre: realign the wrist with the heading position, and close again.
    keypoints = kinematics.keypoints(hand, kinematics.link_transforms(hand, q))
    center = kinematics.hand_center(hand, keypoints)
    q = close(center)
    position, quaternion = heading_wrist_pose(hand, goal, center)
    return Poses(q, position, quaternion)
