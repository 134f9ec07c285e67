"""Repairs a mesh, and describes the repairs for non-experts."""

import numpy as np
import trimesh
from scipy.ndimage import binary_propagation, distance_transform_edt, label
from trimesh.geometry import faces_to_edges
from trimesh.graph import connected_component_labels
from trimesh.proximity import closest_point

from congrasp.services.assets.objects.fidelity import voxels
from congrasp.services.assets.objects.options import LONGEST

MAX_FACES = 20_000
"""Triangles beyond which a mesh is reduced before anything else is done with it."""
OPENING = 0.01
"""Width of an opening that no finger enters, m."""
_REDUCED = 200_000  # triangles above which a mesh is reduced before other checks
_FEW = 0.05  # share of a mesh that may be missing
_FLAT = 0.08  # of its width: greatest thickness of a table
_SMALLEST = 0.03  # m: least length of what is left of a scan without its table
_FINS = 10  # rings of triangles that may stand out from a closed surface
_NEAR = 0.01  # of the size: how far they may
_APART = 0.02  # of the mesh's size: bodies whose boxes are nearer than this belong together


def without_gaps(
    vertices: np.ndarray, faces: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray] | None:
    """A mesh (V, 3), (F, 3) without vertices that are not finite numbers; None if too much of it
    would be missing.
    """
    good = np.isfinite(vertices).all(-1)
    if good.all():
        return vertices, faces
    whole = good[faces].all(-1)
    if whole.mean() < 1 - _FEW:
        return None
    bad = int((~good).sum())
    notes.append(
        f"{bad} of its points {'is' if bad == 1 else 'are'} not a number and {_was(bad)} left out"
    )
    return np.where(good[:, None], vertices, 0.0), faces[whole]


