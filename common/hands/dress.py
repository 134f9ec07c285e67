"""Nails and a sleeve of a human hand: closed shells about its flesh, in the wrist frame with every joint at zero."""

import numpy as np
import trimesh

from congrasp.common.hands.flesh import Surface, wrist_circles
from congrasp.common.hands.skeleton import Skeleton

_AROUND = 28  # points of a ring
_NAIL = ((0.2, 0.0004), (0.55, 0.0004), (0.9, 0.0003), (1.0, 0.0), (0.9, -0.0012), (0.2, -0.0012))
"""Rings of a nail: size as a share of the nail's outline, and height above the skin, m."""
_NAIL_WIDTH, _NAIL_LENGTH, _NAIL_BACK = 0.90, 0.85, 0.30
"""Half width of a nail, rad about the finger; its half length, and its distance behind the centre of the fingertip, in
radii of the tip."""
_SQUARE = 0.65  # exponent of the nail's outline; 1 is an ellipse
_SLEEVE = (
    *((0.026, -0.004), (0.0245, 0.0008), (0.0245, 0.0030), (0.0265, 0.0042), (0.034, 0.0044)),
    *((0.036, 0.0034), (0.060, 0.0042), (0.082, 0.0056), (0.086, 0.0040)),
)
"""Rings of the sleeve: distance behind the start of the wrist, and radius in excess of the wrist's, m."""


def nails(skeleton: Skeleton) -> list[Surface]:
    """A nail on the back of each fingertip that a joint bends; it follows the tip's link."""
    found = []
    for chain in skeleton.chains():
        bends = np.flatnonzero(skeleton.joint_link == chain[-1])
        if not len(bends):
            continue
        capsule = np.flatnonzero(skeleton.capsule_link == chain[-1])[0]
        (start, end), radius = skeleton.capsules[capsule], skeleton.radii[capsule]
        along = (end - start) / np.linalg.norm(end - start)
        back = -np.cross(skeleton.axes[bends[-1]], along)
        back = back / np.linalg.norm(back)
        angle = 2 * np.pi * np.arange(_AROUND) / _AROUND
        outline = [np.sign(wave) * np.abs(wave) ** _SQUARE for wave in (np.cos(angle), np.sin(angle))]
        rings = []
        for share, height in _NAIL:
            turn = _NAIL_WIDTH * share * outline[0]
            place = radius * (_NAIL_LENGTH * share * outline[1] - _NAIL_BACK)
            radial = np.cos(turn)[:, None] * back + np.sin(turn)[:, None] * np.cross(along, back)
            down = np.clip(place / radius, 0, np.pi / 2)[:, None]  # over the ball at the finger's end
            out = np.cos(down) * radial + np.sin(down) * along
            rings.append(end + np.minimum(place, 0)[:, None] * along + (radius + height) * out)
        found.append(_shell(np.array(rings), chain[-1], len(skeleton.names)))
    return found


def sleeve(skeleton: Skeleton) -> Surface:
    """A cuff around the wrist, which follows the palm."""
    centres, radii, back = wrist_circles(skeleton)
    side = np.cross(back, centres[-1] - centres[0])
    axes = np.stack([np.cross(side, back), side])
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    angle = 2 * np.pi * np.arange(_AROUND) / _AROUND
    out = np.stack([np.cos(angle), np.sin(angle)], -1) @ axes
    farthest = (centres @ out.T + radii[:, None]).argmax(0)  # the circle that the outline touches in each direction
    rings = [centres[farthest] + (radii[farthest] + wider)[:, None] * out + behind * back for behind, wider in _SLEEVE]
    return _shell(np.array(rings), 0, len(skeleton.names))


def _shell(rings: np.ndarray, link: int, links: int) -> Surface:
    """The closed surface through rings (R, S, 3), flat at both ends, which follows one link."""
    count, around = rings.shape[:2]
    points = np.concatenate([rings.reshape(-1, 3), rings[[0, -1]].mean(1)])
    here = np.arange(around)
    after = np.roll(here, -1)
    faces = [np.stack([after, here, np.full(around, count * around)], -1)]
    for first in around * np.arange(count - 1):
        a, b, c, d = first + here, first + after, first + around + here, first + around + after
        faces += [np.stack([a, b, c], -1), np.stack([b, d, c], -1)]
    last = (count - 1) * around
    faces.append(np.stack([last + here, last + after, np.full(around, count * around + 1)], -1))
    mesh = trimesh.Trimesh(points, np.concatenate(faces), process=False)
    if mesh.volume < 0:
        mesh.invert()
    weights = np.zeros((len(points), links))
    weights[:, link] = 1.0
    return Surface(points, np.array(mesh.vertex_normals), np.array(mesh.faces), weights)
