"""Decomposition of a mesh into convex pieces.

A convex mesh is its hull. Others are cut by CoACD, by V-HACD if that fails on the mesh, or else are
their hull.
The decomposers are native code, which runs in a confined process. Their pieces are joined
(`merging`).

The pieces depend on the mesh alone: the work is limited by the settings of the search, each process
has one thread, and a process that does not start, is short of time or memory, or is ended by others
is an error, not another shape.
"""

import functools
import pathlib
import tempfile
from typing import Any, NamedTuple

import numpy as np
import trimesh
from scipy.spatial import ConvexHull
from trimesh.geometry import faces_to_edges
from trimesh.graph import connected_component_labels, is_watertight

from congrasp.common.errors import CongraspError
from congrasp.common.objects import shapes
from congrasp.common.objects.spec import MAX_MESH_PIECES
from congrasp.common.runtime.confinement import Limits
from congrasp.common.runtime.progress import Progress, ignore_progress
from congrasp.services.assets.confined import EnvironmentFailure, OutOfResources, call_confined
from congrasp.services.assets.objects.bodies import bodies
from congrasp.services.assets.objects.cut_progress import log_to, read_count, write_joins
from congrasp.services.assets.objects.hulls import corners_of, deepest, solid_hull
from congrasp.services.assets.objects.interior import enclosed
from congrasp.services.assets.objects.manifold import manifold
from congrasp.services.assets.objects.merging import MAX_JOIN_DEPTH_M, MAX_JOIN_GROWTH, merge

CUT_DEPTH_M = 2 * MAX_JOIN_DEPTH_M
"""Depth of a hollow in a piece from which it is cut, m, at first."""
_WALL_COARSENESS = 1.5
"""Depth for an open surface relative to a closed one's: it becomes a thin wall, which a finer cut
would divide into hundreds of pieces.
"""
MAX_PROCESSOR_S = 300.0
"""Processor time of a decomposer, s, after which the import is an error; most take 1 to 15 s."""
MAX_WALL_CLOCK_RATIO = 20.0
"""Ratio of wall-clock to processor time above which the machine counts as too busy."""
MIN_CHILD_MEMORY_BYTES = 2 << 30
"""Bytes of memory for which a child is started."""
_ADDRESS_SPACE_BYTES = 6 << 30
"""Bytes of address space of a child: the same on every machine."""
_MIN_THRESHOLD = 0.01
"""The smallest threshold that CoACD takes, as a share of half the longest side."""
_SEARCH = {"mcts_iterations": 10, "mcts_nodes": 5, "mcts_max_depth": 1, "resolution": 1500}
"""Work of CoACD for each cut. Measured: fine cuts that are joined afterwards are as faithful as a
longer search, in a third of the time.
"""
_REPAIR_CELLS = 50
"""Cells along a closed surface that is repaired by CoACD."""
_WALL_CELLS = 40
"""Cells along an open surface from which CoACD makes a thin wall."""
_MAX_TUNNELS = 10
"""Most tunnels of a filled mesh that is cut without rebuilding its surface."""
_REBUILT_CELLS = 45
"""Cells along half of a surface that is rebuilt for its tunnels."""
_REBUILT_OFFSET = 0.55
"""Distance of a rebuilt surface from the mesh, in cells: CoACD's level set."""
_REBUILT_COARSENESS = 4 / 3
"""Depth for a rebuilt surface, relative to another one's."""
_REBUILT_SEARCH = _SEARCH | {"resolution": 4500}
"""Work of CoACD for each cut of a rebuilt surface. More samples lower the noise of distances, which
asks for further cuts.
"""
_MAX_VHACD_HULLS = 1 << 20
_PACKAGES = {"coacd": "coacd", "vhacd": "vhacdx"}
"""Package of each decomposer."""
_MESH = "mesh.npz"
_PIECES = "pieces.npz"


