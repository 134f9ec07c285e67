"""The right Allegro hand V3: four fingers of four joints each.

Geometry, limits and masses are those of the maker's published models (BSD-2, SimLab 2016). Wrist frame: origin at the
palm's mounting end, fingers towards +z, closing side +x, index finger on the side of +y. Collision geometry: the
maker's boxes, 20 x 27 mm across a phalanx, and round fingertips. Rewards and features use capsules of 23 mm.
"""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.hands.spec import Capsule, Hand, Joint, Link, Solid, Vector, chain, vector, wrist_gains

_GAINS = {"kp": 3.0, "kv": 0.1, "torque_limit": 0.7, "armature": 1e-3}
"""Gains of a PD controller that is common for this hand; the motors' greatest torque is 0.7 N.m."""
_LEAN = np.radians(5.0)
"""Outward lean of the index and the ring finger."""
_RADIUS, _TIP_RADIUS = 0.0115, 0.0120
_KNUCKLE = np.array([0.0, 0.0, 0.095])
"""Base of the middle finger, the palm's origin in the maker's models."""
_LIMITS = ((-0.47, 0.47), (-0.196, 1.61), (-0.174, 1.709), (-0.227, 1.618))
_THUMB_LIMITS = ((0.263, 1.396), (-0.105, 1.163), (-0.189, 1.644), (-0.162, 1.719))
_LENGTHS = (0.0164, 0.0540, 0.0384, 0.0267)
"""Distances between joints, and from the last joint to the fingertip's centre, m."""
_THICK, _WIDE = 0.0098, 0.01375
"""Half extents of a phalanx's box across the joint's axis and along it, m."""
_BOXES, _THUMB_BOXES = (0.0164, 0.0540, 0.0384, 0.0160), (0.0177, 0.0514, 0.0314)
"""Lengths of the boxes, m; the thumb's first link is a separate block."""
_NAMES = ("base", "proximal", "medial", "distal")


def _finger(name: str, base: np.ndarray, lean: float) -> tuple[Link, ...]:
    """Links of a finger with its base at `base` from the knuckle, leaning out by `lean` about the palm's normal."""
    along = np.array([0.0, np.sin(lean), np.cos(lean)])
    flexion = np.array([0.0, np.cos(lean), -np.sin(lean)])
    points = [vector(_KNUCKLE + base + reach * along) for reach in np.cumsum([0.0, *_LENGTHS])]
    axes = (along, flexion, flexion, flexion)
    links = _links(name, points, axes, _LIMITS, (0.0119, 0.0650, 0.0355, 0.0264), (0.5, 1.0, 1.0, 3.0))
    return _boxed(links, points, np.stack([np.cross(flexion, along), flexion, along], -1), _BOXES, (0.0190, 0.010))


def _boxed(
    links: tuple[Link, ...],
    points: list[Vector],
    axes: np.ndarray,
    lengths: tuple[float, ...],
    tip: tuple[float, float],
) -> tuple[Link, ...]:
    """Links with the maker's boxes, from `points` along the last column of `axes` (3, 3).

    The last link also gets a capsule `tip` (m from its joint to its middle, half length).
    """
    quaternion, along = _quaternion(axes), axes[:, 2]
    found = []
    for link, point, length in zip(links, points, lengths, strict=False):
        box = Solid("box", (_THICK, _WIDE, length / 2), vector(point + length / 2 * along), quaternion)
        found.append(dataclasses.replace(link, solids=(box,)))
    place, half = tip
    end = Solid("capsule", (_TIP_RADIUS, half, 0.0), vector(points[len(links) - 1] + place * along), quaternion)
    return (*found[:-1], dataclasses.replace(found[-1], solids=(*found[-1].solids, end)))


def _quaternion(axes: np.ndarray) -> tuple[float, float, float, float]:
    """Quaternion (w, x, y, z) of a frame with these axes as columns (3, 3)."""
    w, x, y, z = Rotation.from_matrix(axes).as_quat(scalar_first=True).tolist()
    return w, x, y, z


