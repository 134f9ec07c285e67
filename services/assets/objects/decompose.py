"""Convex pieces of an object: those of its folder, or a decomposition of its meshes if those are coarse.

A convex mesh is its hull. Others are cut by CoACD under limits, by V-HACD if that fails, or else are their hull.
The decomposers are native code, which runs in a confined process.
"""

import contextlib
import pathlib
import tempfile
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, QhullError
from trimesh.geometry import faces_to_edges
from trimesh.graph import is_watertight

from congrasp.common.errors import CongraspError
from congrasp.common.objects import shapes
from congrasp.common.objects.spec import MAX_MESH_PIECES
from congrasp.common.runtime.parallel import cores, memory
from congrasp.services.assets.confined import call_confined
from congrasp.services.assets.objects import repair
from congrasp.services.assets.objects.fidelity import Fidelity, enclosed, fidelity
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.assets.objects.pieces import DEPTH, GROWTH, deepest, merge, simplify, solid_hull

FALLBACK_LIMIT = 30.0
"""Limit of V-HACD's processor time, s."""
STARVED = 20.0
"""Ratio of wall-clock to processor time above which the machine counts as too busy."""
LEAST_MEMORY = 2 << 30
"""Bytes of memory for which a child is started."""
_MEMORY = 6 << 30  # bytes of address space of a child, where there is enough for one on every core
_FINEST = 0.01  # the smallest threshold that CoACD takes, of half the longest side
_MESH, _PIECES = "mesh.npz", "pieces.npz"


class Surfaces(NamedTuple):
    """The surfaces of an object."""

    meshes: Sequence[trimesh.Trimesh]
    """One of the whole, or one of each part, m."""
    triangles: np.ndarray
    """(F, 3, 3) of all of them."""
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
    given: Sequence[np.ndarray], surfaces: Surfaces, options: ImportOptions, notes: list[str], *, shown: bool = True
) -> Collision:
    """Returns the given pieces if their errors are small enough; else a decomposition, or the given ones if closer.

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
            notes.append(f"{cut}; they were cut from its mesh, for its own {len(own.hulls)} are coarser: {own.errors}")
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
    for owner, (mesh, limit) in enumerate(zip(meshes, limits, strict=True)):
        small = repair.with_few_faces(mesh)
        closed = volume is not None and (small is mesh or repair.encloses(small))
        found = decompose(
            np.asarray(small.vertices),
            np.asarray(small.faces),
            volume=(volume if len(meshes) == 1 else float(mesh.volume)) if closed else None,
            time_limit=options.time_limit,
            max_pieces=limit,
        )
        hulls.extend(found.pieces)
        owners.extend([owner] * len(found.pieces))
        notes.extend(found.notes)
    cut = _fitted(surfaces, hulls, owners)
    if cut.errors.excess <= 1 or len(hulls) == len(meshes):
        return cut
    filled = _fitted(surfaces, [hull.points[hull.vertices] for hull in whole], list(range(len(meshes))))
    if filled.errors.excess < cut.errors.excess:
        notes.append(
            f"its convex hull is closer to its shape than {len(hulls)} pieces ({cut.errors}): hollows are filled"
        )
        return filled
    return cut


def _fitted(surfaces: Surfaces, found: list[np.ndarray], owners: list[int]) -> Collision:
    """Pieces (V, 3) of few vertices, and their errors."""
    hulls = [simplify(piece) for piece in found]
    return Collision(hulls, owners, fidelity(surfaces.triangles, hulls, surfaces.volume is not None))


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
) -> Decomposition:
    """Decomposes a triangle mesh into as few convex pieces as preserve its shape, at most `max_pieces`.

    Args:
      vertices: (V, 3), m, not all in a plane.
      faces: (F, 3).
      volume: volume that a closed mesh encloses (`fidelity.enclosed`), m^3; one close to that of the hull needs no
        decomposition.
      time_limit: processor time for CoACD, s; V-HACD gets half a minute after it.
      max_pieces: most pieces.

    Raises:
      CongraspError: the machine is too busy for the child to reach its limit.
    """
    hull = shapes.hull_of(vertices)
    whole = [hull.points[hull.vertices]]
    if volume is not None and _convex(hull, vertices[faces], volume):
        return Decomposition(whole, "convex", [])
    notes: list[str] = []
    for method, limit in (("coacd", time_limit), ("vhacd", FALLBACK_LIMIT)):
        found, failure = _in_child(method, vertices, faces, volume, max_pieces, limit)
        if found:
            return Decomposition(found, method, notes)
        notes.append(f"{method} {failure}")
    notes.append("the convex hull of the whole mesh stands in for it: hollows are filled")
    return Decomposition(whole, "hull", notes)


def _in_child(
    method: str, vertices: np.ndarray, faces: np.ndarray, volume: float | None, max_pieces: int, limit: float
) -> tuple[list[np.ndarray], str]:
    """Returns the pieces, or none and the reason."""
    most = min(_MEMORY, max(LEAST_MEMORY, memory() // cores()))
    with tempfile.TemporaryDirectory(prefix="congrasp-") as name:
        folder, options = pathlib.Path(name), {"method": method, "volume": volume, "max_pieces": max_pieces}
        np.savez(folder / _MESH, vertices=vertices, faces=faces)
        patience = STARVED * limit + STARVED
        try:
            call_confined(write_pieces, folder, options, memory=most, seconds=limit, patience=patience)
        except TimeoutError:
            raise CongraspError(
                f"The machine is too busy: {method} got less than {limit:g} s of processor time in {patience:.0f} s.",
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
        vertices, faces = arrays["vertices"], arrays["faces"]
    if method == "coacd":
        # A closed mesh may be of several bodies that intersect, which CoACD cuts forever.
        parts = repair.bodies(vertices, faces) if volume else [(vertices, faces)]
        found = [piece for part in parts for piece in _by_coacd(*part, closed=bool(volume))]
    else:
        import vhacdx

        rows = np.insert(faces, 0, 3, axis=1).astype(np.uint32)  # the number of corners comes first, as in VTK
        found = [piece[0] for piece in vhacdx.compute_vhacd(vertices, rows, maxConvexHulls=max_pieces)]
    solid = [hull for hull in (solid_hull(np.asarray(piece, np.float64)) for piece in found) if hull is not None]
    np.savez(folder / _PIECES, *merge([hull.points for hull in solid], max_pieces, vertices[faces], volume))


def _by_coacd(vertices: np.ndarray, faces: np.ndarray, *, closed: bool) -> list[np.ndarray]:
    """Vertices of the pieces of one body."""
    import coacd

    if closed and _convex(hull := shapes.hull_of(vertices), vertices[faces], enclosed(vertices[faces]).volume):
        return [hull.points[hull.vertices]]
    found = coacd.run_coacd(
        coacd.Mesh(vertices, faces),
        threshold=min(1.0, max(_FINEST, 2 * DEPTH / np.ptp(vertices, axis=0).max())),
        preprocess_mode="off" if closed and is_watertight(faces_to_edges(faces))[0] else "auto",
        # Measured: fine cuts that are joined afterwards are as faithful as a longer search, in a tenth of the time.
        merge=False,
        mcts_iterations=20,
        mcts_nodes=10,
        mcts_max_depth=2,
        seed=0,
    )
    return [piece[0] for piece in found]


def _convex(hull: ConvexHull, triangles: np.ndarray, volume: float) -> bool:
    """True if the hull of a closed mesh (F, 3, 3) of this volume may stand for it."""
    return volume > (1 - GROWTH) * hull.volume and deepest(hull, triangles) < DEPTH
