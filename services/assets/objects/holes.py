"""Holes in the surface of a mesh: their rims, and how they are filled."""

import numpy as np
import trimesh


def hole_loops(mesh: trimesh.Trimesh) -> list[np.ndarray]:
    """Returns the vertices around every hole, in the order of the triangles' edges.

    There are none where a rim has an end.
    """
    edges = np.asarray(mesh.edges)
    vertex_count = len(mesh.vertices)
    forward = edges[:, 0] * vertex_count + edges[:, 1]
    backward = edges[:, 1] * vertex_count + edges[:, 0]
    following: dict[int, list[int]] = {}
    for start, end in edges[~np.isin(forward, backward)].tolist():
        following.setdefault(start, []).append(end)
    loops = []
    while following:
        path = [next(iter(following))]
        while path:
            ends = following.get(path[-1])
            if not ends:
                return []
            end = ends.pop()
            if not ends:
                del following[path[-1]]
            if end in path:  # holes that meet in one vertex are separate holes
                first = path.index(end)
                loops.append(np.array(path[first:]))
                del path[first:]
                if not path:
                    break
            path.append(end)
    return loops


def fill(mesh: trimesh.Trimesh, loops: list[np.ndarray]) -> trimesh.Trimesh:
    """Returns the mesh with every hole closed by a fan around its middle.

    Args:
      mesh: the mesh.
      loops: vertices around every hole (`hole_loops`).
    """
    middles = [mesh.vertices[loop].mean(0) for loop in loops]
    fans = []
    for place, loop in enumerate(loops):
        middle = np.full(len(loop), len(mesh.vertices) + place)
        fans.append(np.stack([np.roll(loop, -1), loop, middle], -1))
    vertices = np.concatenate([mesh.vertices, middles])
    faces = np.concatenate([mesh.faces, *fans])
    return trimesh.Trimesh(vertices, faces, process=False)
