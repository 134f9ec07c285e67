"""Convex pieces of an object: those of its folder, or a decomposition of its meshes if those are
coarse.

A convex mesh is its hull. Others are cut by CoACD under limits, by V-HACD if that fails, or else
are their hull. The decomposers are native code, which runs in a confined process.

The pieces become fewer and simpler: joined where that preserves the shape, as thin as their walls,
with few vertices. The hull of a bent wall fills the inner side of the bend: at a bowl of 2 mm, half
of the wall's volume. Such a piece is thinned about its middle to the volume of the mesh in it,
which leaves half of the bend on either side.
"""

import contextlib
import heapq
import pathlib
import tempfile
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import trimesh
from scipy.ndimage import distance_transform_edt
from scipy.spatial import ConvexHull, QhullError
from trimesh.geometry import faces_to_edges
from trimesh.graph import is_watertight

from congrasp.common.errors import CongraspError
from congrasp.common.objects import shapes
from congrasp.common.objects.spec import MAX_MESH_PIECES, MAX_MESH_VERTICES
from congrasp.common.runtime.parallel import cores, memory
from congrasp.services.assets.confined import call_confined
from congrasp.services.assets.objects import repair
from congrasp.services.assets.objects.fidelity import (
    MOST_SURFACE,
    MOST_VOLUME,
    Fidelity,
    enclosed,
    fidelity,
    interior,
    voxels,
)
from congrasp.services.assets.objects.options import ImportOptions

FALLBACK_LIMIT = 30.0
"""Limit of V-HACD's processor time, s."""
STARVED = 20.0
"""Ratio of wall-clock to processor time above which the machine counts as too busy."""
LEAST_MEMORY = 2 << 30
"""Bytes of memory for which a child is started."""
_MEMORY = 6 << 30  # bytes of address space of a child, where there is enough for one on every core
_FINEST = 0.01  # the smallest threshold that CoACD takes, of half the longest side
_MESH, _PIECES = "mesh.npz", "pieces.npz"
DEPTH = 1.5e-3
"""Largest depth of the surface in a hull, or distance of the hull from it, for joins below the
limit of pieces, m.
"""
GROWTH = 0.02
"""Share of the volume that joins may add below the limit of pieces."""
_SAMPLES, _PROBES = 6000, 200  # points on the whole surface, and on the hull of two pieces
_DIRECTIONS = 300  # of the extreme vertices that larger hulls are reduced to
_NEAR = 5e-4  # m; pieces whose boxes are nearer than this are neighbours
# Points inside of the mesh; enough, and too few of them for one piece
_INNER, _ENOUGH, _FEW = (
    60_000,
    500,
    30,
)
# Hollow shares of its hull from which on a piece is thinned, and by which it is at most
_FULL, _MOST = (
    0.03,
    0.9,
)
_WALL = 0.02  # m; thicker pieces are not walls, and stay as thick as they are
_LEAST = 1e-11  # m^3; smaller pieces are dropped


class Surfaces(NamedTuple):
    """The surfaces of an object."""

    meshes: Sequence[trimesh.Trimesh]
    """One of the whole, or one of each part, m."""
    shown: Sequence[trimesh.Trimesh]
    """The same without hollows that no finger enters."""
    triangles: np.ndarray
    """(F, 3, 3) of all that are shown."""
    volume: float | None
    """Volume that they enclose (`fidelity.enclosed`), m^3; None if one is open."""


class Collision(NamedTuple):
    """Convex pieces and their errors."""

    hulls: list[np.ndarray]
    """Vertices (V, 3) of each piece, m."""
    owners: list[int]
    """Mesh of each piece."""
    errors: Fidelity
    """Errors relative to the object's surfaces."""

    def __str__(self) -> str:
        """Number of pieces, and their errors."""
        count = len(self.hulls)
        return f"{count} convex piece{'s stand' if count > 1 else ' stands'} for it: {self.errors}"


