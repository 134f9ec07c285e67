"""Colours of hand, object and constraints in every picture, recording and export: red, green, blue
from 0 to 1.

Meshes with the colours of an object are subdivided finely enough for vertex colours to show a
texture.
"""

import functools

import numpy as np
from scipy.spatial import cKDTree

from congrasp.common.objects.spec import Colours

Colour = tuple[float, float, float]

SKIN: Colour = (0.70, 0.73, 0.79)
"""Colour of robots' links, and of capsules."""
FLESH: Colour = (0.86, 0.65, 0.54)
JOINT: Colour = (0.30, 0.32, 0.37)
"""Colour of robots' joints."""
MATERIALS = {
    "flesh": FLESH,
    "nail": (0.94, 0.77, 0.70),
    "sleeve": (0.22, 0.28, 0.38),
    "link": SKIN,
    "joint": JOINT,
}
"""Colours of the materials in `common.hands.skin.MATERIALS`."""
OBJECT: Colour = (0.95, 0.62, 0.24)
TABLE: Colour = (0.80, 0.79, 0.77)
HEADING: Colour = (0.22, 0.40, 0.86)
"""Colour of headings and reference poses."""
WAYPOINT: Colour = (0.53, 0.30, 0.75)
GRASPABLE: Colour = (0.20, 0.65, 0.32)
AVOID: Colour = (0.80, 0.16, 0.16)
PIECES: tuple[Colour, ...] = (
    (0.90, 0.45, 0.36),
    (0.35, 0.63, 0.78),
    (0.95, 0.72, 0.30),
    (0.45, 0.70, 0.48),
    (0.66, 0.52, 0.78),
)
"""Colours of convex pieces, in turn."""
INK = "#262b35"
"""Colour of text and titles."""


_EDGE, _MOST_FACES = 0.006, 12_000
"""Edge length below which no edge is split, m; most faces."""
_OWN_EDGE, _OWN_MOST_FACES = 0.003, 40_000  # for coloured surfaces
_NEIGHBOURS = 8
"""Known points that determine a colour."""
_SIMILAR = 24.0
"""Distance of similar colours in sRGB from 0 to 255, a standard deviation."""


def finer(
    vertices: np.ndarray, faces: np.ndarray, edge: float = _EDGE, most: int = _MOST_FACES
) -> tuple[np.ndarray, np.ndarray]:
    """Subdivides a surface by repeatedly halving its longest edges.

    Args:
      vertices: (V, 3).
      faces: (F, 3).
      edge: edge length at which subdivision stops, m; edges of large surfaces stay longer.
      most: most faces; a mesh with as many is returned unchanged.

    Returns:
      Vertices (V', 3) float32 and faces (F', 3) int32.
    """
    corners = np.asarray(vertices, float)[faces]
    area = (
        np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1
        ).sum()
        / 2
    )
    longest = max(edge, 2.2 * float(np.sqrt(area / most)))
    if len(faces) >= most:
        return np.asarray(vertices, np.float32), np.asarray(faces, np.int32)
    points, found = np.unique(
        bisected(corners, longest, most).reshape(-1, 3), axis=0, return_inverse=True
    )
    return points.astype(np.float32), found.reshape(-1, 3).astype(np.int32)


def bisected(corners: np.ndarray, longest: float, most: float = np.inf) -> np.ndarray:
    """Bisects triangles at their longest sides until no side is longer than `longest`, or there are
    `most` triangles.

    Args:
      corners: (F, 3, C) positions of the corners, m, and further values, which are interpolated.
      longest: longest side, m.
      most: limit of the number of triangles; the longest sides are bisected first.
    """
    small, count = [], len(corners)
    while len(corners):
        sides = np.linalg.norm(corners[:, [1, 2, 0], :3] - corners[..., :3], axis=-1)
        order = np.argsort(-sides.max(1))
        cut = order[: int(min((sides.max(1) > longest).sum(), most - count))]
        small.append(corners[order[len(cut) :]])
        first = (sides[cut].argmax(1)[:, None] + np.arange(3)) % 3
        start, end, across = np.take_along_axis(corners[cut], first[..., None], 1).swapaxes(0, 1)
        middle = (start + end) / 2
        corners = np.concatenate(
            [np.stack([start, middle, across], 1), np.stack([middle, end, across], 1)]
        )
        count += len(cut)
    return np.concatenate([*small, corners])


def painted(
    vertices: np.ndarray, faces: np.ndarray, colours: Colours
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Subdivides a mesh (V, 3), (F, 3); returns it with (V', 3) uint8 sRGB (`colours_at`).

    Results of the last few objects are cached; the arrays are read-only.
    """
    kinds = (
        (vertices, float),
        (faces, np.int64),
        (colours.points, float),
        (colours.values, np.uint8),
    )
    return _painted(*(np.asarray(array, kind).tobytes() for array, kind in kinds))


@functools.lru_cache(maxsize=8)
def _painted(*content: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`painted` by the content of its arrays, as a cache key."""
    kinds = float, np.int64, float, np.uint8
    corners, faces, *own = (
        np.frombuffer(a, kind).reshape(-1, 3) for a, kind in zip(content, kinds, strict=True)
    )
    vertices, faces = finer(corners, faces, _OWN_EDGE, _OWN_MOST_FACES)
    found = vertices, faces, colours_at(vertices, Colours(*own))
    for array in found:
        array.flags.writeable = False
    return found


def region_colours(points: np.ndarray, avoid: np.ndarray) -> Colours:
    """Colours of surface points (P, 3), m, in the avoid region (P,) bool or the graspable
    region.
    """
    return Colours(
        points, np.round(255 * np.where(avoid[:, None], AVOID, GRASPABLE)).astype(np.uint8)
    )


def colours_at(points: np.ndarray, colours: Colours) -> np.ndarray:
    """(n, 3) uint8 sRGB at points (n, 3) of a surface, from the nearest known points.

    The known point whose colour most of its neighbours share, by their distances, wins; the result
    is the mean of the similar ones. So an edge between two colours is sharp, and has no teeth as
    with the single nearest point.
    """
    neighbours = np.arange(min(_NEIGHBOURS, len(colours.points))) + 1
    distance, index = cKDTree(colours.points).query(points, k=neighbours)
    width = np.maximum(distance.mean(1, keepdims=True), 1e-9)
    weight = np.exp(-((distance / width) ** 2)).astype(np.float32)
    values = colours.values[index].astype(np.float32)
    best = np.full(len(points), -1.0, np.float32)
    mean = np.zeros((len(points), 3), np.float32)
    for candidate in range(len(neighbours)):
        apart = np.square(values - values[:, candidate, None]).sum(-1)
        similar = weight * np.exp(-apart / (2 * _SIMILAR**2))
        support = similar.sum(1)
        is_better = support > best
        best[is_better] = support[is_better]
        total = np.einsum("nk,nkd->nd", similar[is_better], values[is_better])
        mean[is_better] = total / support[is_better, None]
    return np.round(mean).astype(np.uint8)
