"""Forward kinematics by the product of exponentials, the grasp frame and the hand centre.

Everything is in the wrist frame. A link's frame at zero has the wrist frame's orientation and its
origin at `common.hands.spec.link_origin`.
"""

import concurrent.futures
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np

from congrasp.common import rotations
from congrasp.common.hands.spec import Hand, link_origin
from congrasp.common.runtime.lazy_jax import jax, jnp
from congrasp.common.runtime.settings import library_settings
from congrasp.common.task.types import Array

T = TypeVar("T")


class _Chain(NamedTuple):
    """Joints of a hand, grouped by depth."""

    levels: tuple[tuple[int, ...], ...]
    """Joints at each depth; their parents are one level up."""
    parents: tuple[int, ...]
    """Joint before each joint; -1 for the palm."""
    link_joint: tuple[int, ...]
    """Last joint that moves each link; -1 for the palm."""


class GraspFrame(NamedTuple):
    """Local grasp coordinates of the hand in the wrist frame, from the open pose (paper, section
    Hand Modeling).
    """

    heading: np.ndarray
    """(3,) v, unit: forward from the middle of the opening, orthogonal to w."""
    cross: np.ndarray
    """(3,) w, unit: from the thumb's tip to the mean of the other tips."""
    center: np.ndarray
    """(3,) the hand centre p of the open hand, m."""
    opening: float
    """Distance between the thumb's tip and the mean of the others, m."""


@functools.cache
def _chain(hand: Hand) -> _Chain:
    """Returns the hand's joints by depth."""
    index = {link.name: i for i, link in enumerate(hand.links)}
    parents: list[int] = []
    depth: list[int] = []
    link_joint: list[int] = []
    for link in hand.links:
        last = link_joint[index[link.parent]] if link.parent else -1
        for _ in link.joints:
            joint = len(parents)
            parents.append(last)
            depth.append(depth[last] + 1 if last >= 0 else 0)
            last = joint
        link_joint.append(last)
    levels = []
    for level in range(max(depth) + 1):
        levels.append(tuple(j for j, d in enumerate(depth) if d == level))
    return _Chain(levels=tuple(levels), parents=tuple(parents), link_joint=tuple(link_joint))


def link_transforms(hand: Hand, q: Array) -> tuple[Array, Array]:
    """Motion of every link from the zero pose: x = rotation @ x0 + translation for points x0 of the
    zero pose.

    Args:
      hand: the hand.
      q: (..., F) finger angles.

    Returns:
      Rotations (..., L, 3, 3) and translations (..., L, 3) in the wrist frame.
    """
    chain = _chain(hand)
    axes = jnp.array([joint.axis for joint in hand.joints])
    anchors = jnp.array([joint.anchor for joint in hand.joints])
    joint_rotation = rotations.axis_rotation(axes, q)
    turned_anchors = rotations.apply(joint_rotation, anchors[:, None])[..., 0, :]
    joint_translation = anchors - turned_anchors
    batch = q.shape[:-1]
    # Motions of the palm and of the joints so far, level by level
    rotation = jnp.broadcast_to(jnp.eye(3), (*batch, 1, 3, 3))
    translation = jnp.zeros((*batch, 1, 3))
    row = {-1: 0}
    for level in chain.levels:
        parents = np.array([row[chain.parents[j]] for j in level])
        joints = np.array(level)
        parent_rotation = rotation[..., parents, :, :]
        parent_translation = translation[..., parents, :]
        offset = joint_translation[..., joints, None, :]
        new_rotation = rotations.apply(joint_rotation[..., joints, :, :].mT, parent_rotation)
        new_translation = parent_translation + rotations.apply(parent_rotation, offset)[..., 0, :]
        for j in level:
            row[j] = len(row)
        rotation = jnp.concatenate([rotation, new_rotation], -3)
        translation = jnp.concatenate([translation, new_translation], -2)
    rows = np.array([row[j] for j in chain.link_joint])
    return rotation[..., rows, :, :], translation[..., rows, :]


def keypoints(hand: Hand, transforms: tuple[Array, Array]) -> Array:
    """Link origins and fingertips (..., P, 3), from `link_transforms`."""
    rotation, translation = transforms
    links = hand.keypoint_links
    at_zero = jnp.array(hand.keypoints)[:, None]
    turned = rotations.apply(rotation[..., links, :, :], at_zero)[..., 0, :]
    return turned + translation[..., links, :]


def capsules(hand: Hand, transforms: tuple[Array, Array]) -> Array:
    """End points (..., C, 2, 3) of the hand's capsules, from `link_transforms`; see
    `Hand.capsule_radii`.
    """
    rotation, translation = transforms
    ends = jnp.asarray(hand.capsules)
    turned = rotations.apply(rotation[..., hand.capsule_links, :, :], ends)
    return turned + translation[..., hand.capsule_links, None, :]


def link_poses(hand: Hand, q: Array) -> tuple[Array, Array]:
    """Origins (..., L, 3) and orientations (..., L, 4) of the links' frames."""
    rotation, translation = link_transforms(hand, q)
    origins = jnp.array([link_origin(link) for link in hand.links])
    position = rotations.apply(rotation, origins[:, None])[..., 0, :] + translation
    return position, rotations.from_matrix(rotation)


def hand_center(hand: Hand, points: Array) -> Array:
    """Dynamic hand centre (..., 3): midpoint of the thumb's tip and the mean of the other tips.

    Args:
      hand: the hand.
      points: (..., P, 3) from `keypoints`.
    """
    tips = points[..., len(hand.links) :, :]
    return 0.5 * (tips[..., 0, :] + jnp.mean(tips[..., 1:, :], -2))


def _points(hand: Hand, q: Array) -> Array:
    """`keypoints` (P, 3) of finger angles (F,)."""
    return keypoints(hand, link_transforms(hand, q))


def untraced(function: Callable[..., T], *arguments: Any) -> T:
    """Returns the result of a function as numbers, also when called inside a trace.

    It runs in another thread, in which nothing is traced.
    """
    with concurrent.futures.ThreadPoolExecutor(1) as thread:
        return thread.submit(library_settings()(function), *arguments).result()


@functools.cache
def grasp_frame(hand: Hand) -> GraspFrame:
    """The grasp frame of the open hand; v is the direction from the wrist to the centre, made
    orthogonal to w.
    """
    compiled_points = jax.jit(_points, static_argnums=0)
    points = np.asarray(untraced(compiled_points, hand, np.array(hand.q_open, np.float32)))
    tips = points[len(hand.links) :]
    center = 0.5 * (tips[0] + tips[1:].mean(0))
    across = tips[1:].mean(0) - tips[0]
    opening = float(np.linalg.norm(across))
    cross = across / opening
    forward = center - (center @ cross) * cross
    return GraspFrame(
        heading=forward / np.linalg.norm(forward),
        cross=cross,
        center=center,
        opening=opening,
    )