def convex_pieces(
    given: Sequence[np.ndarray],
    surfaces: Surfaces,
    options: ImportOptions,
    notes: list[str],
    *,
    shown: bool = True,
) -> Collision:
    """Returns the given pieces if their errors are small enough; else a decomposition, or the given
    ones if closer.

    Args:
      given: vertices (V, 3) of the convex pieces in the object's folder, m.
      surfaces: the object's surfaces.
      options: options of the import.
      notes: the selected pieces and their errors are appended.
      shown: False if the surfaces are those of the given pieces.

    Raises:
      scipy.spatial.QhullError: the object has no volume.
    """
    if not given:
        found = _cut(surfaces, options, notes)
        notes.append(str(found))
        return found
    hulls = merge(list(given), options.max_pieces, surfaces.triangles, surfaces.volume)
    if len(hulls) < len(given):
        notes.append(f"its {len(given)} convex pieces were merged into {len(hulls)} (--max-pieces)")
    own = _fitted(surfaces, hulls, [0] * len(hulls))
    if own.errors.excess <= 1 or not shown:
        notes.append(f"its own {own}")
        return own
    with contextlib.suppress(QhullError):
        said: list[str] = []
        cut = _cut(surfaces, options, said)
        if cut.errors.excess < own.errors.excess:
            notes.extend(said)
            notes.append(
                f"{cut}; they were cut from its mesh, for its own {len(own.hulls)} are coarser: "
                f"{own.errors}"
            )
            return cut
    notes.append(f"its own {own}; pieces cut from its mesh are no closer")
    return own


def _cut(surfaces: Surfaces, options: ImportOptions, notes: list[str]) -> Collision:
    """A decomposition of each mesh; each may have pieces according to its share of the volume."""
    meshes, volume = surfaces.meshes, surfaces.volume
    whole = [shapes.hull_of(mesh.vertices) for mesh in meshes]
    volumes = np.array([hull.volume for hull in whole])
    limits = [max(1, int(limit)) for limit in options.max_pieces * volumes / volumes.sum()]
    hulls, owners = list[np.ndarray](), list[int]()
    for owner, (mesh, shown, limit) in enumerate(zip(meshes, surfaces.shown, limits, strict=True)):
        small = repair.with_few_faces(mesh)
        closed = volume is not None and (small is mesh or repair.encloses(small))
        found = decompose(
            np.asarray(small.vertices),
            np.asarray(small.faces),
            shown=None if shown is mesh else np.asarray(shown.triangles),
            volume=(volume if len(meshes) == 1 else float(shown.volume)) if closed else None,
            time_limit=options.time_limit,
            max_pieces=limit,
        )
        hulls.extend(found.pieces)
        owners.extend([owner] * len(found.pieces))
        notes.extend(found.notes)
    cut = _fitted(surfaces, hulls, owners)
    if cut.errors.excess <= 1 or len(hulls) == len(meshes):
        return cut
    filled = _fitted(
        surfaces, [hull.points[hull.vertices] for hull in whole], list(range(len(meshes)))
    )
    if filled.errors.excess < cut.errors.excess:
        notes.append(
            f"its convex hull is closer to its shape than {len(hulls)} pieces ({cut.errors}): "
            f"hollows are filled"
        )
        return filled
    return cut


def _fitted(surfaces: Surfaces, found: list[np.ndarray], owners: list[int]) -> Collision:
    """Pieces (V, 3) of few vertices, and their errors."""
    hulls = [simplify(piece) for piece in found]
    return Collision(
        hulls, owners, fidelity(surfaces.triangles, hulls, surfaces.volume is not None)
    )


class Decomposition(NamedTuple):
    """Convex pieces of a mesh."""

    pieces: list[np.ndarray]
    """Vertices (V, 3) of each piece, in the mesh's frame."""
    method: str
    """"convex", "coacd", "vhacd" or "hull"."""
    notes: list[str]
    """Notes for the user."""


def decompose(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    volume: float | None,
    time_limit: float,
    max_pieces: int = MAX_MESH_PIECES,
    shown: np.ndarray | None = None,
) -> Decomposition:
    """Decomposes a triangle mesh into as few convex pieces as preserve its shape, at most
    `max_pieces`.

    Args:
      vertices: (V, 3), m, not all in a plane.
      faces: (F, 3).
      volume: volume that the approximated surface encloses if the mesh is closed
        (`fidelity.enclosed`), m^3; one close to that of the hull needs no decomposition.
      time_limit: processor time for CoACD, s; V-HACD gets half a minute after it.
      max_pieces: most pieces.
      shown: (T, 3, 3) corners of the surface to approximate, m, such as the mesh's without its
        hollows; by default the mesh's.

    Raises:
      CongraspError: the machine is too busy for the child to reach its limit.
    """
    shown = vertices[faces] if shown is None else shown
    hull = shapes.hull_of(vertices)
    whole = [hull.points[hull.vertices]]
    if volume is not None and _convex(hull, shown, volume):
        return Decomposition(whole, "convex", [])
    notes: list[str] = []
    for method, limit in (("coacd", time_limit), ("vhacd", FALLBACK_LIMIT)):
        found, failure = _in_child(
            method,
            {"vertices": vertices, "faces": faces, "shown": shown},
            volume,
            max_pieces,
            limit,
        )
        if found:
            return Decomposition(found, method, notes)
        notes.append(f"{method} {failure}")
    notes.append("the convex hull of the whole mesh stands in for it: hollows are filled")
    return Decomposition(whole, "hull", notes)


