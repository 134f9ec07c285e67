"""The hand's surface by link for recordings: rigid parts, each sent once in the frame of its link.

Surfaces of robots are rigid. A human hand's skin deforms, but its points at every step would make a recording many
times as large. A triangle of skin therefore belongs to every link with a noticeable weight on it, so that the parts of
two links overlap at a bent joint.
"""

import contextlib
import functools
from typing import NamedTuple

import numpy as np
import trimesh

from congrasp.common.errors import CongraspError
from congrasp.common.hands.skeleton import skeleton_of
from congrasp.common.hands.skin import MATERIALS, Skin, skin_of, skin_on
from congrasp.common.hands.spec import Hand
from congrasp.services.record.palette import MATERIALS as COLOURS
from congrasp.services.record.palette import Colour

_OVERLAP = 0.4  # weight of a link on a vertex above which the triangle belongs to the link
_MOST_FACES = 12_000  # triangles of a hand; meshes of links may have more
_GRID = 2.0**-14  # resolution of coordinates, m: few digits compress well
_POINTS = 2048  # points on a hand


class Part(NamedTuple):
    """A rigid part of a link in one colour, in the link's frame, m."""

    colour: Colour
    points: np.ndarray
    """(V, 3), within 0.05 mm."""
    faces: np.ndarray
    """(E, 3) int, with outward normals."""


@functools.lru_cache(maxsize=16)
def surface_parts(hand: Hand) -> tuple[tuple[Part, ...], ...]:
    """Parts of each link, one of each material."""
    skin = _skin(hand)
    strongest = np.eye(len(hand.links), dtype=bool)[skin.weights[skin.faces].sum(1).argmax(-1)]
    members = strongest | (skin.weights[skin.faces].max(1) >= _OVERLAP)
    kept = min(1.0, _MOST_FACES / len(skin.faces))
    found = []
    for member, origin in zip(members.T, skin.origins, strict=True):
        parts = []
        for number, name in enumerate(MATERIALS):
            faces = skin.faces[member & (skin.material[skin.faces[:, 0]] == number)]
            if len(faces):
                parts.append(Part(COLOURS[name], *_light(skin.points[faces] - origin, kept)))
        found.append(tuple(parts))
    return tuple(found)


@functools.lru_cache(maxsize=16)
def surface_points(hand: Hand) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Points (n, 3) on the parts of each link, in its frame, and their colours (n, 3), for viewers without meshes."""
    parts = surface_parts(hand)
    area = sum(_mesh(part).area for own in parts for part in own)
    found = []
    for own in parts:
        points, colours = [np.zeros((0, 3))], [np.zeros((0, 3))]
        for part in own:
            mesh = _mesh(part)
            points.append(trimesh.sample.sample_surface(mesh, round(_POINTS * mesh.area / area), seed=0)[0])
            colours.append(np.tile(part.colour, (len(points[-1]), 1)))
        found.append((np.concatenate(points), np.concatenate(colours)))
    return tuple(found)


def _skin(hand: Hand) -> Skin:
    """Surface of the hand; made of its capsules if custom meshes cannot be read."""
    with contextlib.suppress(CongraspError):
        return skin_of(hand)
    return skin_on(skeleton_of(hand))


def _light(corners: np.ndarray, kept: float) -> tuple[np.ndarray, np.ndarray]:
    """Points and faces of a share of triangles (E, 3, 3), on a grid and without duplicate points."""
    mesh = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    if kept < 1.0:
        mesh = mesh.simplify_quadric_decimation(face_count=max(4, int(kept * len(mesh.faces))))
    points, found = np.unique(np.round(mesh.vertices / _GRID), axis=0, return_inverse=True)
    faces = found.reshape(-1)[mesh.faces]
    a, b, c = faces.T
    return points * _GRID, faces[(a != b) & (b != c) & (c != a)]


def _mesh(part: Part) -> trimesh.Trimesh:
    """Returns a part as a trimesh mesh."""
    return trimesh.Trimesh(part.points, part.faces, process=False)
