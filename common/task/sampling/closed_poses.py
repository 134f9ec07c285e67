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


class Poses(NamedTuple):
    """M reference poses in the object frame."""

    q: Array
    """(M, F) finger angles."""
    position: Array
    """(M, 3) wrist."""
    quaternion: Array
    """(M, 4) wrist."""


@functools.cache
def _fingers(hand: Hand) -> tuple[np.ndarray, np.ndarray, int]:
    """Finger indices of the joints (F,) and of the keypoints (P,; -1 for the palm), and the number
    of fingers.

    Fingers moved by the same motor count as one.
    """
    roots = [next(iter(chain_of(hand, link.name)), "") for link in hand.links]
    owners = np.split(
        transmission(hand).motor, np.cumsum([len(link.joints) for link in hand.links])[:-1]
    )
    for motor in range(len(hand.motors)):
        first, *others = dict.fromkeys(
            root for root, own in zip(roots, owners, strict=True) if motor in own
        )
        roots = [first if root in others else root for root in roots]
    names = [name for name in dict.fromkeys(roots) if name]
    of_link = np.array([names.index(root) if root else -1 for root in roots])
    return of_link[hand.joint_links], of_link[hand.keypoint_links], len(names)


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
    joint_finger, point_finger, fingers = _fingers(hand)
    radii = jnp.array(hand.keypoint_radii)
    goal = HeadingGoal(heading_position, direction, cross)

    def close(center: Array) -> Array:
        """Angles (M, F) of fingers closed until they touch, with the hand centre (M, 3) at the
        heading.
        """
        position, quaternion = heading_wrist_pose(hand, goal, center)

        def clear(fraction: Array) -> Array:
            """(M, fingers) bool: fingers at this fraction of their range do not penetrate the
            object.
            """
            q = closure_pose(hand, fraction[None])
            own = kinematics.keypoints(hand, kinematics.link_transforms(hand, q))
            here = rotations.transform(
                position, quaternion, jnp.broadcast_to(own, (count, *own.shape))
            )
            nearest = jnp.argmin(
                squared_distances(here, jnp.broadcast_to(points, (count, *points.shape))), -1
            )
            offset = here - points[nearest]
            inside = jnp.sum(offset * normals[nearest], -1) < 0
            gap = jnp.where(inside, -1.0, jnp.linalg.norm(offset, axis=-1)) - radii
            return jnp.stack(
                [jnp.all(jnp.where(point_finger == k, gap, 1.0) > 0, -1) for k in range(fingers)],
                -1,
            )

        fractions = jnp.linspace(-1.0, 1.0, _STEPS)
        free = jax.lax.map(clear, fractions)
        closed = jnp.sum(jnp.cumprod(free, 0), 0)  # steps before the first touch
        fraction = fractions[jnp.clip(closed, 0, _STEPS - 1)][:, joint_finger]
        return closure_pose(hand, fraction)

    open_center = jnp.broadcast_to(jnp.array(kinematics.grasp_frame(hand).center), (count, 3))
    q = close(open_center)
    # Closing moves the hand centre: realign the wrist with the heading position, and close again.
    center = kinematics.hand_center(
        hand, kinematics.keypoints(hand, kinematics.link_transforms(hand, q))
    )
    q = close(center)
    position, quaternion = heading_wrist_pose(hand, goal, center)
    return Poses(q, position, quaternion)