class _Cut(NamedTuple):
    """Options of a cut."""

    method: str
    """"coacd" or "vhacd"."""
    volume: float | None
    """See `decompose`."""
    max_pieces: int
    is_filled: bool
    """See `decompose`."""
    depth: float
    """See `decompose`."""


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
    max_pieces: int = MAX_MESH_PIECES,
    is_filled: bool = False,
    depth: float = CUT_DEPTH_M,
    progress: Progress = ignore_progress,
) -> Decomposition:
    """Decomposes a triangle mesh into as few convex pieces as preserve its shape.

    Args:
      vertices: (V, 3), m, not all in a plane.
      faces: (F, 3).
      volume: volume that the mesh encloses if it is closed (`interior.enclosed`), m^3; one close to
        that of the hull needs no decomposition.
      max_pieces: most pieces.
      is_filled: True if hollows of the mesh were filled (`hollows.without_hollows`). It has no
        walls then, and remains of walls leave folds and tunnels in its surface.
      depth: depth of a hollow in a piece from which it is cut, m.
      progress: called with the pieces that are cut, and then with the joins that are made.

    Raises:
      CongraspError: a decomposer exceeds `MAX_PROCESSOR_S` or cannot run here, or the machine lacks
        time or memory for it.
    """
    hull = shapes.hull_of(vertices)
    if volume is not None and _is_convex(hull, vertices[faces], volume):
        return Decomposition([corners_of(hull)], "convex", [])
    mesh = {"vertices": vertices, "faces": faces}
    notes: list[str] = []
    for method in _PACKAGES:
        cut = _Cut(
            method=method,
            volume=volume,
            max_pieces=max_pieces,
            is_filled=is_filled,
            depth=depth,
        )
        try:
            pieces = _cut_in_child(mesh, cut, progress)
            return Decomposition(pieces, method, notes)
        except ChildProcessError as error:
            notes.append(f"{method} {error}")
    notes.append("the convex hull of the whole mesh stands in for it: hollows are filled")
    return Decomposition([corners_of(hull)], "hull", notes)


def _cut_in_child(mesh: dict[str, Any], cut: _Cut, progress: Progress) -> list[np.ndarray]:
    """Vertices (V, 3) of the pieces that a confined process cuts.

    Args:
      mesh: arrays `vertices` and `faces`; see `decompose`.
      cut: options of the cut.
      progress: see `decompose`.

    Raises:
      CongraspError: it exceeds `MAX_PROCESSOR_S` or cannot run here, or the machine lacks time or
        memory for it.
      ChildProcessError: it failed on this mesh, or found no piece; a predicate without a subject.
    """
    patience = MAX_WALL_CLOCK_RATIO * MAX_PROCESSOR_S + MAX_WALL_CLOCK_RATIO
    with tempfile.TemporaryDirectory(prefix="congrasp-") as name:
        folder = pathlib.Path(name)
        np.savez(folder / _MESH, **mesh)

        def report() -> None:
            """Reports the current count."""
            progress(*read_count(folder))

        report()
        try:
            call_confined(
                write_pieces,
                folder,
                cut._asdict(),
                Limits(
                    memory=_ADDRESS_SPACE_BYTES, processor_s=MAX_PROCESSOR_S, patience_s=patience
                ),
                packages=(_PACKAGES[cut.method],),
                on_wait=report,
            )
        except TimeoutError:
            raise CongraspError(
                f"The machine is too busy: {cut.method} got less than {MAX_PROCESSOR_S:g} s of "
                f"processor time in {patience:.0f} s.",
                "Stop other programs and try again.",
            ) from None
        except OutOfResources as error:
            raise CongraspError(
                f"The mesh cannot be cut into convex pieces: {cut.method} {error}.",
                "Simplify it to fewer triangles, or put convex pieces 'contact*' next to it.",
            ) from None
        except EnvironmentFailure as error:
            raise CongraspError(
                f"The mesh cannot be cut into convex pieces here: {cut.method} {error}.",
                "Remove that cause and import the object again.",
            ) from None
        report()
        with np.load(folder / _PIECES) as arrays:
            pieces = list(arrays.values())
    if not pieces:
        raise ChildProcessError("found no piece")
    return pieces


def write_pieces(folder: pathlib.Path, **options: Any) -> None:
    """Decomposes the mesh in a folder, in the confined process.

    Args:
      folder: has the mesh, and gets the pieces.
      options: the fields of `_Cut`.
    """
    cut = _Cut(**options)
    log_to(folder)
    with np.load(folder / _MESH) as arrays:
        vertices = arrays["vertices"]
        faces = arrays["faces"]
    if cut.method == "coacd":
        pieces = _by_coacd(vertices, faces, cut)
    else:
        pieces = _by_vhacd(vertices, faces, cut.max_pieces)
    hulls = [solid_hull(np.asarray(piece, np.float64)) for piece in pieces]
    solid = [hull.points for hull in hulls if hull is not None]
    on_join = functools.partial(write_joins, folder)
    joined = merge(
        solid,
        cut.max_pieces,
        vertices[faces],
        cut.volume,
        has_walls=not cut.is_filled,
        on_join=on_join,
    )
    np.savez(folder / _PIECES, *joined)


