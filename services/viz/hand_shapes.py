"""Hands as shapes: their skin, their capsules, and hands at given finger angles."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.hands.mjcf import mujoco_link_poses
from congrasp.common.hands.skin import MATERIALS, Skin, skin_of
from congrasp.common.hands.spec import Hand, capsule_ends
from congrasp.services.appearance.palette import MATERIAL_COLOURS, ROBOT_LINK, Colour
from congrasp.services.viz.shapes import Shape, between

_SKIN_SHINE = 0.12
_STILL_M = 1e-3
"""Length of a curl that is too small for a direction, m."""


class Look(NamedTuple):
    """Look of a hand."""

    tint: Colour = ROBOT_LINK
    """A colour to blend with that of the hand."""
    shares: Sequence[float] | np.ndarray | None = None
    """(L,) shares of that colour on each link; zero by default."""
    alpha: float = 1.0
    """Opacity; below one the hand is transparent."""


PLAIN = Look()
"""An opaque hand in its own colours."""


def skin_shape(
    skin: Skin, position: np.ndarray, quaternion: np.ndarray, look: Look = PLAIN
) -> Shape:
    """A hand's skin.

    Args:
      skin: the surface.
      position: (L, 3) origins of the links' frames in the world, m.
      quaternion: (L, 4) their orientations.
      look: colours and opacity.
    """
    rotations = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    points, normals = skin.posed(position, rotations)
    colours = skin_colours(skin)
    if look.shares is not None:
        share = (skin.weights @ np.asarray(look.shares, np.float32))[:, None]
        colours = colours + share * (np.array(look.tint) - colours)
    return Shape(
        "mesh",
        (0, 0),
        ROBOT_LINK,
        alpha=look.alpha,
        shine=_SKIN_SHINE,
        vertices=points,
        faces=skin.faces,
        normals=normals,
        colours=colours,
    )


def skin_colours(skin: Skin) -> np.ndarray:
    """(V, 3) colours of a skin, by its materials."""
    colours = np.array([MATERIAL_COLOURS[name] for name in MATERIALS], np.float32)
    return colours[skin.material]


def capsule_shapes(hand: Hand, position: np.ndarray, quaternion: np.ndarray) -> list[Shape]:
    """The hand's capsules with its links' frames at positions (L, 3) and orientations (L, 4) in the
    world.
    """
    shapes = []
    for i, link in enumerate(hand.links):
        turn = Rotation.from_quat(quaternion[i], scalar_first=True)
        for capsule, ends in zip(link.capsules, capsule_ends(link), strict=True):
            start, end = turn.apply(ends) + position[i]
            shapes.append(between(start, end, capsule.radius, ROBOT_LINK))
    return shapes


def link_frames(
    hand: Hand, q: np.ndarray, position: np.ndarray, wrist: Rotation
) -> tuple[np.ndarray, np.ndarray]:
    """Origins (L, 3) and orientations (L, 4) of the links at finger angles (F,), in the frame of
    the wrist's pose.
    """
    links, quaternion = mujoco_link_poses(hand, q)
    turned = wrist * Rotation.from_quat(quaternion, scalar_first=True)
    return wrist.apply(links) + position, turned.as_quat(scalar_first=True)


def posed_hand(
    hand: Hand,
    q: np.ndarray,
    position: np.ndarray,
    wrist: Rotation,
    look: Look = PLAIN,
    skin: Skin | None = None,
) -> Shape:
    """The hand at finger angles.

    Args:
      hand: the hand.
      q: (F,) finger angles, rad.
      position: (3,) m, of the wrist in the world frame.
      wrist: orientation of the wrist in the world frame.
      look: colours and opacity.
      skin: the surface; by default that of `skin_of`.
    """
    link_position, link_quaternion = link_frames(hand, q, position, wrist)
    return skin_shape(skin or skin_of(hand), link_position, link_quaternion, look)


def upright(hand: Hand) -> Rotation:
    """Rotation of the wrist frame after which the fingers point up and the palm faces +x.

    The palm faces where the fingers curl.
    """
    fingers = hand.keypoints[len(hand.links) + 1 :].mean(0)
    up = fingers / np.linalg.norm(fingers)
    links = list(hand.tip_links[1:])
    closed = mujoco_link_poses(hand, hand.q_closed)[0]
    opened = mujoco_link_poses(hand, hand.q_open)[0]
    curl = (closed - opened)[links].mean(0)
    palm = curl - (curl @ up) * up
    if np.linalg.norm(palm) < _STILL_M:
        # Fingers with one joint, or that turn around an axis, do not curl: the thumb tells the side
        thumb = hand.keypoints[len(hand.links)] - fingers
        palm = thumb - (thumb @ up) * up
    palm = palm / np.linalg.norm(palm)
    return Rotation.from_matrix(np.stack([palm, np.cross(up, palm), up]))
