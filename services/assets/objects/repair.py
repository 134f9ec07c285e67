"""Repairs of a mesh, with notes that describe them for non-experts."""

import numpy as np
import trimesh
from trimesh.geometry import faces_to_edges
from trimesh.graph import connected_component_labels
from trimesh.proximity import closest_point

from congrasp.services.assets.objects.holes import fill, hole_loops

MAX_FACES = 20_000
"""Triangles beyond which a mesh is reduced before anything else is done with it."""
MAX_UNMERGED_FACES = 200_000
"""Triangles beyond which a mesh is reduced before other checks."""
_MAX_MISSING_SHARE = 0.05
"""Share of a mesh that repairs may add or leave out."""
_MAX_FIN_RINGS = 10
"""Rings of triangles that may stand out from a closed surface."""
_MAX_FIN_DISTANCE = 0.01
"""Distance of fins from the surface, as a share of the mesh's size."""


def without_gaps(
    vertices: np.ndarray, faces: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray] | None:
    """Returns a mesh without vertices that are not finite numbers.

    Args:
      vertices: (V, 3).
      faces: (F, 3).
      notes: the number of such vertices is appended.

    Returns:
      Vertices (V, 3) and faces; None if too much of the mesh would be missing.
    """
    finite = np.isfinite(vertices).all(-1)
    if finite.all():
        return vertices, faces
    complete = finite[faces].all(-1)
    if complete.mean() < 1 - _MAX_MISSING_SHARE:
        return None
    count = int((~finite).sum())
    verb = "is" if count == 1 else "are"
    notes.append(f"{count} of its points {verb} not a number and {_was(count)} left out")
    return np.where(finite[:, None], vertices, 0.0), faces[complete]


def reduced(
    vertices: np.ndarray, faces: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Returns a very large mesh with fewer triangles and with merged vertices.

    Args:
      vertices: (V, 3).
      faces: (F, 3); up to 200,000 are unchanged.
      notes: the numbers of triangles are appended.
    """
    if len(faces) <= MAX_UNMERGED_FACES:
        return vertices, faces
    _, first, merged_index = np.unique(_hashes(vertices), return_index=True, return_inverse=True)
    faces_of_merged = merged_index.reshape(-1)[faces]
    a, b, c = faces_of_merged.T
    is_proper = (a != b) & (b != c) & (c != a)
    mesh = trimesh.Trimesh(vertices[first], faces_of_merged[is_proper], process=False)
    small = with_few_faces(mesh)
    notes.append(
        f"its {len(faces):,} triangles were reduced to {len(small.faces):,}: a hand does not feel "
        f"the rest"
    )
    return np.asarray(small.vertices), np.asarray(small.faces)


def merged(vertices: np.ndarray, faces: np.ndarray, notes: list[str]) -> trimesh.Trimesh:
    """Returns a mesh with merged vertices, and with each proper triangle once.

    The vertices stay unmerged if only that leaves it closed: bodies that touch along an edge.

    Args:
      vertices: (V, 3).
      faces: (F, 3).
      notes: repeated triangles are appended.
    """
    unmerged = trimesh.Trimesh(vertices, faces, process=False)
    mesh = unmerged.copy()
    mesh.merge_vertices()
    if len(mesh.faces):
        mesh.update_faces(mesh.nondegenerate_faces())
        mesh = without_repeats(mesh, notes)
        mesh.remove_unreferenced_vertices()
    if unmerged.is_watertight and not mesh.is_watertight:
        return unmerged
    return mesh


def with_few_faces(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Returns the mesh with at most `MAX_FACES` triangles."""
    if len(mesh.faces) <= MAX_FACES:
        return mesh
    return mesh.simplify_quadric_decimation(face_count=MAX_FACES)


def encloses(mesh: trimesh.Trimesh) -> bool:
    """Returns True if a mesh encloses a volume.

    Its triangles then pass each edge as often forwards as backwards. Bodies of it may touch along
    edges, or intersect.
    """
    edges = np.asarray(mesh.edges)
    _, group = np.unique(_edge_codes(edges), return_inverse=True)
    directions = np.where(edges[:, 0] < edges[:, 1], 1, -1)
    passes = np.bincount(group.reshape(-1), directions)
    return not passes.any() and float(np.linalg.det(mesh.triangles).sum()) > 0


def without_repeats(mesh: trimesh.Trimesh, notes: list[str]) -> trimesh.Trimesh:
    """Returns the mesh with each triangle once.

    Of triangles that coincide and face one another, both are left out if the mesh is closed without
    them (bodies that touch); otherwise one remains (a sheet with two sides).
    """
    faces = np.asarray(mesh.faces)
    corners, group = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True)
    if len(corners) == len(faces):
        return mesh
    group = group.reshape(-1)
    is_forward = _is_even_permutation(faces).astype(int)
    net_forward = np.bincount(group, 2 * is_forward - 1, len(corners))
    first_backward = _first_rows(group, is_forward == 0, len(corners))
    first_forward = _first_rows(group, is_forward == 1, len(corners))
    used = np.minimum(first_backward, first_forward)
    used = np.where(net_forward < 0, first_backward, used)
    used = np.where(net_forward > 0, first_forward, used)
    is_single = net_forward != 0
    with_sheets = trimesh.Trimesh(mesh.vertices, faces[np.sort(used)], process=False)
    without_sheets = trimesh.Trimesh(mesh.vertices, faces[np.sort(used[is_single])], process=False)
    is_closed = is_single.any() and encloses(without_sheets)
    best = without_sheets if is_closed else with_sheets
    notes.append(f"{len(faces) - len(best.faces)} of its triangles were repeated and were left out")
    return best


