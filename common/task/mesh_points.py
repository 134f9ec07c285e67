"""Points spread over meshes of links, for measuring penetrations."""

from collections.abc import Mapping

import numpy as np

from congrasp.common.runtime.lazy_trimesh import trimesh

_CELL = 0.004
"""Spacing of points on a hand's meshes, m."""
_MAX_POINTS = 2048
"""Most points on a hand's meshes."""
_SAMPLES_PER_CELL = 8
"""Samples of the surface in the area of a cell."""
_WIDER = 1.2
"""Factor on the spacing if there are too many points."""


def points_on_meshes(
    meshes: Mapping[int, tuple[np.ndarray, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray]:
    """Links (P,) of points on meshes, and the points (P, 3).

    In each cell of a grid the point farthest from its link's centre is kept, so that corners are
    preserved. Cells are `_CELL` wide, or wider if more than `_MAX_POINTS` points would remain. The
    initial spacing sqrt(area / `_MAX_POINTS`) bounds the number of samples.

    Args:
      meshes: vertices and faces by link.
    """
    area = 0.0
    for mesh in meshes.values():
        area += float(trimesh.Trimesh(*mesh, process=False).area)
    cell = max(_CELL, float(np.sqrt(area / _MAX_POINTS)))
    points = _thinned_each(meshes, cell)
    while sum(map(len, points.values())) > _MAX_POINTS:
        cell *= _WIDER
        points = _thinned_each(meshes, cell)
    counts = [len(part) for part in points.values()]
    links = np.repeat(np.array([*points], int), counts)
    empty = np.zeros((0, 3))
    return links, np.concatenate([empty, *points.values()]).astype(np.float32)


def _thinned_each(
    meshes: Mapping[int, tuple[np.ndarray, np.ndarray]], cell: float
) -> dict[int, np.ndarray]:
    """Points (P, 3) on the mesh of each link, at this spacing."""
    points = {}
    for link, (vertices, faces) in meshes.items():
        points[link] = _thinned(vertices, faces, cell)
    return points


def _thinned(vertices: np.ndarray, faces: np.ndarray, cell: float) -> np.ndarray:
    """Points (P, 3) on a mesh, one in each cell of a grid: the farthest from the centre."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    count = max(1, int(_SAMPLES_PER_CELL * mesh.area / cell**2))
    samples, _ = trimesh.sample.sample_surface(mesh, count, seed=0)
    points = np.concatenate([vertices[np.unique(faces)], samples])
    farthest_first = np.argsort(-np.linalg.norm(points - points.mean(0), axis=-1), kind="stable")
    points = points[farthest_first]
    _, first_of_cell = np.unique(np.floor(points / cell), axis=0, return_index=True)
    return points[first_of_cell]