def _in_child(
    method: str, mesh: dict[str, Any], volume: float | None, max_pieces: int, limit: float
) -> tuple[list[np.ndarray], str]:
    """Returns the pieces, or none and the reason."""
    most = min(_MEMORY, max(LEAST_MEMORY, memory() // cores()))
    with tempfile.TemporaryDirectory(prefix="congrasp-") as name:
        folder, options = (
            pathlib.Path(name),
            {"method": method, "volume": volume, "max_pieces": max_pieces},
        )
        np.savez(folder / _MESH, **mesh)
        patience = STARVED * limit + STARVED
        try:
            call_confined(
                write_pieces, folder, options, memory=most, seconds=limit, patience=patience
            )
        except TimeoutError:
            raise CongraspError(
                f"The machine is too busy: {method} got less than {limit:g} s of processor time in "
                f"{patience:.0f} s.",
                "Stop other programs and try again.",
            ) from None
        except ChildProcessError as error:
            return [], str(error)
        with np.load(folder / _PIECES) as arrays:
            pieces = list(arrays.values())
    return pieces, "" if pieces else "found no piece"


def write_pieces(folder: pathlib.Path, method: str, volume: float | None, max_pieces: int) -> None:
    """Decomposes the mesh in a folder, in the confined process."""
    with np.load(folder / _MESH) as arrays:
        vertices, faces, shown = arrays["vertices"], arrays["faces"], arrays["shown"]
    if method == "coacd":
        # A closed mesh may be of several bodies that intersect, which CoACD cuts forever.
        parts = repair.bodies(vertices, faces) if volume else [(vertices, faces)]
        found = [piece for part in parts for piece in _by_coacd(*part, closed=bool(volume))]
    else:
        import vhacdx

        # The number of corners comes first, as in VTK
        rows = np.insert(faces, 0, 3, axis=1).astype(np.uint32)
        found = [
            piece[0]
            for piece in vhacdx.compute_vhacd(
                vertices, rows, maxConvexHulls=min(max_pieces, 1 << 20)
            )
        ]
    solid = [
        hull
        for hull in (solid_hull(np.asarray(piece, np.float64)) for piece in found)
        if hull is not None
    ]
    np.savez(folder / _PIECES, *merge([hull.points for hull in solid], max_pieces, shown, volume))


def _by_coacd(vertices: np.ndarray, faces: np.ndarray, *, closed: bool) -> list[np.ndarray]:
    """Vertices of the pieces of one body."""
    import coacd

    if closed and _convex(
        hull := shapes.hull_of(vertices), vertices[faces], enclosed(vertices[faces]).volume
    ):
        return [hull.points[hull.vertices]]
    # Measured: fine cuts that are joined afterwards are as faithful as a longer search, in a tenth
    # of the time. An open surface becomes a thin wall, which the same search would cut into
    # hundreds of pieces: a sphere without its top took 71 s and was 4.0 mm off, and takes 18 s and
    # is 4.1 mm off.
    search = {"mcts_iterations": 20, "mcts_nodes": 10, "mcts_max_depth": 2}
    if not closed:
        search = {
            "mcts_iterations": 10,
            "mcts_nodes": 5,
            "mcts_max_depth": 1,
            "preprocess_resolution": 40,
        }
    found = coacd.run_coacd(
        coacd.Mesh(vertices, faces),
        threshold=min(
            1.0, max(_FINEST, (2 if closed else 3) * DEPTH / np.ptp(vertices, axis=0).max())
        ),
        preprocess_mode="off" if closed and is_watertight(faces_to_edges(faces))[0] else "auto",
        merge=False,
        seed=0,
        **search,
    )
    return [piece[0] for piece in found]


def _convex(hull: ConvexHull, triangles: np.ndarray, volume: float) -> bool:
    """True if the hull of a closed mesh (F, 3, 3) of this volume may stand for it."""
    return volume > (1 - GROWTH) * hull.volume and deepest(hull, triangles) < DEPTH


class _Part(NamedTuple):
    """A piece."""

    vertices: np.ndarray
    """(V, 3) before it was thinned, m."""
    hull: ConvexHull
    hollow: float
    """Volume of its hull before it was thinned, without that of the mesh in it, m^3."""
    error: float
    """Largest of the way that thinning moves a side, the depth of the surface in it, and its
    distance from it, m.
    """


class _Join(NamedTuple):
    """Cost of joining two pieces."""

    cost: float
    first: int
    second: int
    growth: float
    part: _Part


class _Merger:
    """Pieces by number, the neighbours of each, and the possible joins."""

    def __init__(self, pieces: list[np.ndarray], triangles: np.ndarray, volume: float | None):
        """Takes the arguments of `merge`."""
        random = np.random.default_rng(0)
        self._surface = _sorted(shapes.on_triangles(triangles, random.random((_SAMPLES, 3)))[0])
        self._probes = random.random((_PROBES, 3))
        self._directions = random.normal(size=(3, _DIRECTIONS))
        hulls = [hull for hull in map(solid_hull, pieces) if hull is not None]
        self._volume = sum(hull.volume for hull in hulls) if volume is None else volume
        self._inner = None if volume is None else _sorted(interior(triangles, _INNER))
        if volume is None:
            triangles = np.concatenate(
                [shapes.triangulate(hull.points).triangles for hull in hulls]
            )
        self._voxels = voxels(triangles, MOST_SURFACE)
        self._distance = distance_transform_edt(~self._voxels.inside, self._voxels.spacing)
        self.parts = {i: self._part(hull) for i, hull in enumerate(hulls)}
        self._count = len(self.parts)
        self._neighbors: dict[int, set[int]] = {i: set() for i in self.parts}
        self._joins: list[_Join] = []
        for i in self.parts:
            for j in range(i):
                if _touch(self.parts[i].hull, self.parts[j].hull):
                    self._neighbors[i].add(j)
                    self._neighbors[j].add(i)
                    self._consider(i, j)

    def _part(self, hull: ConvexHull) -> _Part:
        """A piece of this hull, thinner along its shortest axis where the mesh does not fill it."""
        vertices, thin, shift = hull.points[hull.vertices], hull, 0.0
        hollow = 1.0 if self._inner is None else self._hollow(hull, self._inner)
        axis = np.linalg.svd(vertices - vertices.mean(0), full_matrices=False)[2][-1]
        along = vertices @ axis
        if self._inner is not None and hollow > _FULL and np.ptp(along) < _WALL:
            inwards = min(hollow, _MOST) * ((along.max() + along.min()) / 2 - along)
            shift = min(MOST_SURFACE, largest := np.abs(inwards).max())
            thin = shapes.hull_of(vertices + np.outer(inwards * shift / largest, axis))
        depth = -_beyond(thin, _near(thin, self._surface)).min(initial=0.0)
        outside, _, _ = shapes.on_triangles(thin.points[thin.simplices], self._probes)
        error = max(shift, depth, self._distance[self._voxels.at(outside)].max())
        return _Part(vertices, thin, hollow * hull.volume, float(error))

    def _hollow(self, hull: ConvexHull, inner: np.ndarray) -> float:
        """Share of a hull that the mesh does not fill, by its inner points."""
        near = _near(hull, inner)
        if hull.volume * len(inner) < _FEW * self._volume or not len(near):
            return 0.0
        share = (_beyond(hull, near[:: 1 + len(near) // _ENOUGH]) < 0).mean()
        return float(1 - share * len(near) / len(inner) * self._volume / hull.volume)

    def reduce(self, max_pieces: int) -> None:
        """Makes joins, cheapest first, until none is left; below the limit of pieces only those
        within tolerances.
        """
        grown = 0.0
        while self._joins:
            join = heapq.heappop(self._joins)
            if join.first not in self.parts or join.second not in self.parts:
                continue
            enough = len(self.parts) <= max_pieces
            if enough and (join.part.error > DEPTH or grown + join.growth > GROWTH * self._volume):
                continue
            grown += join.growth
            self._make(join)

    def _consider(self, i: int, j: int) -> None:
        """Enters the join of two pieces."""
        a, b = self.parts[i], self.parts[j]
        vertices = np.concatenate([a.vertices, b.vertices])
        if len(vertices) > _DIRECTIONS:
            vertices = vertices[np.unique((vertices @ self._directions).argmax(0))]
        part = self._part(shapes.hull_of(vertices))
        growth = max(0.0, part.hull.volume - a.hull.volume - b.hull.volume)
        filled = max(0.0, part.hollow - a.hollow - b.hollow)
        cost = part.error / MOST_SURFACE + filled / (MOST_VOLUME * self._volume)
        heapq.heappush(self._joins, _Join(cost, i, j, growth, part))

    def _make(self, join: _Join) -> None:
        """Replaces two pieces by their join."""
        i, j, new = join.first, join.second, self._count
        self._count += 1
        del self.parts[i], self.parts[j]
        self.parts[new] = join.part
        self._neighbors[new] = (self._neighbors.pop(i) | self._neighbors.pop(j)) - {i, j}
        for k in self._neighbors[new]:
            self._neighbors[k] = self._neighbors[k] - {i, j} | {new}
            self._consider(new, k)


def merge(
    pieces: list[np.ndarray], max_pieces: int, triangles: np.ndarray, volume: float | None
) -> list[np.ndarray]:
    """Joins neighbouring convex pieces until `max_pieces` are left, and then while the shape is
    preserved.

    The cost of a join is the volume that it adds and its deviation from the surface, each as a
    share of the tolerance (`fidelity.MOST_VOLUME`, `MOST_SURFACE`). The deviation is the depth of
    the deepest surface point in the piece, the way that thinning moves its sides, or the distance
    of its farthest point from the mesh, by samples. Pieces that do not touch are never joined, so
    that more than `max_pieces` remain if there are more separate bodies.

    Args:
      pieces: vertices (V, 3) of each, m.
      max_pieces: largest number of pieces.
      triangles: (F, 3, 3) corners of the surface that they approximate, m.
      volume: volume of the object, m^3; None for an open surface, whose pieces stay as thick as
        they are.
    """
    merger = _Merger(pieces, triangles, volume)
    merger.reduce(max_pieces)
    return [part.hull.points[part.hull.vertices] for part in merger.parts.values()]


def deepest(hull: ConvexHull, triangles: np.ndarray) -> float:
    """Depth in a hull of the deepest of some points on triangles (F, 3, 3), m."""
    points = shapes.on_triangles(triangles, np.random.default_rng(0).random((_SAMPLES, 3)))[0]
    return float(-_beyond(hull, points).min())


def solid_hull(vertices: np.ndarray) -> ConvexHull | None:
    """The convex hull of a piece (V, 3); None if its volume is negligible."""
    try:
        hull = shapes.hull_of(vertices)
    except QhullError:
        return None
    return hull if hull.volume > _LEAST else None


def simplify(vertices: np.ndarray, max_vertices: int = MAX_MESH_VERTICES) -> np.ndarray:
    """A convex piece of at most `max_vertices` vertices (V, 3), with the same volume.

    Starting from the extreme points along the axes, the point that sticks out furthest is added
    again and again; the result is then scaled about its centroid to the volume of the original.

    Raises:
      scipy.spatial.QhullError: the points lie in a plane.
    """
    hull = shapes.hull_of(vertices)
    points = hull.points[hull.vertices]
    if len(points) <= max_vertices:
        return points
    axes = np.linalg.svd(points - points.mean(0), full_matrices=False)[2]
    along = points @ axes.T
    chosen = list(dict.fromkeys([*along.argmax(0).tolist(), *along.argmin(0).tolist()]))
    while len(chosen) < max_vertices:
        equations = (
            shapes.hull_of(points[chosen]).equations if len(chosen) > 3 else np.zeros((1, 4))
        )
        outside = (points @ equations[:, :3].T + equations[:, 3]).max(-1)
        outside[chosen] = -np.inf
        chosen.append(int(outside.argmax()))
    kept = points[chosen]
    share = shapes.hull_of(kept).volume / hull.volume
    center = kept.mean(0)
    return center + (kept - center) * share ** (-1 / 3)


def _touch(a: ConvexHull, b: ConvexHull) -> bool:
    """True if the boxes around two hulls touch."""
    return bool(
        (a.min_bound < b.max_bound + _NEAR).all() and (b.min_bound < a.max_bound + _NEAR).all()
    )


def _sorted(points: np.ndarray) -> np.ndarray:
    """Points (N, 3) in the order of their first coordinate."""
    return points[np.argsort(points[:, 0])]


def _near(hull: ConvexHull, points: np.ndarray) -> np.ndarray:
    """Those of sorted points (N, 3) that are in the box around a hull."""
    start, end = np.searchsorted(points[:, 0], [hull.min_bound[0], hull.max_bound[0]])
    some = points[start:end]
    return some[((some > hull.min_bound) & (some < hull.max_bound)).all(-1)]


def _beyond(hull: ConvexHull, points: np.ndarray) -> np.ndarray:
    """(N,) how far points (N, 3) are beyond the facet that they are farthest beyond, m; negative
    inside.
    """
    return (points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(-1)