def closed(mesh: trimesh.Trimesh, notes: list[str]) -> trimesh.Trimesh:
    """Returns the mesh with small holes closed and its triangles facing outwards, if possible."""
    mesh = _with_filled_holes(mesh, notes)
    if not mesh.is_watertight:
        mesh = _without_fins(mesh, notes)
    if mesh.is_watertight and not mesh.is_winding_consistent:
        consistent = _wound_consistently(mesh)
        if consistent.is_winding_consistent:
            notes.append("some of its triangles faced inwards and were turned")
            mesh = consistent
    with np.errstate(invalid="ignore"):  # a flat mesh has no centre of mass
        inside_out = mesh.is_watertight and mesh.is_winding_consistent and mesh.volume < 0
    if inside_out:
        mesh = mesh.copy()
        mesh.invert()
        notes.append("it was inside out and was turned")
    return mesh


def _hashes(vertices: np.ndarray) -> np.ndarray:
    """(V,) uint64, equal for equal vertices (V, 3).

    Equal coordinates have equal bits, which sort much faster than rows of numbers.
    """
    positive_zeros = np.ascontiguousarray(vertices, np.float32) + 0.0
    bits = positive_zeros.view(np.uint32).astype(np.uint64)
    hashes = bits[:, 0] * np.uint64(0x9E3779B97F4A7C15)
    hashes ^= bits[:, 1] * np.uint64(0xC2B2AE3D27D4EB4F)
    hashes ^= (bits[:, 2] * np.uint64(0x165667B19E3779F9)) >> np.uint64(7)
    return hashes


def _edge_codes(edges: np.ndarray) -> np.ndarray:
    """(E,) numbers of edges (E, 2), the same in both directions."""
    count = int(edges.max(initial=0)) + 1
    return edges.min(1).astype(np.int64) * count + edges.max(1)


def _first_rows(group: np.ndarray, selected: np.ndarray, groups: int) -> np.ndarray:
    """(G,) first row of each group among the selected rows; -1 without one.

    Args:
      group: (N,) group of each row.
      selected: (N,) bool.
      groups: number G of groups.
    """
    first = np.full(groups, -1)
    rows = np.flatnonzero(selected)[::-1]  # the first of a group is assigned last
    first[group[rows]] = rows
    return first


def _is_even_permutation(faces: np.ndarray) -> np.ndarray:
    """(F,) bool: triangles (F, 3) whose corners are an even permutation of their order."""
    a, b, c = faces.T
    ascents = (a < b).astype(int) + (b < c) + (c < a)
    return ascents == 2