def reduced(
    vertices: np.ndarray, faces: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """A mesh of more than `_REDUCED` triangles with fewer of them, and with merged vertices."""
    if len(faces) <= _REDUCED:
        return vertices, faces
    before = len(faces)
    # Equal coordinates have equal bits, which sort much faster than rows of numbers.
    bits = (np.ascontiguousarray(vertices, np.float32) + 0.0).view(np.uint32).astype(np.uint64)
    keys = (bits[:, 0] * np.uint64(0x9E3779B97F4A7C15)) ^ (
        bits[:, 1] * np.uint64(0xC2B2AE3D27D4EB4F)
    )
    keys ^= (bits[:, 2] * np.uint64(0x165667B19E3779F9)) >> np.uint64(7)
    _, first, merged = np.unique(keys, return_index=True, return_inverse=True)
    vertices, faces = vertices[first], merged.reshape(-1)[faces]
    proper = (
        (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    )
    small = with_few_faces(trimesh.Trimesh(vertices, faces[proper], process=False))
    notes.append(
        f"its {before:,} triangles were reduced to {len(small.faces):,}: a hand does not feel the "
        f"rest"
    )
    return np.asarray(small.vertices), np.asarray(small.faces)


def merged(vertices: np.ndarray, faces: np.ndarray, notes: list[str]) -> trimesh.Trimesh:
    """A mesh (V, 3), (F, 3) with merged vertices and each proper triangle once; unmerged if only
    that leaves it closed.

    The latter are bodies that touch along an edge.
    """
    apart = trimesh.Trimesh(vertices, faces, process=False)
    mesh = apart.copy()
    mesh.merge_vertices()
    if len(mesh.faces):
        mesh.update_faces(mesh.nondegenerate_faces())
        mesh = without_repeats(mesh, notes)
        mesh.remove_unreferenced_vertices()
    return apart if apart.is_watertight and not mesh.is_watertight else mesh


def with_few_faces(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with at most `MAX_FACES` triangles."""
    return (
        mesh
        if len(mesh.faces) <= MAX_FACES
        else mesh.simplify_quadric_decimation(face_count=MAX_FACES)
    )


def largest_body(mesh: trimesh.Trimesh, notes: list[str]) -> trimesh.Trimesh:
    """The largest of several bodies that lie apart from one another; parts that lie close together
    are one body.
    """
    labels = connected_component_labels(mesh.edges, len(mesh.vertices))
    if (count := labels.max() + 1) == 1:
        return mesh
    order = np.argsort(labels, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(labels[order]) > 0])
    vertices = np.asarray(mesh.vertices)
    low = np.minimum.reduceat(vertices[order], starts) - _APART / 2 * mesh.scale
    high = np.maximum.reduceat(vertices[order], starts) + _APART / 2 * mesh.scale
    body = np.arange(count)
    sizes = np.linalg.norm(high - low, axis=-1)
    for i in np.argsort(-sizes):  # from the largest on, bodies in contact are merged
        touching = (low[i] <= high).all(-1) & (low <= high[i]).all(-1)
        body[np.isin(body, body[touching])] = body[i]
    if len(np.unique(body)) == 1:
        return mesh
    chosen = body[np.argmax(sizes)]
    kept = (body == chosen)[labels][np.asarray(mesh.faces)[:, 0]]
    share = float(mesh.area_faces[kept].sum() / mesh.area)
    others = len(np.unique(body)) - 1
    notes.append(
        f"it holds {others + 1} separate bodies; the largest was taken ({share:.0%} of the "
        f"surface): "
        "to use another one, save it as a file of its own"
    )
    used, faces = np.unique(np.asarray(mesh.faces)[kept], return_inverse=True)
    return trimesh.Trimesh(vertices[used], faces.reshape(-1, 3), process=False)


def without_table(mesh: trimesh.Trimesh, metres: float, notes: list[str]) -> trimesh.Trimesh:
    """A scan longer than `LONGEST` without its table: a flat body, the longest and wide by far.

    The rest, without debris, must be as long as `_SMALLEST` and lie on one side of the table; else
    the scan is kept.

    Args:
      mesh: the scan, in any unit.
      metres: metres per unit.
      notes: a table is appended.
    """
    if mesh.extents.max() * metres <= LONGEST:
        return mesh
    labels = connected_component_labels(mesh.edges, len(mesh.vertices))
    low, high = (
        reduce.reduceat(
            mesh.vertices[order := np.argsort(labels, kind="stable")],
            np.unique(labels[order], True)[1],
        )
        for reduce in (np.minimum, np.maximum)
    )
    is_table = labels == np.linalg.norm(high - low, axis=-1).argmax()
    if is_table.all():
        return mesh
    rest = trimesh.Trimesh(mesh.vertices, mesh.faces[~is_table[mesh.faces[:, 0]]], process=False)
    rest.remove_unreferenced_vertices()
    said: list[str] = []
    rest = largest_body(rest, said)
    table = mesh.vertices[is_table]
    axes = np.linalg.svd(table - table.mean(0), full_matrices=False)[2]
    (low, high), (least, most) = (
        ((p @ axes.T).min(0), (p @ axes.T).max(0)) for p in (table, rest.vertices)
    )
    size, wide = high - low, float((most - least)[:2].max())
    flat = size[2] < _FLAT * size[1] and wide < size[1] / 2
    within = (low <= least)[:2].all() and (most <= high)[:2].all()
    middle = (low + high)[2] / 2
    beside = least[2] > middle or most[2] < middle
    if not (flat and within and beside and rest.extents.max() * metres >= _SMALLEST):
        return mesh
    notes += [
        f"a flat body {size[1] / wide:.1f} times as wide as the rest was left out: a table",
        *said,
    ]
    return rest


def bodies(vertices: np.ndarray, faces: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Vertices (V, 3) and faces (F, 3) of each body of a closed mesh, with the hollows inside of
    it.
    """
    labels = connected_component_labels(faces_to_edges(faces), len(vertices))[faces[:, 0]]
    shells = [faces[labels == i] for i in np.unique(labels)]
    solid = [shell for shell in shells if np.linalg.det(vertices[shell]).sum() > 0]
    boxes = [np.stack([vertices[body].min((0, 1)), vertices[body].max((0, 1))]) for body in solid]
    for shell in shells:
        if np.linalg.det(vertices[shell]).sum() > 0:
            continue
        corners = vertices[shell].reshape(-1, 3)
        around = [
            i
            for i, (low, high) in enumerate(boxes)
            if (low <= corners).all() and (corners <= high).all()
        ]
        if around:
            i = min(around, key=lambda i: float(np.ptp(boxes[i], axis=0).prod()))
            solid[i] = np.concatenate([solid[i], shell])
    parts = [np.unique(body, return_inverse=True) for body in solid]
    return [(vertices[used], places.reshape(-1, 3)) for used, places in parts]


def encloses(mesh: trimesh.Trimesh) -> bool:
    """True if a mesh encloses a volume: its triangles pass each edge as often forwards as
    backwards.

    Bodies of it may touch along edges, or intersect.
    """
    edges = np.asarray(mesh.edges)
    _, group = np.unique(_codes(edges), return_inverse=True)
    passes = np.bincount(group.reshape(-1), np.where(edges[:, 0] < edges[:, 1], 1, -1))
    return not passes.any() and float(np.linalg.det(mesh.triangles).sum()) > 0


def _codes(edges: np.ndarray) -> np.ndarray:
    """(E,) numbers of edges (E, 2), the same in both directions."""
    return edges.min(1).astype(np.int64) * (int(edges.max(initial=0)) + 1) + edges.max(1)


def without_repeats(mesh: trimesh.Trimesh, notes: list[str]) -> trimesh.Trimesh:
    """The mesh with each triangle once.

    Of triangles that coincide and face one another, both are left out if the mesh is closed without
    them (bodies that touch); otherwise one remains (a sheet with two sides).
    """
    faces = np.asarray(mesh.faces)
    corners, group = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True)
    if len(corners) == len(faces):
        return mesh
    group = group.reshape(-1)
    ahead = _even(faces).astype(int)
    net = np.bincount(group, 2 * ahead - 1, len(corners))
    first = np.full((2, len(corners)), -1)
    for side in (0, 1):
        rows = np.flatnonzero(ahead == side)[::-1]
        first[side, group[rows]] = rows
    kept = np.where(net > 0, first[1], np.where(net < 0, first[0], np.minimum(first[0], first[1])))
    single = trimesh.Trimesh(mesh.vertices, faces[np.sort(kept)], process=False)
    without = trimesh.Trimesh(mesh.vertices, faces[np.sort(kept[net != 0])], process=False)
    best = without if (net != 0).any() and without.is_watertight else single
    notes.append(f"{len(faces) - len(best.faces)} of its triangles were repeated and were left out")
    return best


def _even(faces: np.ndarray) -> np.ndarray:
    """(F,) bool: triangles (F, 3) whose corners are an even permutation of their order."""
    return (
        (faces[:, 0] < faces[:, 1]).astype(int)
        + (faces[:, 1] < faces[:, 2])
        + (faces[:, 2] < faces[:, 0])
    ) == 2


def closed(mesh: trimesh.Trimesh, notes: list[str]) -> trimesh.Trimesh:
    """The mesh with small holes closed and its triangles facing outwards, if possible."""
    holes = _loops(mesh)
    if holes:
        filled = _filled(mesh, holes)
        added = filled.area - mesh.area
        if filled.is_watertight and added < _FEW * mesh.area:
            notes.append(
                f"{len(holes)} hole{'s' if len(holes) > 1 else ''} in its surface "
                f"{_was(len(holes))} closed"
            )
            mesh = filled
    if not mesh.is_watertight and (trimmed := _without_fins(mesh)) is not None:
        count = len(mesh.faces) - len(trimmed.faces)
        notes.append(
            f"{count} of its triangles stood out from its surface and {_was(count)} left out"
        )
        mesh = trimmed
    if mesh.is_watertight and not mesh.is_winding_consistent:
        outwards = _wound_alike(mesh)
        if outwards.is_winding_consistent:
            notes.append("some of its triangles faced inwards and were turned")
            mesh = outwards
    with np.errstate(invalid="ignore"):  # a flat mesh has no centre of mass
        inside_out = mesh.is_watertight and mesh.is_winding_consistent and mesh.volume < 0
    if inside_out:
        mesh = mesh.copy()
        mesh.invert()
        notes.append("it was inside out and was turned")
    return mesh


def _without_fins(mesh: trimesh.Trimesh) -> trimesh.Trimesh | None:
    """The mesh without triangles at a free edge, and those at the edges that this frees.

    None unless that closes it, and all that is left out lies within `_NEAR` of the rest.
    """
    faces, removed = np.asarray(mesh.faces), list[np.ndarray]()
    for _ in range(_FINS):
        _, group, counts = np.unique(
            _codes(faces_to_edges(faces)), return_inverse=True, return_counts=True
        )
        free = (counts[group.reshape(-1)] == 1).reshape(-1, 3).any(1)
        if not free.any():
            rest = trimesh.Trimesh(mesh.vertices, faces, process=False)
            rest.remove_unreferenced_vertices()
            if not (removed and rest.is_watertight and rest.area > (1 - _FEW) * mesh.area):
                return None
            corners = mesh.vertices[np.concatenate(removed)]
            points = np.concatenate(
                [corners, (corners + np.roll(corners, 1, 1)) / 2, corners.mean(1, keepdims=True)],
                axis=1,
            )
            return (
                rest
                if closest_point(rest, points.reshape(-1, 3))[1].max() < _NEAR * mesh.scale
                else None
            )
        removed.append(faces[free])
        faces = faces[~free]
    return None


def without_hollows(mesh: trimesh.Trimesh, notes: list[str]) -> trimesh.Trimesh:
    """A closed mesh without the walls of hollows that no finger enters, whose openings are closed.

    A hollow is where a ball as wide as `OPENING` fits that cannot get out; it ends where one from
    outside gets to. The mesh is returned unchanged if its openings cannot be closed.
    """
    cubes = voxels(np.asarray(mesh.triangles), OPENING)
    spaces, count = label(distance_transform_edt(~cubes.inside, cubes.spacing) > OPENING / 2)
    if count < 2:
        return mesh
    outer = spaces == spaces[0, 0, 0]
    entered = distance_transform_edt(~outer, cubes.spacing) < OPENING / 2 + cubes.spacing
    hollow = binary_propagation((spaces > 0) & ~outer, mask=~cubes.inside & ~entered)
    centers, normals = np.asarray(mesh.triangles_center), np.asarray(mesh.face_normals)
    inner = np.any(
        [hollow[cubes.at(centers + step * cubes.spacing * normals)] for step in (1.0, 1.5, 2.0)],
        axis=0,
    )
    rest = trimesh.Trimesh(mesh.vertices, mesh.faces[~inner], process=False)
    filled = _filled(rest, holes) if (holes := _loops(rest)) else rest
    volume = float(hollow.sum()) * cubes.spacing**3
    if not encloses(filled) or not 0.8 < (filled.volume - mesh.volume) / volume < 1.2:
        return mesh
    notes.append(
        f"its hollow of {1e6 * volume:.0f} cm^3, which no finger enters, is filled in its "
        f"collision shape"
    )
    return filled


def _loops(mesh: trimesh.Trimesh) -> list[np.ndarray]:
    """Vertices around every hole, in the order of the triangles' edges; none where the rim has an
    end.
    """
    edges = np.asarray(mesh.edges)
    size = len(mesh.vertices)
    forward, backward = edges[:, 0] * size + edges[:, 1], edges[:, 1] * size + edges[:, 0]
    after: dict[int, list[int]] = {}
    for start, end in edges[~np.isin(forward, backward)].tolist():
        after.setdefault(start, []).append(end)
    loops = []
    while after:
        path = [next(iter(after))]
        while path:
            ends = after.get(path[-1])
            if not ends:
                return []
            end = ends.pop()
            if not ends:
                del after[path[-1]]
            if end in path:  # holes that meet in one vertex are separate holes
                first = path.index(end)
                loops.append(np.array(path[first:]))
                del path[first:]
                if not path:
                    break
            path.append(end)
    return loops


def _filled(mesh: trimesh.Trimesh, holes: list[np.ndarray]) -> trimesh.Trimesh:
    """Every hole closed by a fan around its middle."""
    middles = [mesh.vertices[loop].mean(0) for loop in holes]
    fans = [
        np.stack([np.roll(loop, -1), loop, np.full(len(loop), len(mesh.vertices) + i)], -1)
        for i, loop in enumerate(holes)
    ]
    vertices, faces = np.concatenate([mesh.vertices, middles]), np.concatenate([mesh.faces, *fans])
    return trimesh.Trimesh(vertices, faces, process=False)


def _wound_alike(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Triangles turned so that neighbours run along their common edge in opposite directions."""
    pairs = np.asarray(mesh.face_adjacency)
    faces = np.asarray(mesh.faces).copy()
    common = np.asarray(mesh.face_adjacency_edges)

    def along(side: int) -> np.ndarray:
        """(n,) bool, True for triangles that run along the common edge from its first to its second
        vertex.
        """
        own = faces[pairs[:, side]]
        place = (own == common[:, :1]).argmax(1)
        return own[np.arange(len(own)), (place + 1) % 3] == common[:, 1]

    differ = along(0) == along(1)
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
    flip = np.bincount(lower, weights=turned, minlength=labels.max() + 1) > total / 2
    turned = turned ^ flip[lower]
    faces[turned] = faces[turned][:, ::-1]
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def _was(count: int) -> str:
    """Verb for a number of items."""
    return "was" if count == 1 else "were"
