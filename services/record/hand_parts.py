"""The surface of a hand as rigid parts of its links, which a recording sends once."""

import contextlib
import functools
from typing import NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands.flesh import skeleton_of
from congrasp.common.hands.skin import MATERIALS, Skin, skin_of, skin_on
from congrasp.common.hands.spec import Hand
from congrasp.common.runtime.lazy_trimesh import trimesh
from congrasp.services.appearance.palette import MATERIAL_COLOURS, Colour

_OVERLAP = 0.4
"""Weight of a link on a vertex from which the triangle belongs to the link."""
_MAX_FACES = 12_000
"""Most triangles of a hand; the meshes of its links are simplified to them."""
_MIN_FACES_OF_PART = 4
"""Fewest triangles to which a part is simplified: those of a tetrahedron."""
_GRID_M = 2.0**-14
"""Resolution of coordinates: few digits compress well."""
_POINTS_ON_HAND = 2048
"""Number of points for viewers without meshes."""


class Part(NamedTuple):
    """A rigid part of a link in one colour, in the link's frame, m."""

    colour: Colour
    points: np.ndarray
    """(V, 3), within 0.05 mm."""
    faces: np.ndarray
    """(E, 3) int, with outward normals."""


@functools.lru_cache(maxsize=16)
def surface_parts(hand: Hand) -> tuple[tuple[Part, ...], ...]:
    """Rigid parts of the surface of each link, one of each material, in the link's frame.

    A human hand's skin deforms, but its points at every step would make a recording many times as
    large. A triangle of skin therefore belongs to every link with a noticeable weight on it, so
    that the parts of two links overlap at a bent joint.
    """
    skin = _skin(hand)
    weights = skin.weights[skin.faces]  # (E, 3, L), of the corners of each triangle
    strongest = np.eye(len(hand.links), dtype=bool)[weights.sum(1).argmax(-1)]
    members = strongest | (weights.max(1) >= _OVERLAP)
    share = min(1.0, _MAX_FACES / len(skin.faces))
    material_of_face = skin.material[skin.faces[:, 0]]
    parts_of_links = []
    for is_member, origin in zip(members.T, skin.origins, strict=True):
        parts = []
        for number, name in enumerate(MATERIALS):
            faces = skin.faces[is_member & (material_of_face == number)]
            if len(faces):
                points, few_faces = _simplified(skin.points[faces] - origin, share)
                parts.append(Part(MATERIAL_COLOURS[name], points, few_faces))
        parts_of_links.append(tuple(parts))
    return tuple(parts_of_links)


@functools.lru_cache(maxsize=16)
def surface_points(hand: Hand) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Points (n, 3) on the parts of each link, in its frame, and their colours (n, 3), for viewers
    without meshes.
    """
    parts_of_links = surface_parts(hand)
    area = 0.0
    for parts in parts_of_links:
        for part in parts:
            area += _mesh(part).area
    return tuple(_sample(parts, area) for parts in parts_of_links)


def _sample(parts: tuple[Part, ...], area: float) -> tuple[np.ndarray, np.ndarray]:
    """Samples points on the parts of a link, evenly by area.

    Args:
      parts: the parts.
      area: area of all parts of the hand, m^2.

    Returns:
      Points (n, 3) in the link's frame, m, and their colours (n, 3).
    """
    points = [np.zeros((0, 3))]
    colours = [np.zeros((0, 3))]
    for part in parts:
        mesh = _mesh(part)
        count = round(_POINTS_ON_HAND * mesh.area / area)
        points.append(trimesh.sample.sample_surface(mesh, count, seed=0)[0])
        colours.append(np.tile(part.colour, (count, 1)))
    return np.concatenate(points), np.concatenate(colours)


def _skin(hand: Hand) -> Skin:
    """Surface of the hand; that of its capsules if custom meshes cannot be read."""
    with contextlib.suppress(CongraspError):
        return skin_of(hand)
    return skin_on(skeleton_of(hand))


def _simplified(corners: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Simplifies a mesh, and rounds its points to a grid.

    Args:
      corners: (E, 3, 3) m, corners of the triangles.
      share: share of the triangles to keep, at most 1.

    Returns:
      Different points (V, 3), m, and faces (F, 3) with an area.
    """
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    mesh = trimesh.Trimesh(corners.reshape(-1, 3), faces)
    if share < 1.0:
        count = max(_MIN_FACES_OF_PART, int(share * len(mesh.faces)))
        mesh = mesh.simplify_quadric_decimation(face_count=count)
    points, index = np.unique(np.round(mesh.vertices / _GRID_M), axis=0, return_inverse=True)
    rounded_faces = index.reshape(-1)[mesh.faces]
    a, b, c = rounded_faces.T
    has_area = (a != b) & (b != c) & (c != a)
    return points * _GRID_M, rounded_faces[has_area]


def _mesh(part: Part) -> "trimesh.Trimesh":
    """Returns a part as a trimesh mesh."""
    return trimesh.Trimesh(part.points, part.faces, process=False)
