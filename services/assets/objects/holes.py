"""Holes in the surface of a mesh: their rims, and how they are filled."""

import numpy as np
import trimesh


def hole_loops(mesh: trimesh.Trimesh) -> list[np.ndarray]:
    """Returns the vertices around every hole, in the order of the triangles' edges.

    Returns an empty list if the rim of a hole does not close, for then the mesh cannot be closed.
    """
    edges = np.asarray(mesh.edges)
    vertex_count = len(mesh.vertices)
    forward = edges[:, 0] * vertex_count + edges[:, 1]
    backward = edges[:, 1] * vertex_count + edges[:, 0]
    next_vertices: dict[int, list[int]] = {}  # along edges of one triangle alone
    for start, end in edges[~np.isin(forward, backward)].tolist():
        next_vertices.setdefault(start, []).append(end)
    loops = []
    while next_vertices:
        path = [next(iter(next_vertices))]
        while path:
            ends = next_vertices.get(path[-1])
            if not ends:
                return []
            end = ends.pop()
            if not ends:
                del next_vertices[path[-1]]
            if end in path:  # holes that meet in one vertex are separate holes
                first = path.index(end)
                loops.append(np.array(path[first:]))
                del path[first:]
                if not path:
                    break
            path.append(end)
    return loops


def fill(mesh: trimesh.Trimesh, loops: list[np.ndarray]) -> trimesh.Trimesh:
    """Returns the mesh with every hole closed.

    Triangles between the vertices of the rim close it: they join the sides of a slit along a bend,
    which a fan around its middle would cut short. Where they would repeat an edge of the mesh, a
    fan closes it.

    Args:
      mesh: the mesh.
      loops: vertices around every hole (`hole_loops`).
    """
    vertices = np.asarray(mesh.vertices)
    edges = {tuple(edge) for edge in np.sort(mesh.edges_unique, axis=1).tolist()}
    covers = [np.asarray(mesh.faces)]
    middles: list[np.ndarray] = []
    for loop in loops:
        cover = _cover(vertices, loop, edges)
        if cover is None:
            middle = np.full(len(loop), len(vertices) + len(middles))
            cover = np.stack([np.roll(loop, -1), loop, middle], -1)
            middles.append(vertices[loop].mean(0))
        covers.append(cover)
    all_vertices = np.concatenate([vertices, np.reshape(middles, (-1, 3))])
    return trimesh.Trimesh(all_vertices, np.concatenate(covers), process=False)


def _cover(
    vertices: np.ndarray, loop: np.ndarray, edges: set[tuple[int, ...]]
) -> np.ndarray | None:
    """Closes a loop by triangles (N - 2, 3), each of which cuts off the corner with the shortest
    base.

    Args:
      vertices: (V, 3) of the mesh.
      loop: (N,) vertices around the hole.
      edges: edges in use, to which the bases are added.

    Returns:
      The triangles; None if every remaining base would repeat an edge in use.
    """
    rim = loop.tolist()
    faces: list[list[int]] = []
    bases_in_use: set[tuple[int, ...]] = set()
    while len(rim) > 3:
        before = np.roll(rim, 1)
        after = np.roll(rim, -1)
        lengths = np.linalg.norm(vertices[after] - vertices[before], axis=-1)
        bases = [tuple(base) for base in np.sort([before, after], axis=0).T.tolist()]
        is_used = np.array([base in edges or base in bases_in_use for base in bases])
        if is_used.all():
            return None
        corner = int(np.where(is_used, np.inf, lengths).argmin())
        faces.append([after[corner], rim[corner], before[corner]])
        bases_in_use.add(bases[corner])
        del rim[corner]
    faces.append(rim[::-1])
    edges |= bases_in_use
    return np.array(faces)
