"""Repairs of a mesh, with notes that describe them for non-experts."""

import numpy as np
import trimesh
from trimesh.geometry import faces_to_edges
from trimesh.graph import connected_component_labels
from trimesh.proximity import closest_point

from congrasp.services.assets.objects.holes import fill, hole_loops

MAX_SIMPLE_FACES = 20_000
"""Most triangles of a simplified mesh, for pictures and decomposition."""
MAX_FACES_AT_READING = 200_000
"""Most triangles of a file that are kept; a mesh with more is simplified at once, because merging
its vertices and repairing it would be slow."""
_MAX_INVALID_SHARE = 0.05
"""Share of the triangles that may be left out because a vertex is not finite."""
_MAX_FILLED_SHARE = 0.05
"""Limit of the area that filled holes add, as a share of the mesh's area."""
_MAX_FIN_SHARE = 0.05
"""Limit of the area of fins, as a share of the mesh's area."""
_MAX_FIN_RINGS = 10
"""Most rings of triangles from the free edge of a fin to its middle."""
_MAX_FIN_DISTANCE_SHARE = 0.01
"""Limit of the distance of fins from the rest, as a share of the diagonal of the mesh's bounding
box."""


def without_invalid_vertices(
    vertices: np.ndarray, faces: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray] | None:
    """Leaves out the triangles of a mesh that have a vertex without finite coordinates.

    Args:
      vertices: (V, 3).
      faces: (F, 3).
      notes: the number of such vertices is appended.

    Returns:
      Vertices (V, 3) and faces (F', 3); such vertices remain at the origin, and no face uses them.
      None if too many triangles would be left out.
    """
    is_finite = np.isfinite(vertices).all(-1)
    if is_finite.all():
        return vertices, faces
    is_valid = is_finite[faces].all(-1)
    if is_valid.mean() < 1 - _MAX_INVALID_SHARE:
        return None
    count = int((~is_finite).sum())
    have = "has" if count == 1 else "have"
    notes.append(f"{count} of its points {have} no finite coordinates and {_was(count)} left out")
    return np.where(is_finite[:, None], vertices, 0.0), faces[is_valid]


