"""Forward kinematics by the product of exponentials, the grasp frame and the hand centre.

Everything is in the wrist frame. A link's frame at zero has the wrist frame's orientation and its
origin at `common.hands.spec.link_origin`.
"""

import concurrent.futures
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common import rotations
from congrasp.common.hands.spec import Hand, link_origin
from congrasp.common.runtime.settings import library_settings
from congrasp.common.task.types import Array

T = TypeVar("T")


class _Chain(NamedTuple):
    """Joints grouped by depth: `levels[d]` holds joint indices whose parents (-1: the palm) are one
    level up.
    """

    levels: tuple[tuple[int, ...], ...]
    parents: tuple[int, ...]
    link_joint: tuple[int, ...]  # last joint that moves each link, -1 for the palm


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
    last: list[int] = []
    depth: list[int] = []
    for link in hand.links:
        tail = last[index[link.parent]] if link.parent else -1
        for _ in link.joints:
            parents.append(tail)
            depth.append(depth[tail] + 1 if tail >= 0 else 0)
            tail = len(parents) - 1
        last.append(tail)
    levels = tuple(
        tuple(j for j, d in enumerate(depth) if d == level) for level in range(max(depth) + 1)
    )
    return _Chain(levels, tuple(parents), tuple(last))


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
    local = rotations.axis_rotation(axes, q)
    offset = anchors - rotations.apply(local, anchors[:, None])[..., 0, :]
    batch = q.shape[:-1]
    done_r = jnp.broadcast_to(jnp.eye(3), (*batch, 1, 3, 3))
    done_t = jnp.zeros((*batch, 1, 3))
    place = {-1: 0}
    for level in chain.levels:
        above = np.array([place[chain.parents[j]] for j in level])
        parent_r, parent_t = done_r[..., above, :, :], done_t[..., above, :]
        here = np.array(level)
        r = rotations.apply(local[..., here, :, :].mT, parent_r)
        t = parent_t + rotations.apply(parent_r, offset[..., here, None, :])[..., 0, :]
        place.update({j: done_t.shape[-2] + k for k, j in enumerate(level)})
        done_r = jnp.concatenate([done_r, r], -3)
        done_t = jnp.concatenate([done_t, t], -2)
    order = np.array([place[j] for j in chain.link_joint])
    return done_r[..., order, :, :], done_t[..., order, :]


def keypoints(hand: Hand, transforms: tuple[Array, Array]) -> Array:
    """Link origins and fingertips (..., P, 3), from `link_transforms`."""
    rotation, translation = transforms
    carrier = hand.keypoint_links
    points = rotations.apply(rotation[..., carrier, :, :], jnp.array(hand.keypoints)[:, None])[
        ..., 0, :
    ]
    return points + translation[..., carrier, :]


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
    return (
        rotations.apply(rotation, origins[:, None])[..., 0, :] + translation,
        rotations.from_matrix(rotation),
    )


def hand_center(hand: Hand, points: Array) -> Array:
    """Dynamic hand centre (..., 3): midpoint of the thumb's tip and the mean of the other tips.

    Args:
      hand: the hand.
      points: (..., P, 3) from `keypoints`.
    """
    tips = points[..., len(hand.links) :, :]
    return 0.5 * (tips[..., 0, :] + jnp.mean(tips[..., 1:, :], -2))


@functools.partial(jax.jit, static_argnums=0)
def _points(hand: Hand, q: Array) -> Array:
    """`keypoints` (P, 3) of finger angles (F,), compiled as one program."""
    return keypoints(hand, link_transforms(hand, q))


def untraced(function: Callable[..., T], *arguments: Any) -> T:
    """The result of a function; inside a trace, it has numbers, and is not compiled operation by
    operation.
    """
    with concurrent.futures.ThreadPoolExecutor(
        1
    ) as thread:  # in another thread nothing is being traced
        return thread.submit(library_settings()(function), *arguments).result()


@functools.cache
def grasp_frame(hand: Hand) -> GraspFrame:
    """The grasp frame of the open hand; v is the direction from the wrist to the centre, made
    orthogonal to w.
    """
    points = np.asarray(untraced(_points, hand, np.array(hand.q_open, np.float32)))
    tips = points[len(hand.links) :]
    center = 0.5 * (tips[0] + tips[1:].mean(0))
    across = tips[1:].mean(0) - tips[0]
    opening = float(np.linalg.norm(across))
    cross = across / opening
    forward = center - (center @ cross) * cross
    return GraspFrame(forward / np.linalg.norm(forward), cross, center, opening)
