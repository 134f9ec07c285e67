"""Nails of a human hand.

A nail is curved around its fingertip: around the finger's axis, and over the ball at the finger's
end. A point of it is given by its angle around the axis, 0 on the back of the finger, and by its
distance along the axis, 0 at the centre of the ball and positive towards the end. Beyond the
centre, that distance continues along an arc over the ball.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from congrasp.common.hands.flesh import Skeleton, Surface
from congrasp.common.hands.rings import closed_surface, ring_angles

_HALF_WIDTH_RAD = 0.90
"""Half width of a nail, as an angle around the finger."""
_HALF_LENGTH = 0.85
"""Half length of a nail along the finger, in radii of the fingertip."""
_CENTER_BEHIND_TIP = 0.30
"""Distance of the nail's centre behind the centre of the fingertip's ball, in its radii."""
_OUTLINE_EXPONENT = 0.65
"""Exponent of sine and cosine in the nail's outline, a superellipse: 1 gives an ellipse, smaller
values squarer corners."""


class _Ring(NamedTuple):
    """A closed curve of the nail's surface, parallel to the nail's outline."""

    scale: float
    """Size as a share of the nail's outline."""
    height: float
    """Height above the skin, m; negative below it."""


_RINGS = (
    _Ring(0.2, 0.0005),
    _Ring(0.55, 0.0005),
    _Ring(0.9, 0.0004),
    _Ring(1.0, 0.0001),
    _Ring(0.9, -0.0012),
    _Ring(0.2, -0.0012),
)
"""From the middle of the nail's upper side over its border to the middle of its lower side."""


def nails(skeleton: Skeleton, skin: Surface) -> list[Surface]:
    """A nail on the back of each fingertip that a joint bends; it moves with the skin below it."""
    surfaces = []
    skin_points = cKDTree(skin.points)
    for chain in skeleton.chains():
        tip = chain[-1]
        joints = np.flatnonzero(skeleton.joint_link == tip)
        if not len(joints):
            continue
        capsule = np.flatnonzero(skeleton.capsule_link == tip)[0]
        start, end = skeleton.capsules[capsule]
        along = (end - start) / np.linalg.norm(end - start)
        # A positive angle of the joint moves the tip along axis x along, towards the palm.
        to_back = -np.cross(skeleton.axes[joints[-1]], along)
        to_back = to_back / np.linalg.norm(to_back)
        rings = _ring_points(end, along, to_back, skeleton.radii[capsule])
        nail = closed_surface(rings, tip, len(skeleton.names))
        _, nearest = skin_points.query(nail.points)
        weights = skin.weights[nearest].mean(0)
        surfaces.append(nail._replace(weights=np.tile(weights, (len(nail.points), 1))))
    return surfaces


def _ring_points(
    center: np.ndarray, along: np.ndarray, to_back: np.ndarray, radius: float
) -> np.ndarray:
    """Points (R, S, 3) of the rings of a nail, m.

    Args:
      center: (3,) centre of the fingertip's ball, m.
      along: (3,) unit, direction of the finger's axis, towards its end.
      to_back: (3,) unit, direction from the axis to the back of the finger.
      radius: radius of the fingertip, m.
    """
    angles = ring_angles()
    outline_across = _superellipse(np.cos(angles))
    outline_along = _superellipse(np.sin(angles))
    to_side = np.cross(along, to_back)
    rings = []
    for scale, height in _RINGS:
        around_axis = _HALF_WIDTH_RAD * scale * outline_across
        distance = radius * (_HALF_LENGTH * scale * outline_along - _CENTER_BEHIND_TIP)
        from_axis = np.cos(around_axis)[:, None] * to_back + np.sin(around_axis)[:, None] * to_side
        over_ball = np.clip(distance / radius, 0, np.pi / 2)[:, None]
        outward = np.cos(over_ball) * from_axis + np.sin(over_ball) * along
        on_axis = center + np.minimum(distance, 0)[:, None] * along
        rings.append(on_axis + (radius + height) * outward)
    return np.array(rings)


def _superellipse(coordinate: np.ndarray) -> np.ndarray:
    """Returns a coordinate of the nail's outline from that of the unit circle."""
    return np.sign(coordinate) * np.abs(coordinate) ** _OUTLINE_EXPONENT
