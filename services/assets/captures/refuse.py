"""Refuses captured references that a hand cannot take: too deep in their object, or wider than the hand opens."""

import functools

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.hands.closure import widest_gap
from congrasp.common.hands.human import HUMAN
from congrasp.common.hands.kinematics import capsules, grasp_frame, link_transforms
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.shapes import hull_of, tessellate
from congrasp.common.objects.spec import GraspObject, Piece
from congrasp.common.task.types import Array
from congrasp.services.assets.captures.extract import Demonstration
from congrasp.services.assets.captures.sequence import Dropped

DEEPEST = 0.01
"""Tolerated depth of skin in the object, similar to the error of captured hands, m."""
_ALONG = np.linspace(0.0, 1.0, 5)[:, None]


def check_reference(hand: Hand, demonstration: Demonstration, obj: GraspObject, scale: float) -> None:
    """Raises Dropped for a reference that the hand cannot take.

    Args:
      hand: hand of the reference; for a hand other than the human one, which closes around the object by itself, only
        the width is checked.
      demonstration: demonstration of the human hand.
      obj: the unscaled object.
      scale: factor on the object's lengths for the hand.
    """
    wide, opening = scale * width(demonstration), widest_gap(hand)
    if wide > opening:
        reason = f"thumb and fingers touch it {100 * wide:.1f} cm apart, but the hand opens only {100 * opening:.1f} cm"
        raise Dropped(demonstration.name, "too wide", reason)
    deep = depth(demonstration, obj) if hand is HUMAN else 0.0
    if deep > DEEPEST:
        reason = f"the hand is {1000 * deep:.0f} mm deep in the object ({1000 * DEEPEST:.0f} mm at most)"
        raise Dropped(demonstration.name, "too deep", reason)


def width(demonstration: Demonstration) -> float:
    """Extent of the touched points along the cross-finger axis, m."""
    turn = Rotation.from_quat(demonstration.quaternion[-1], scalar_first=True)
    along = demonstration.contact @ turn.apply(grasp_frame(HUMAN).cross)
    return float(np.ptp(along)) if len(along) else 0.0


def depth(demonstration: Demonstration, obj: GraspObject) -> float:
    """Depth in m of the human hand's skin in a piece of the object; negative without contact.

    It is exact if a finger's axis is in the piece, and an upper bound beyond its edges.
    """
    ends = np.asarray(_capsules(HUMAN, demonstration.q.astype(np.float32)), float)
    axes = (1 - _ALONG) * ends[:, :1] + _ALONG * ends[:, 1:]
    turn = Rotation.from_quat(demonstration.quaternion[-1], scalar_first=True)
    points = turn.apply(axes.reshape(-1, 3)) + demonstration.position[-1]
    outside = np.min([_above_faces(piece, points) for piece in obj.pieces], axis=0)
    return float((np.repeat(HUMAN.capsule_radii, len(_ALONG)) - outside).max())


@functools.partial(jax.jit, static_argnums=0)
def _capsules(hand: Hand, q: Array) -> Array:
    """Ends (C, 2, 3) of a hand's capsules at finger angles (F,), compiled as one program."""
    return capsules(hand, link_transforms(hand, q))


def _above_faces(piece: Piece, points: np.ndarray) -> np.ndarray:
    """Greatest height (N,) of points (N, 3) above the planes of a piece's faces, m; negative inside."""
    vertices, _ = tessellate(piece)
    planes = hull_of(vertices).equations
    return np.asarray((points @ planes[:, :3].T + planes[:, 3]).max(-1))