def reduce_large(
    vertices: np.ndarray, faces: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Merges the vertices of a very large mesh and simplifies it to `MAX_SIMPLE_FACES` triangles.

    Args:
      vertices: (V, 3).
      faces: (F, 3); a mesh with at most `MAX_FACES_AT_READING` is unchanged.
      notes: the numbers of triangles are appended.

    Returns:
      Vertices (V', 3) and faces (F', 3).
    """
    if len(faces) <= MAX_FACES_AT_READING:
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


def merge_vertices(vertices: np.ndarray, faces: np.ndarray, notes: list[str]) -> trimesh.Trimesh:
    """Returns a mesh with merged vertices, with each triangle once and without those of no area.

    The vertices stay unmerged if only that leaves the mesh closed, as for bodies that touch along
    an edge.

    Args:
      vertices: (V, 3).
      faces: (F, 3).
      notes: repeated triangles are appended.
    """
    unmerged = trimesh.Trimesh(vertices, faces, process=False)
    mesh = unmerged.copy()
    mesh.merge_vertices()
    notes_on_merged: list[str] = []
    if len(mesh.faces):
        mesh.update_faces(mesh.nondegenerate_faces())
        mesh = without_repeats(mesh, notes_on_merged)
        mesh.remove_unreferenced_vertices()
    if unmerged.is_watertight and not mesh.is_watertight:
        return unmerged
    notes += notes_on_merged
    return mesh


def with_few_faces(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Returns the mesh with at most `MAX_SIMPLE_FACES` triangles."""
    if len(mesh.faces) <= MAX_SIMPLE_FACES:
        return mesh
    return mesh.simplify_quadric_decimation(face_count=MAX_SIMPLE_FACES)


def encloses(mesh: trimesh.Trimesh) -> bool:
    """Returns True if a mesh encloses a volume.

    Its triangles then pass each edge as often forwards as backwards. Its bodies may touch along
    edges, or intersect.
    """
    edges = np.asarray(mesh.edges)
    _, group = np.unique(_edge_codes(edges), return_inverse=True)
    directions = np.where(edges[:, 0] < edges[:, 1], 1, -1)
    passes = np.bincount(group.reshape(-1), directions)
    return not passes.any() and float(np.linalg.det(mesh.triangles).sum()) > 0


def without_repeats(mesh: trimesh.Trimesh, notes: list[str]) -> trimesh.Trimesh:
    """Returns the mesh with each triangle once.

    Two triangles with the same corners that face one another are either both left out or reduced to
    one. They are left out if the mesh is closed without them, as for bodies that touch; one remains
    if they are the two sides of a sheet.

    Args:
      mesh: the mesh.
      notes: the number of triangles that were left out is appended.
    """
    faces = np.asarray(mesh.faces)
    corners, group = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True)
    group_count = len(corners)
    if group_count == len(faces):
        return mesh
    group = group.reshape(-1)
    # Triangles of a group have the same corners, in one of two orientations. Let `excess` be the
    # number of forward copies minus that of backward ones:
    # * excess > 0: the first forward copy remains;
    # * excess < 0: the first backward copy remains;
    # * excess = 0: a sheet, whose first copy remains in `with_sheets` alone.
    is_forward = _is_even_permutation(faces)
    excess = np.bincount(group, np.where(is_forward, 1, -1), group_count)
    first_forward = _first_rows(group, is_forward, group_count)
    first_backward = _first_rows(group, ~is_forward, group_count)
    remaining = np.minimum(first_forward, first_backward)
    remaining = np.where(excess > 0, first_forward, remaining)
    remaining = np.where(excess < 0, first_backward, remaining)
    is_sheet = excess == 0
    rows_with_sheets = np.sort(remaining)
    rows_without_sheets = np.sort(remaining[~is_sheet])
    with_sheets = trimesh.Trimesh(mesh.vertices, faces[rows_with_sheets], process=False)
    without_sheets = trimesh.Trimesh(mesh.vertices, faces[rows_without_sheets], process=False)
    is_closed = not is_sheet.all() and encloses(without_sheets)
    best = without_sheets if is_closed else with_sheets
    count = len(faces) - len(best.faces)
    notes.append(f"{count} of its triangles {_was(count)} repeated and {_was(count)} left out")
    return best


def close_and_orient(mesh: trimesh.Trimesh, notes: list[str]) -> trimesh.Trimesh:
    """Returns the mesh with small holes closed, without fins and with its triangles facing
    outwards, as far as that is possible.

    Of several bodies, one that alone is inside out remains so: the sign of the total volume
    decides.

    Args:
      mesh: the mesh.
      notes: a description of each repair is appended.
    """
    mesh = _with_filled_holes(mesh, notes)
    if not mesh.is_watertight:
        mesh = _without_fins(mesh, notes)
    if mesh.is_watertight and not mesh.is_winding_consistent:
        consistent = _wind_consistently(mesh)
        if consistent.is_winding_consistent:
            notes.append("some of its triangles faced inwards and were turned")
            mesh = consistent
    with np.errstate(invalid="ignore"):  # a flat mesh has no centre of mass
        is_inside_out = mesh.is_watertight and mesh.is_winding_consistent and mesh.volume < 0
    if is_inside_out:
        mesh = mesh.copy()
        mesh.invert()
        notes.append("it was inside out and was turned")
    return mesh


