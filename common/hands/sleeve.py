"""Sleeve of a human hand."""

import numpy as np

from congrasp.common.hands.flesh import Skeleton, Surface, wrist_circles
from congrasp.common.hands.rings import closed_surface, ring_angles

_SLEEVE = (
    (0.026, -0.004),
    (0.0245, 0.0008),
    (0.0245, 0.0030),
    (0.0265, 0.0042),
    (0.034, 0.0044),
    (0.036, 0.0034),
    (0.060, 0.0042),
    (0.082, 0.0056),
    (0.086, 0.0040),
)
"""Rings of the sleeve: distance behind the start of the wrist, and radius in excess of the wrist's,
m.
"""


def sleeve(skeleton: Skeleton) -> Surface:
    """A cuff around the wrist, which follows the palm."""
    centres, radii, back = wrist_circles(skeleton)
    side = np.cross(back, centres[-1] - centres[0])
    axes = np.stack([np.cross(side, back), side])
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    angle = ring_angles()
    out = np.stack([np.cos(angle), np.sin(angle)], -1) @ axes
    # The circle that the outline touches in each direction
    farthest = (centres @ out.T + radii[:, None]).argmax(0)
    centre = centres[farthest]
    radius = radii[farthest]
    rings = []
    for behind, wider in _SLEEVE:
        rings.append(centre + (radius + wider)[:, None] * out + behind * back)
    return closed_surface(np.array(rings), 0, len(skeleton.names))
