"""Extent of a hand around its centre in a few finger poses, which decides whether a table leaves room for it."""

import concurrent.futures
import functools
from typing import NamedTuple

import jax
import numpy as np

from congrasp.common.hands import kinematics
from congrasp.common.hands.closure import CLOSURES, closure_pose, table_of_gaps
from congrasp.common.hands.spec import Hand


class Outline(NamedTuple):
    """Balls whose hull contains the hand, in S finger poses from the least to the most closed.

    The frame has its origin at the hand's centre and the axes v, w and v x w of the grasp frame.
    """

    points: np.ndarray
    """(S, E, 3) centres of the balls, m."""
    radii: np.ndarray
    """(E,) m."""
    openings: np.ndarray
    """(S,) m between the skins of the thumb's and the nearest other fingertip, along w (`common.hands.closure`)."""


CENTER = Outline(np.zeros((1, 1, 3)), np.array([0.01]), np.array([np.inf]))
"""A ball of 1 cm around the hand's centre, for requests that name no hand."""


@functools.cache
def outline(hand: Hand) -> Outline:
    """Returns the hand's capsules in the poses of `CLOSURES`."""
    frame = kinematics.grasp_frame(hand)
    axes = np.stack([frame.heading, frame.cross, np.cross(frame.heading, frame.cross)])
    # In a separate thread nothing is being traced; inside a trace, this would compile operation by operation.
    with concurrent.futures.ThreadPoolExecutor(1) as thread:
        posed = thread.submit(_posed, hand, CLOSURES.astype(np.float32)).result()
    ends, center = (np.asarray(part, np.float64) for part in posed)
    radii = np.repeat(hand.capsule_radii, 2).astype(np.float64)
    return Outline((ends - center[:, None]) @ axes.T, radii, table_of_gaps(hand))


def depth_below(outline: Outline, up: np.ndarray) -> np.ndarray:
    """Depth (S, H) in metres of the hand's lowest point below its centre, in each of S poses.

    Args:
      outline: outline of the hand.
      up: (H, 3) unit, vertical of the world in the outline's frame.
    """
    return -(np.einsum("sei,hi->she", outline.points, up) - outline.radii).min(-1)


@functools.partial(jax.jit, static_argnums=0)
def _posed(hand: Hand, closures: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Ends (S, E, 3) of the hand's capsules at closures (S,), and its centres (S, 3), in the wrist frame."""
    transforms = kinematics.link_transforms(hand, closure_pose(hand, closures[:, None]))
    ends = kinematics.capsules(hand, transforms)
    return ends.reshape(*ends.shape[:-3], -1, 3), kinematics.hand_center(hand, kinematics.keypoints(hand, transforms))