def _hashes(vertices: np.ndarray) -> np.ndarray:
    """Hashes (V,) uint64 of vertices (V, 3) in single precision.

    They sort much faster than rows of coordinates. Different vertices have different hashes except
    for a chance of some 1e-8 in a million vertices. The multipliers are odd numbers with random
    bits: that of SplitMix64, and two primes of xxHash64.
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


def _first_rows(group: np.ndarray, is_selected: np.ndarray, group_count: int) -> np.ndarray:
    """(G,) first row of each group among the selected rows; -1 without one.

    Args:
      group: (N,) group of each row.
      is_selected: (N,) bool.
      group_count: number G of groups.
    """
    first = np.full(group_count, -1)
    rows = np.flatnonzero(is_selected)[::-1]  # the first of a group is assigned last
    first[group[rows]] = rows
    return first


def _is_even_permutation(faces: np.ndarray) -> np.ndarray:
    """(F,) bool: triangles (F, 3) whose corners are an even permutation of ascending corners."""
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
    if not filled.is_watertight or added_area >= _MAX_FILLED_SHARE * mesh.area:
        return mesh
    plural = "s" if len(holes) > 1 else ""
    notes.append(f"{len(holes)} hole{plural} in its surface {_was(len(holes))} closed")
    return filled


def _without_fins(mesh: trimesh.Trimesh, notes: list[str]) -> trimesh.Trimesh:
    """Returns a mesh that is closed apart from fins without these fins.

    A fin is a sheet that stands out from a closed surface. Triangles with a free edge, which no
    other triangle has, are removed ring by ring until no edge is free. The mesh is returned
    unchanged if the rest is not closed, or if the removed triangles are too many or too far from
    the rest to be fins.
    """
    faces = np.asarray(mesh.faces)
    rings: list[np.ndarray] = []
    is_free = _has_free_edge(faces)
    while is_free.any():
        if len(rings) == _MAX_FIN_RINGS:
            return mesh
        rings.append(faces[is_free])
        faces = faces[~is_free]
        is_free = _has_free_edge(faces)
    rest = trimesh.Trimesh(mesh.vertices, faces, process=False)
    rest.remove_unreferenced_vertices()
    is_large = rest.area > (1 - _MAX_FIN_SHARE) * mesh.area
    if not (rings and rest.is_watertight and is_large):
        return mesh
    samples = _fin_samples(mesh.vertices[np.concatenate(rings)])
    if closest_point(rest, samples)[1].max() >= _MAX_FIN_DISTANCE_SHARE * mesh.scale:
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


def _wind_consistently(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Turns triangles so that neighbours run along their common edge in opposite directions."""
    pairs = np.asarray(mesh.face_adjacency)
    faces = np.asarray(mesh.faces).copy()
    common_edges = np.asarray(mesh.face_adjacency_edges)
    first_along = _runs_along(faces[pairs[:, 0]], common_edges)
    second_along = _runs_along(faces[pairs[:, 1]], common_edges)
    clash = first_along == second_along  # both run along it in one direction: turn one of them
    # A graph with two copies of every triangle: i is triangle i unchanged, i + count is it turned.
    # Neighbours are connected in the copies that fit: the same one of both, or opposite ones.
    count = len(faces)
    first = np.concatenate([pairs[:, 0], pairs[:, 0] + count])
    second_of_unchanged = pairs[:, 1] + np.where(clash, count, 0)
    second_of_turned = pairs[:, 1] + np.where(clash, 0, count)
    second = np.concatenate([second_of_unchanged, second_of_turned])
    labels = connected_component_labels(np.column_stack([first, second]), 2 * count)
    # A body thus has two components, which wind it in the two possible ways. The smaller label
    # names the body; the way in which more triangles are unchanged is used.
    body = np.minimum(labels[:count], labels[count:])
    is_turned = labels[:count] != body
    label_count = labels.max() + 1
    faces_of_body = np.bincount(body, minlength=label_count)
    turned_of_body = np.bincount(body, weights=is_turned, minlength=label_count)
    use_other_way = turned_of_body > faces_of_body / 2
    is_turned = is_turned ^ use_other_way[body]
    faces[is_turned] = faces[is_turned][:, ::-1]
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def _runs_along(faces: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(N,) bool: triangles (N, 3) that run along an edge (N, 2) from its first vertex."""
    start = (faces == edges[:, :1]).argmax(1)
    next_vertex = faces[np.arange(len(faces)), (start + 1) % 3]
    return next_vertex == edges[:, 1]


def _was(count: int) -> str:
    """Verb for a number of items."""
    return "was" if count == 1 else "were"
