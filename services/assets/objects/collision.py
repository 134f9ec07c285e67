"""Convex collision pieces of an object: those of its folder, or a decomposition of its mesh if those are coarse."""

import contextlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial import QhullError

from congrasp.common.errors import CongraspError
from congrasp.common.objects import shapes
from congrasp.services.assets.objects import decompose, repair
from congrasp.services.assets.objects.fidelity import Fidelity, fidelity
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.assets.objects.pieces import merge, simplify
from congrasp.services.assets.objects.sources import Source


class Collision(NamedTuple):
    """Convex pieces and their errors."""

    hulls: list[np.ndarray]
    """Vertices (V, 3) of each piece, m."""
    owners: list[int]
    """Part of each piece (0 where the parts are labels)."""
    errors: Fidelity
    """Errors relative to the object's mesh."""

    def __str__(self) -> str:
        """Number of pieces, and their errors."""
        count = len(self.hulls)
        return f"{count} convex piece{'s stand' if count > 1 else ' stands'} for it: {self.errors}"


def convex_pieces(
    source: Source,
    meshes: Sequence[trimesh.Trimesh],
    triangles: np.ndarray,
    volume: float | None,
    given: Sequence[np.ndarray],
    options: ImportOptions,
    notes: list[str],
) -> Collision:
    """Returns the given pieces if their errors are small enough; else a decomposition, or the given ones if closer.

    Args:
      source: the object's files.
      meshes: its surface, m: one of the whole, or one of each part.
      triangles: (F, 3, 3) of all of them.
      volume: volume that they enclose (`fidelity.enclosed`), m^3; None for an open surface.
      given: vertices (V, 3) of the convex pieces in its folder, m; the surface if that has no file.
      options: options of the import.
      notes: the selected pieces and their errors are appended.

    Raises:
      CongraspError: the object has no volume.
    """
    try:
        if not given:
            found = _cut(source, meshes, triangles, volume, options, notes)
            notes.append(str(found))
            return found
        own = _merged(given, triangles, volume, options, notes)
    except QhullError:
        raise CongraspError(
            f"{source.path} has no volume: its points lie in a plane.", "Give it a thickness in a modelling program."
        ) from None
    if own.errors.excess <= 1 or not source.visuals:
        notes.append(f"its own {own}")
        return own
    with contextlib.suppress(QhullError):
        said: list[str] = []
        cut = _cut(source, meshes, triangles, volume, options, said)
        if cut.errors.excess < own.errors.excess:
            notes.extend(said)
            notes.append(f"{cut}; they were cut from its mesh, for its own {len(own.hulls)} are coarser: {own.errors}")
            return cut
    notes.append(f"its own {own}; pieces cut from its mesh are no closer")
    return own


def _merged(
    given: Sequence[np.ndarray],
    triangles: np.ndarray,
    volume: float | None,
    options: ImportOptions,
    notes: list[str],
) -> Collision:
    """The given pieces (V, 3), fewer where there are too many; the volume is that of the mesh if it is closed."""
    found = merge(list(given), options.max_pieces, triangles, volume)
    if len(found) < len(given):
        notes.append(f"its {len(given)} convex pieces were merged into {len(found)} (--max-pieces)")
    return _fitted(triangles, found, [0] * len(found), closed=volume is not None)


def _cut(
    source: Source,
    meshes: Sequence[trimesh.Trimesh],
    triangles: np.ndarray,
    volume: float | None,
    options: ImportOptions,
    notes: list[str],
) -> Collision:
    """A decomposition of each mesh; each may have pieces according to its share of the volume."""
    volumes = np.array([shapes.hull_of(mesh.vertices).volume for mesh in meshes])
    limits = [max(1, int(limit)) for limit in options.max_pieces * volumes / volumes.sum()]
    hulls, owners = list[np.ndarray](), list[int]()
    for owner, (mesh, limit) in enumerate(zip(meshes, limits, strict=True)):
        small = repair.with_few_faces(mesh)
        closed = volume is not None and (small is mesh or repair.encloses(small))
        found = decompose.decompose(
            np.asarray(small.vertices),
            np.asarray(small.faces),
            volume=(volume if len(meshes) == 1 else float(mesh.volume)) if closed else None,
            time_limit=options.time_limit,
            max_pieces=limit,
        )
        hulls.extend(found.pieces)
        owners.extend([owner if source.parts_are_pieces else 0] * len(found.pieces))
        notes.extend(found.notes)
    cut = _fitted(triangles, hulls, owners, closed=volume is not None)
    if cut.errors.excess <= 1 or len(hulls) == len(meshes):
        return cut
    whole = [shapes.hull_of(mesh.vertices) for mesh in meshes]
    owners = list(range(len(meshes))) if source.parts_are_pieces else [0] * len(meshes)
    filled = _fitted(triangles, [hull.points[hull.vertices] for hull in whole], owners, volume is not None)
    if filled.errors.excess < cut.errors.excess:
        notes.append(
            f"its convex hull is closer to its shape than {len(hulls)} pieces ({cut.errors}): hollows are filled"
        )
        return filled
    return cut


def _fitted(triangles: np.ndarray, found: list[np.ndarray], owners: list[int], closed: bool) -> Collision:
    """Pieces (V, 3) of few vertices, and their errors."""
    hulls = [simplify(piece) for piece in found]
    return Collision(hulls, owners, fidelity(triangles, hulls, closed))