def _links(
    name: str,
    points: list[Vector],
    axes: tuple[np.ndarray, ...],
    limits: tuple[tuple[float, float], ...],
    masses: tuple[float, ...],
    weights: tuple[float, ...],
) -> tuple[Link, ...]:
    """The palm and the four fingers."""
    joints = [
        (Joint(f"{name}_{i}", vector(axis), point, *limit, **_GAINS),)
        for i, (axis, point, limit) in enumerate(zip(axes, points, limits, strict=False))
    ]
    return chain([f"{name}_{x}" for x in _NAMES], joints, points, [_RADIUS] * 3 + [_TIP_RADIUS], masses, weights)


def _thumb() -> tuple[Link, ...]:
    """The thumb: at zero it points away from the index finger's side, and its first joint turns it into opposition."""
    up = np.array([0.0, np.sin(_LEAN), np.cos(_LEAN)])
    out = np.array([0.0, np.cos(_LEAN), -np.sin(_LEAN)])
    forward = np.array([1.0, 0.0, 0.0])
    root = _KNUCKLE + np.array([-0.0182, 0.019333, -0.045987])
    first = root - 0.027 * up + 0.005 * forward + 0.0399 * out
    points = [root, *(first + reach * out for reach in (0.0, 0.0177, 0.0691, 0.1114))]
    axes = (-up, out, forward, forward)
    block, *rest = _links(
        "thumb",
        [vector(point) for point in points],
        axes,
        _THUMB_LIMITS,
        (0.0176, 0.0119, 0.0380, 0.0556),
        (1.0, 1.0, 2.0, 6.0),
    )
    # The first link is a block next to its joint's axis.
    middle = root - 0.0179 * up + 0.009 * forward + 0.0145 * out
    housing = Capsule(vector(middle - 0.008 * out), vector(middle + 0.008 * out), 0.0150)
    turn = np.stack([np.cross(forward, out), forward, out], -1)
    solid = Solid("box", (0.0179, 0.0170, 0.02275), vector(middle), _quaternion(turn))
    block = dataclasses.replace(block, capsules=(housing,), solids=(solid,))
    return (block, *_boxed(tuple(rest), points[1:], turn, _THUMB_BOXES, (0.0350, 0.008)))


_PALM = Link(
    "palm",
    "",
    (),
    tuple(Capsule((-0.0093, y, 0.0204), (-0.0093, y, 0.0746), 0.0204) for y in (-0.0361, -0.0120, 0.0120, 0.0361)),
    0.4154,
    1.0,
    solids=(Solid("box", (0.0204, 0.0565, 0.0475), (-0.0093, 0.0, 0.0475), (1.0, 0.0, 0.0, 0.0)),),
)

ALLEGRO = Hand(
    name="allegro",
    links=(
        _PALM,
        *_thumb(),
        *_finger("index", np.array([0.0, 0.0435, -0.001542]), _LEAN),
        *_finger("middle", np.array([0.0, 0.0, 0.0007]), 0.0),
        *_finger("ring", np.array([0.0, -0.0435, -0.001542]), -_LEAN),
    ),
    thumb="thumb_distal",
    open_pose={
        "thumb_0": 1.30,
        "thumb_1": 0.20,
        "thumb_2": 0.20,
        "thumb_3": 0.20,
        **{f"{finger}_{i}": x for finger in ("index", "middle", "ring") for i, x in ((1, 0.30), (2, 0.30), (3, 0.25))},
    },
    closed_pose={
        "thumb_0": 1.35,
        "thumb_1": 0.50,
        "thumb_2": 0.80,
        "thumb_3": 1.00,
        **{f"{finger}_{i}": x for finger in ("index", "middle", "ring") for i, x in ((1, 1.30), (2, 1.20), (3, 1.00))},
    },
    wide_pose={
        "thumb_0": 1.248,
        "thumb_1": 0.198,
        "thumb_2": -0.099,
        "thumb_3": 0.061,
        "index_0": -0.041,
        "index_1": 0.19,
        "index_2": 0.202,
        "index_3": 0.196,
        "middle_0": -0.013,
        "middle_1": 0.167,
        "middle_2": 0.238,
        "middle_3": 0.229,
        "ring_0": 0.007,
        "ring_1": 0.168,
        "ring_2": 0.237,
        "ring_3": 0.228,
    },
    wrist=wrist_gains(0.955),
    object_scale=1.4,
)
