"""Nails of a human hand."""

import numpy as np
from scipy.spatial import cKDTree

from congrasp.common.hands.flesh import Skeleton, Surface
from congrasp.common.hands.rings import closed_surface, ring_angles

_NAIL = (
    (0.2, 0.0005),
    (0.55, 0.0005),
    (0.9, 0.0004),
    (1.0, 0.0001),
    (0.9, -0.0012),
    (0.2, -0.0012),
)
"""Rings of a nail: size as a share of the nail's outline, and height above the skin, m."""
_NAIL_WIDTH = 0.90
"""Half width of a nail, rad about the finger."""
_NAIL_LENGTH = 0.85
"""Half length of a nail, in radii of the fingertip."""
_NAIL_BACK = 0.30
"""Distance of a nail behind the centre of the fingertip, in radii of the fingertip."""
_SQUARE = 0.65
"""Exponent of the nail's outline; 1 is an ellipse."""


def nails(skeleton: Skeleton, skin: Surface) -> list[Surface]:
    """A nail on the back of each fingertip that a joint bends; it moves with the skin below it."""
    surfaces = []
    skin_points = cKDTree(skin.points)
    for chain in skeleton.chains():
        tip = chain[-1]
        bends = np.flatnonzero(skeleton.joint_link == tip)
        if not len(bends):
            continue
        capsule = np.flatnonzero(skeleton.capsule_link == tip)[0]
        start, end = skeleton.capsules[capsule]
        along = (end - start) / np.linalg.norm(end - start)
        back = -np.cross(skeleton.axes[bends[-1]], along)
        back = back / np.linalg.norm(back)
        rings = _nail_rings(end, along, back, skeleton.radii[capsule])
        nail = closed_surface(rings, tip, len(skeleton.names))
        _, nearest = skin_points.query(nail.points)
        weights = skin.weights[nearest].mean(0)
        surfaces.append(nail._replace(weights=np.tile(weights, (len(nail.points), 1))))
    return surfaces


def _nail_rings(
    centre: np.ndarray, along: np.ndarray, back: np.ndarray, radius: float
) -> np.ndarray:
    """Rings (R, S, 3) of a nail.

    Args:
      centre: (3,) centre of the fingertip's ball, m.
      along: (3,) unit, direction of the finger.
      back: (3,) unit, direction of its back.
      radius: radius of the fingertip, m.
    """
    angle = ring_angles()
    across = _rounded(np.cos(angle))
    forward = _rounded(np.sin(angle))
    rings = []
    for share, height in _NAIL:
        turn = _NAIL_WIDTH * share * across
        place = radius * (_NAIL_LENGTH * share * forward - _NAIL_BACK)
        radial = np.cos(turn)[:, None] * back + np.sin(turn)[:, None] * np.cross(along, back)
        # Over the ball at the finger's end
        down = np.clip(place / radius, 0, np.pi / 2)[:, None]
        out = np.cos(down) * radial + np.sin(down) * along
        rings.append(centre + np.minimum(place, 0)[:, None] * along + (radius + height) * out)
    return np.array(rings)


def _rounded(wave: np.ndarray) -> np.ndarray:
    """Returns a coordinate of the nail's outline from that of a circle."""
    return np.sign(wave) * np.abs(wave) ** _SQUARE