def _by_vhacd(vertices: np.ndarray, faces: np.ndarray, max_pieces: int) -> list[np.ndarray]:
    """Vertices of the pieces of a mesh, cut by V-HACD."""
    import vhacdx

    # The number of corners comes first, as in VTK
    rows = np.insert(faces, 0, 3, axis=1).astype(np.uint32)
    max_hulls = min(max_pieces, _MAX_VHACD_HULLS)
    return [piece[0] for piece in vhacdx.compute_vhacd(vertices, rows, maxConvexHulls=max_hulls)]


def _by_coacd(vertices: np.ndarray, faces: np.ndarray, cut: _Cut) -> list[np.ndarray]:
    """Vertices of the pieces of a mesh, cut by CoACD."""
    if not cut.volume:
        return _body_by_coacd(vertices, faces, _WALL_COARSENESS * cut.depth, closed=False)
    if cut.is_filled and _tunnels(vertices, faces) > _MAX_TUNNELS:
        return _rebuilt_by_coacd(vertices, faces, _REBUILT_COARSENESS * cut.depth)
    whole = manifold(vertices, faces)
    if whole is not None:
        vertices, faces = whole
    # Bodies that intersect would be cut forever.
    pieces: list[np.ndarray] = []
    for body_vertices, body_faces in bodies(vertices, faces):
        pieces += _body_by_coacd(body_vertices, body_faces, cut.depth, closed=True)
    return pieces


def _tunnels(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Number of tunnels through the bodies of a closed mesh, by its Euler characteristic."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    labels = connected_component_labels(mesh.edges, len(vertices))
    bodies_count = len(np.unique(labels[faces]))
    return bodies_count - mesh.euler_number / 2


def _rebuilt_by_coacd(vertices: np.ndarray, faces: np.ndarray, depth: float) -> list[np.ndarray]:
    """Vertices of the pieces of a closed mesh with many small folds and tunnels.

    CoACD rebuilds the surface on a grid, without the folds and tunnels that it would cut into
    crumbs. The rebuilt surface lies outside of the mesh, so that the mesh is made smaller before.
    """
    import coacd

    size = np.ptp(vertices, axis=0).max()
    cell = size / 2 / _REBUILT_CELLS
    normals = trimesh.Trimesh(vertices, faces, process=False).vertex_normals
    pieces = coacd.run_coacd(
        coacd.Mesh(vertices - _REBUILT_OFFSET * cell * normals, faces),
        threshold=min(1.0, max(_MIN_THRESHOLD, depth / size)),
        preprocess_mode="on",
        preprocess_resolution=_REBUILT_CELLS,
        merge=False,
        seed=0,
        **_REBUILT_SEARCH,
    )
    return [piece[0] for piece in pieces]


def _body_by_coacd(
    vertices: np.ndarray, faces: np.ndarray, depth: float, *, closed: bool
) -> list[np.ndarray]:
    """Vertices of the pieces of one body."""
    import coacd

    if closed:
        triangles = vertices[faces]
        hull = shapes.hull_of(vertices)
        if _is_convex(hull, triangles, enclosed(triangles).volume):
            return [corners_of(hull)]
    size = np.ptp(vertices, axis=0).max()
    is_manifold = closed and is_watertight(faces_to_edges(faces))[0]
    pieces = coacd.run_coacd(
        coacd.Mesh(vertices, faces),
        threshold=min(1.0, max(_MIN_THRESHOLD, depth / size)),
        preprocess_mode="off" if is_manifold else "auto",
        preprocess_resolution=_REPAIR_CELLS if closed else _WALL_CELLS,
        merge=False,
        seed=0,
        **_SEARCH,
    )
    return [piece[0] for piece in pieces]


def _is_convex(hull: ConvexHull, triangles: np.ndarray, volume: float) -> bool:
    """True if the hull of a closed mesh is an acceptable approximation.

    Args:
      hull: the hull.
      triangles: (F, 3, 3) of the mesh, m.
      volume: of the mesh, m^3.
    """
    return (
        volume > (1 - MAX_JOIN_GROWTH) * hull.volume and deepest(hull, triangles) < MAX_JOIN_DEPTH_M
    )
