"""Collision shape of an object: the convex pieces of its folder, or those cut from its meshes.

Pieces of the folder are used if they are close enough to the surface, or closer than the cut ones.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, QhullError

from congrasp.common.objects import shapes
from congrasp.common.runtime.progress import Progress, ignore_progress
from congrasp.services.assets.objects import repair
from congrasp.services.assets.objects.decompose import CUT_DEPTH_M, Decomposition, decompose
from congrasp.services.assets.objects.fidelity import Fidelity, fidelity
from congrasp.services.assets.objects.hulls import corners_of, simplify
from congrasp.services.assets.objects.merging import merge
from congrasp.services.assets.objects.options import ImportOptions


class Surfaces(NamedTuple):
    """The surfaces of an object."""

    meshes: Sequence[trimesh.Trimesh]
    """One mesh of the whole object, or one of each part, m."""
    shown: Sequence[trimesh.Trimesh]
    """The same without hollows that no finger enters."""
    triangles: np.ndarray
    """(F, 3, 3) triangles of `shown`, m."""
    volume: float | None
    """Volume that the meshes enclose (`interior.enclosed`), m^3; None if one is open."""
    open_volume: float | None = None
    """Volume that open meshes enclose by winding numbers (`winding.open_volume`), m^3; None without
    any."""


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
        pieces = "piece stands" if count == 1 else "pieces stand"
        return f"{count} convex {pieces} for it: {self.errors}"


def convex_pieces(
    own_pieces: Sequence[np.ndarray],
    surfaces: Surfaces,
    options: ImportOptions,
    notes: list[str],
    *,
    has_surface: bool = True,
    progress: Progress = ignore_progress,
) -> Collision:
    """Returns the pieces of the object's folder if they are close enough, else the closer ones.

    Args:
      own_pieces: vertices (V, 3) of the convex pieces in the object's folder, m.
      surfaces: the object's surfaces.
      options: options of the import.
      notes: the selected pieces and their errors are appended.
      has_surface: False if the surfaces are those of the pieces.
      progress: called with the counts of a cut.

    Raises:
      scipy.spatial.QhullError: the object has no volume.
    """
    if not own_pieces:
        cut = _cut_or_fill(surfaces, options, notes, progress)
        notes.append(str(cut))
        return cut
    hulls = merge(list(own_pieces), options.max_pieces, surfaces.triangles, surfaces.volume)
    if len(hulls) < len(own_pieces):
        notes.append(
            f"its {len(own_pieces)} convex pieces were merged into {len(hulls)} (--max-pieces)"
        )
    merged = _collision_of(surfaces, hulls, [0] * len(hulls))
    if merged.errors.tolerance_ratio <= 1 or not has_surface:
        notes.append(f"its own {merged}")
        return merged
    cut_notes: list[str] = []
    try:
        cut = _cut_or_fill(surfaces, options, cut_notes, progress)
    except QhullError:
        cut = merged  # the surface lies in a plane
    if cut.errors.tolerance_ratio < merged.errors.tolerance_ratio:
        notes.extend(cut_notes)
        notes.append(
            f"{cut}; they were cut from its mesh, for its own {len(merged.hulls)} are coarser: "
            f"{merged.errors}"
        )
        return cut
    notes.append(f"its own {merged}; pieces cut from its mesh are no closer")
    return merged


def _cut_or_fill(
    surfaces: Surfaces, options: ImportOptions, notes: list[str], progress: Progress
) -> Collision:
    """A decomposition of each mesh, or the hulls of the meshes if those are closer.

    Each mesh may have pieces according to its share of the volume. Pieces that are too coarse are
    cut once more, half as coarse, if more of them are allowed.
    """
    mesh_hulls = [shapes.hull_of(mesh.vertices) for mesh in surfaces.meshes]
    volumes = np.array([hull.volume for hull in mesh_hulls])
    limits = [max(1, int(limit)) for limit in options.max_pieces * volumes / volumes.sum()]
    cut_notes: list[str] = []
    cut = _cut_to_depth(surfaces, limits, CUT_DEPTH_M, cut_notes, progress)
    count = len(cut.hulls)
    is_convex = count == len(mesh_hulls)
    if cut.errors.tolerance_ratio > 1 and not is_convex and count < options.max_pieces:
        finer_notes: list[str] = []
        finer = _cut_to_depth(surfaces, limits, CUT_DEPTH_M / 2, finer_notes, progress)
        if finer.errors.tolerance_ratio < cut.errors.tolerance_ratio:
            cut = finer
            cut_notes = finer_notes
    notes += cut_notes
    if cut.errors.tolerance_ratio <= 1 or is_convex:
        return cut
    filled = _hulls_of_meshes(surfaces, mesh_hulls)
    if filled.errors.tolerance_ratio < cut.errors.tolerance_ratio:
        notes.append(
            f"its convex hull is closer to its shape than {len(cut.hulls)} pieces ({cut.errors}): "
            f"hollows are filled"
        )
        return filled
    return cut


def _cut_to_depth(
    surfaces: Surfaces,
    limits: Sequence[int],
    depth: float,
    notes: list[str],
    progress: Progress,
) -> Collision:
    """The pieces of each mesh.

    Args:
      surfaces: the object's surfaces.
      limits: largest number of pieces of each mesh.
      depth: depth of a hollow in a piece from which it is cut, m.
      notes: what a decomposer reports is appended.
      progress: see `convex_pieces`.
    """
    hulls: list[np.ndarray] = []
    owners: list[int] = []
    for owner, limit in enumerate(limits):
        decomposition = _cut_mesh(surfaces, owner, limit, depth, progress)
        notes += decomposition.notes
        hulls += decomposition.pieces
        owners += [owner] * len(decomposition.pieces)
    return _collision_of(surfaces, hulls, owners)


def _cut_mesh(
    surfaces: Surfaces, owner: int, max_pieces: int, depth: float, progress: Progress
) -> Decomposition:
    """The pieces of one of the meshes."""
    mesh = surfaces.shown[owner]
    small = repair.with_few_faces(mesh)
    volume = None
    if surfaces.volume is not None and (small is mesh or repair.encloses(small)):
        is_only_mesh = len(surfaces.meshes) == 1
        volume = surfaces.volume if is_only_mesh else float(mesh.volume)
    return decompose(
        np.asarray(small.vertices),
        np.asarray(small.faces),
        is_filled=mesh is not surfaces.meshes[owner],
        volume=volume,
        max_pieces=max_pieces,
        depth=depth,
        progress=progress,
    )


def _hulls_of_meshes(surfaces: Surfaces, mesh_hulls: Sequence[ConvexHull]) -> Collision:
    """The hull of each mesh."""
    corners = [corners_of(hull) for hull in mesh_hulls]
    return _collision_of(surfaces, corners, list(range(len(corners))))


def _collision_of(surfaces: Surfaces, pieces: list[np.ndarray], owners: list[int]) -> Collision:
    """Pieces (V, 3) of few vertices, and their errors."""
    hulls = [simplify(piece) for piece in pieces]
    is_closed = surfaces.volume is not None
    errors = fidelity(surfaces.triangles, hulls, is_closed, surfaces.open_volume)
    return Collision(hulls, owners, errors)
