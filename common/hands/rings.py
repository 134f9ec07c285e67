"""Closed surfaces through rings of points, for the nails and the sleeve of a hand."""

import numpy as np

from congrasp.common.hands.flesh import Surface
from congrasp.common.runtime.lazy_trimesh import trimesh

POINTS_PER_RING = 28


def ring_angles() -> np.ndarray:
    """(S,) angles of the points of a ring, rad."""
    return 2 * np.pi * np.arange(POINTS_PER_RING) / POINTS_PER_RING


def closed_surface(rings: np.ndarray, link: int, links: int) -> Surface:
    """The closed surface through rings (R, S, 3) of points, flat at both ends, which follows one of
    a hand's links.

    Args:
      rings: (R, S, 3) m; each ring has S points.
      link: index of the link.
      links: number of links of the hand.
    """
    count, around = rings.shape[:2]
    points = np.concatenate([rings.reshape(-1, 3), rings[[0, -1]].mean(1)])
    here = np.arange(around)
    after = np.roll(here, -1)
    faces = [np.stack([after, here, np.full(around, count * around)], -1)]
    for first in around * np.arange(count - 1):
        low = first + here
        low_next = first + after
        high = low + around
        high_next = low_next + around
        faces.append(np.stack([low, low_next, high], -1))
        faces.append(np.stack([low_next, high_next, high], -1))
    last = (count - 1) * around
    faces.append(np.stack([last + here, last + after, np.full(around, count * around + 1)], -1))
    mesh = trimesh.Trimesh(points, np.concatenate(faces), process=False)
    if mesh.volume < 0:
        mesh.invert()
    weights = np.zeros((len(points), links))
    weights[:, link] = 1.0
    return Surface(points, np.array(mesh.vertex_normals), np.array(mesh.faces), weights)
