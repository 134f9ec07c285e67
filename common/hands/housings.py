"""Bevelled housings of robots' links, and drums at their joints."""

import itertools
from typing import NamedTuple

import numpy as np

from congrasp.common.hands.flesh import Skeleton, Surface
from congrasp.common.runtime.lazy_trimesh import trimesh

_SECTIONS = 20
"""Sides of a housing."""
_BEVEL = 0.45
"""Bevel of a housing's ends, in radii."""
_DRUM_RADIUS = 0.72
"""Radius of a joint's drum, in radii of its link."""
_DRUM_LENGTH = 1.04
"""Half length of a joint's drum, in radii of its link."""
_DRUM_BEVEL = 0.2
"""Length of a drum's bevelled ends, in radii of its link."""


def housings(skeleton: Skeleton) -> tuple[Surface, np.ndarray]:
    """Returns a bevelled housing around every capsule, a drum at every joint, and a mask (V,) of
    the joints' points.
    """
    shells = []
    links = []
    for (start, end), radius, link in zip(
        skeleton.capsules, skeleton.radii, skeleton.capsule_link, strict=True
    ):
        shells.append(_bevelled_cylinder(start, end, radius, radius))
        links.append(link)
    housing_count = len(shells)
    for anchor, axis, link in zip(
        skeleton.anchors, skeleton.axes, skeleton.joint_link, strict=True
    ):
        link_radii = skeleton.radii[skeleton.capsule_link == link]
        if not len(link_radii):
            continue
        radius = link_radii[0]
        bevelled_length = _DRUM_BEVEL * radius
        half = _DRUM_LENGTH * radius * axis - bevelled_length * axis
        drum = _bevelled_cylinder(
            anchor - half, anchor + half, _DRUM_RADIUS * radius, bevelled_length
        )
        shells.append(drum)
        links.append(skeleton.parents[link])
    counts = [len(shell.points) for shell in shells]
    firsts = np.cumsum([0, *counts[:-1]])
    faces = [shell.faces + first for shell, first in zip(shells, firsts, strict=True)]
    surface = Surface(
        points=np.concatenate([shell.points for shell in shells]),
        normals=np.concatenate([shell.normals for shell in shells]),
        faces=np.concatenate(faces),
        weights=np.eye(len(skeleton.names))[np.repeat(links, counts)],
    )
    is_drum = np.arange(len(shells)) >= housing_count
    return surface, np.repeat(is_drum, counts)


class _Shell(NamedTuple):
    """A closed surface."""

    points: np.ndarray
    """(V, 3) m."""
    normals: np.ndarray
    """(V, 3) unit."""
    faces: np.ndarray
    """(F, 3)."""


def _bevelled_cylinder(start: np.ndarray, end: np.ndarray, radius: float, reach: float) -> _Shell:
    """A cylinder with bevelled ends that extends by `reach` (m) beyond both points (3,)."""
    length = float(np.linalg.norm(end - start))
    bevel = _BEVEL * min(radius, reach)
    outline = [
        (0.0, -reach),
        (radius - bevel, -reach),
        (radius, bevel - reach),
        (radius, length + reach - bevel),
        (radius - bevel, length + reach),
        (0.0, length + reach),
    ]
    points: list[np.ndarray] = []
    normals: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    turn = np.eye(3)
    if length > 1e-9:
        turn = trimesh.geometry.align_vectors([0, 0, 1], (end - start) / length)[:3, :3]
    angles = 2 * np.pi * np.arange(_SECTIONS) / _SECTIONS
    around = np.stack([np.cos(angles), np.sin(angles)], -1)
    # Separate points for each strip give sharp edges
    for (r0, z0), (r1, z1) in itertools.pairwise(outline):
        out = np.array([z1 - z0, r0 - r1]) / np.hypot(z1 - z0, r0 - r1)
        first = _SECTIONS * len(points)
        for r, z in ((r0, z0), (r1, z1)):
            points.append(np.column_stack([r * around, np.full(_SECTIONS, z)]))
            normals.append(np.column_stack([out[0] * around, np.full(_SECTIONS, out[1])]))
        here = first + np.arange(_SECTIONS)
        after = first + (np.arange(_SECTIONS) + 1) % _SECTIONS
        if r0 > 0:
            faces.append(np.column_stack([here, after, after + _SECTIONS]))
        if r1 > 0:
            faces.append(np.column_stack([here, after + _SECTIONS, here + _SECTIONS]))
    return _Shell(
        start + np.concatenate(points) @ turn.T,
        np.concatenate(normals) @ turn.T,
        np.concatenate(faces),
    )