def _with_filled_holes(mesh: trimesh.Trimesh, notes: list[str]) -> trimesh.Trimesh:
    """The mesh with its holes closed, if that closes it and adds little."""
    holes = hole_loops(mesh)
    if not holes:
        return mesh
    filled = fill(mesh, holes)
    added_area = filled.area - mesh.area
    if not filled.is_watertight or added_area >= _MAX_MISSING_SHARE * mesh.area:
        return mesh
    plural = "s" if len(holes) > 1 else ""
    notes.append(f"{len(holes)} hole{plural} in its surface {_was(len(holes))} closed")
    return filled


def _without_fins(mesh: trimesh.Trimesh, notes: list[str]) -> trimesh.Trimesh:
    """The mesh without triangles at a free edge, and those at the edges that this frees.

    It is unchanged unless that closes it, and fins lie within `_MAX_FIN_DISTANCE` of the rest.
    """
    faces = np.asarray(mesh.faces)
    removed: list[np.ndarray] = []
    for _ in range(_MAX_FIN_RINGS):
        is_free = _has_free_edge(faces)
        if not is_free.any():
            break
        removed.append(faces[is_free])
        faces = faces[~is_free]
    else:
        return mesh
    rest = trimesh.Trimesh(mesh.vertices, faces, process=False)
    rest.remove_unreferenced_vertices()
    is_large = rest.area > (1 - _MAX_MISSING_SHARE) * mesh.area
    if not (removed and rest.is_watertight and is_large):
        return mesh
    samples = _fin_samples(mesh.vertices[np.concatenate(removed)])
    if closest_point(rest, samples)[1].max() >= _MAX_FIN_DISTANCE * mesh.scale:
        return mesh
    count = len(mesh.faces) - len(rest.faces)
    notes.append(f"{count} of its triangles stood out from its surface and {_was(count)} left out")
    return rest


def _has_free_edge(faces: np.ndarray) -> np.ndarray:
    """(F,) bool: triangles (F, 3) with an edge that no other triangle has."""
    codes = _edge_codes(faces_to_edges(faces))
    _, group, counts = np.unique(codes, return_inverse=True, return_counts=True)
    is_free = counts[group.reshape(-1)] == 1
    return is_free.reshape(-1, 3).any(1)


def _fin_samples(corners: np.ndarray) -> np.ndarray:
    """Corners, middles of edges and centres (7 F, 3) of triangles (F, 3, 3)."""
    middles = (corners + np.roll(corners, 1, 1)) / 2
    centers = corners.mean(1, keepdims=True)
    return np.concatenate([corners, middles, centers], axis=1).reshape(-1, 3)


def _wound_consistently(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Triangles turned so that neighbours run along their common edge in opposite directions."""
    pairs = np.asarray(mesh.face_adjacency)
    faces = np.asarray(mesh.faces).copy()
    common_edges = np.asarray(mesh.face_adjacency_edges)
    first_along = _runs_along(faces[pairs[:, 0]], common_edges)
    second_along = _runs_along(faces[pairs[:, 1]], common_edges)
    differ = first_along == second_along
    # Two copies of every triangle, unchanged and turned: neighbours that run alike join the other's
    # opposite copy.
    count = len(faces)
    first = np.concatenate([pairs[:, 0], pairs[:, 0] + count])
    second = np.concatenate([pairs[:, 1] + count * differ, pairs[:, 1] + count * ~differ])
    labels = connected_component_labels(np.column_stack([first, second]), 2 * count)
    # Of the two copies of a body, the one in which more triangles are unchanged is used.
    lower = np.minimum(labels[:count], labels[count:])
    turned = labels[:count] != lower
    total = np.bincount(lower, minlength=labels.max() + 1)
    turned_total = np.bincount(lower, weights=turned, minlength=labels.max() + 1)
    flip = turned_total > total / 2
    turned = turned ^ flip[lower]
    faces[turned] = faces[turned][:, ::-1]
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def _runs_along(faces: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(N,) bool: triangles (N, 3) that run along an edge (N, 2) from its first vertex."""
    place = (faces == edges[:, :1]).argmax(1)
    following = faces[np.arange(len(faces)), (place + 1) % 3]
    return following == edges[:, 1]


def _was(count: int) -> str:
    """Verb for a number of items."""
    return "was" if count == 1 else "were"
