"""Assembly of an object: from the meshes of a source to a `GraspObject`."""

import dataclasses
import functools
import pathlib
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import trimesh
from scipy.spatial import QhullError, cKDTree

from congrasp.common.errors import CongraspError
from congrasp.common.objects import shapes
from congrasp.common.objects.resting import rest_poses
from congrasp.common.objects.shapes import halves, sample_mesh
from congrasp.common.objects.spec import Colours, GraspObject, Piece
from congrasp.common.runtime.progress import Progress, ignore_progress
from congrasp.services.assets.objects import repair
from congrasp.services.assets.objects.affordance import cut_to_hold, with_labels
from congrasp.services.assets.objects.bodies import largest_body, without_table
from congrasp.services.assets.objects.collision import Collision, Surfaces, convex_pieces
from congrasp.services.assets.objects.colours import sample_colours
from congrasp.services.assets.objects.hollows import without_hollows
from congrasp.services.assets.objects.interior import Enclosed, enclosed
from congrasp.services.assets.objects.masses import Weight, weigh_evenly, weigh_parts
from congrasp.services.assets.objects.mesh_files import read_mesh, up_of
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.assets.objects.repair import encloses
from congrasp.services.assets.objects.sources import Source
from congrasp.services.assets.objects.units import METRES, metres_per_unit
from congrasp.services.assets.objects.winding import open_volume

UNLABELLED = ("near half", "far half")
"""Parts of an object without part files."""
_MAX_OFFSET = 100
"""Distance of an object's middle from the origin, in its sizes, up to which products of its
coordinates are exact enough.
"""
_GRASPABLE_SHARES = (0.1, 0.9)
"""Shares of the surface that a graspable region has without a note."""
_PART_SAMPLES = 4000
"""Points of a part's surface, which label the object's points."""


class _Files(NamedTuple):
    """The meshes of a source, in the files' unit, z up."""

    pieces: list[np.ndarray]
    """Vertices (V, 3) of the convex pieces in its folder."""
    visuals: list[trimesh.Trimesh]
    """Repaired surfaces of the object."""
    parts: list[trimesh.Trimesh]
    """Surfaces of the object's parts; empty if `visuals` are the parts."""
    up: Literal["y", "z"]
    """The files' axis that was up."""
    coloured: list[pathlib.Path]
    """Files of the surfaces that may have colours."""


class _Scale(NamedTuple):
    """Conversion from the files' unit to metres, relative to a point near the object."""

    factor: float
    """Metres per unit."""
    middle: np.ndarray
    """(3,) the point, m: zeros unless the object is far from its origin."""

    def points(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) in metres."""
        return self.factor * points - self.middle

    def mesh(self, mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        """A mesh in metres that faces outwards."""
        mesh = mesh.copy()
        mesh.apply_scale(self.factor)
        mesh.apply_translation(-self.middle)
        if mesh.volume < 0:
            mesh.invert()
        return mesh


class _Shape(NamedTuple):
    """The surfaces of an object, m, in the frame of `_Scale`."""

    meshes: list[trimesh.Trimesh]
    """Surfaces that face outwards."""
    parts: list[trimesh.Trimesh]
    """Surfaces of the object's parts; empty if `meshes` are the parts."""
    surface: trimesh.Trimesh
    """All `meshes` as one."""
    solid: Enclosed | None
    """Measures of the space inside; None for an open surface."""

    @property
    def is_closed(self) -> bool:
        """True if each of the meshes encloses a volume."""
        return self.solid is not None


class _Labels(NamedTuple):
    """Parts of an object."""

    names: tuple[str, ...]
    graspable: np.ndarray
    """(P,) bool, True for parts of the graspable region."""
    of_points: np.ndarray
    """(N,) part of each surface point."""


def assemble(
    source: Source, options: ImportOptions, seed: int, progress: Progress = ignore_progress
) -> GraspObject:
    """Builds the object of a source.

    Args:
      source: the files.
      options: options of the import.
      seed: seed of its surface points.
      progress: called with the activities of the import.

    Raises:
      CongraspError: a mesh cannot be used.
    """
    notes: list[str] = []
    files = _read(source, options, notes)
    scale = _scale(source, files, options, notes)
    shape = _shape(files, scale)
    _note_volume(source, shape, options, notes)
    surfaces = _surfaces(shape.meshes, shape.solid, notes)
    # Weighed before the cut into pieces, which takes long: the material may be unknown.
    weight_by_material = _weigh_by_material(source, shape, options)
    file_pieces = [scale.points(piece) for piece in files.pieces]
    collision = _collision(source, file_pieces, surfaces, options, notes, progress)
    progress("Weighing", 0, 0)
    weight = weight_by_material
    if weight is None:
        weight = _weigh_evenly(source, shape, collision, options)
    weight = _with_mass(weight, options.mass)
    pieces = _pieces(collision, weight.center)
    surface = shape.surface.copy()
    surface.apply_translation(-weight.center)
    points, normals, faces = sample_mesh(
        np.asarray(surface.triangles), pieces, np.random.default_rng(seed), oriented=shape.is_closed
    )
    labels = _labels(source, shape, weight.center, points, faces)
    if not source.parts_are_pieces:
        pieces = with_labels(pieces, points, labels.of_points)
    _note_graspable_share(labels, notes)
    picture = repair.with_few_faces(surface)
    origin = weight.center + scale.middle
    colours = _colours(files, scale.factor, origin, seed, options, notes)
    obj = GraspObject(
        name=source.name,
        family="imported",
        pieces=pieces,
        part_names=labels.names,
        graspable=labels.graspable,
        mass=weight.mass,
        inertia=weight.inertia,
        points=points.astype(np.float32),
        normals=normals.astype(np.float32),
        labels=labels.of_points.astype(np.int32),
        rest_poses=np.zeros((0, 7)),
        visual_vertices=np.asarray(picture.vertices, np.float32),
        visual_faces=np.asarray(picture.faces, np.int32),
        origin=tuple((-weight.center - scale.middle).tolist()),
        file_scale=scale.factor,
        file_up=files.up,
        notes=tuple(dict.fromkeys(notes)),
        surface_error=collision.errors.surface,
        volume_error=collision.errors.volume,
        colours=colours,
    )
    on_candidate = functools.partial(progress, "Finding resting poses")
    obj = dataclasses.replace(obj, rest_poses=rest_poses(obj, on_candidate))
    return obj if source.parts else cut_to_hold(obj)


def _shape(files: _Files, scale: _Scale) -> _Shape:
    """The surfaces of the files in metres."""
    meshes = [scale.mesh(mesh) for mesh in files.visuals]
    parts = [scale.mesh(mesh) for mesh in files.parts]
    surface = trimesh.util.concatenate(meshes).copy()
    solid = None
    if all(encloses(mesh) for mesh in meshes):
        solid = enclosed(np.asarray(surface.triangles))
    return _Shape(meshes, parts, surface, solid)


def _note_volume(source: Source, shape: _Shape, options: ImportOptions, notes: list[str]) -> None:
    """Appends a note if the surface encloses no volume, or some of it twice."""
    if shape.solid and shape.solid.overlaps:
        notes.append("its bodies overlap: overlapping volume is weighed once")
    if shape.is_closed or options.material:
        return
    replacement = "pieces" if source.pieces else "hull"
    notes.append(
        f"its surface is open: mass and inertia are those of its convex {replacement} "
        "(--material weighs its wall, and --mass sets the mass)"
    )


def _weigh_by_material(source: Source, shape: _Shape, options: ImportOptions) -> Weight | None:
    """Mass properties by the material of the options; None if they have none.

    Raises:
      CongraspError: the material is unknown.
    """
    if not options.material:
        return None
    names = [part.part for part in source.parts]
    return weigh_parts(shape.meshes, shape.parts or shape.meshes, options.material, names)


def _weigh_evenly(
    source: Source, shape: _Shape, collision: Collision, options: ImportOptions
) -> Weight:
    """Mass properties of an evenly dense object."""
    hulls = [np.asarray(shape.surface.vertices)]
    if source.pieces:
        hulls = collision.hulls
    return weigh_evenly(shape.surface, shape.solid, hulls, options.density)


def _with_mass(weight: Weight, mass: float | None) -> Weight:
    """Mass properties for a mass, kg; unchanged if it is None."""
    if mass is None:
        return weight
    return Weight(mass, weight.center, weight.inertia * (mass / weight.mass))


def _read(source: Source, options: ImportOptions, notes: list[str]) -> _Files:
    """Reads and repairs the meshes of a source."""
    up = options.up
    piece_meshes = [read_mesh(file.path, up=up) for file in source.pieces]
    visual_meshes = [read_mesh(file.path, notes, up) for file in source.visuals]
    parts: list[trimesh.Trimesh] = []
    if not source.parts_are_pieces:
        parts = [read_mesh(file.path, up=up) for file in source.parts]
    axis = up_of((visual_meshes or piece_meshes)[0], up)
    if axis == "y":
        notes.append(
            "its y axis, which points up in the file, became its z axis (--up z leaves the axes)"
        )
    pieces = [np.asarray(mesh.vertices, np.float64) for mesh in piece_meshes]
    surfaces = visual_meshes or [shapes.triangulate(piece) for piece in pieces]
    if not source.parts:
        surfaces = _repair(surfaces, options, notes, is_scan=not source.pieces)
    coloured = _files_with_colours(source, visual_meshes)
    return _Files(pieces, surfaces, parts, axis, coloured)


def _repair(
    surfaces: list[trimesh.Trimesh], options: ImportOptions, notes: list[str], *, is_scan: bool
) -> list[trimesh.Trimesh]:
    """Closes surfaces and turns them outwards.

    Args:
      surfaces: surfaces of the object, in the files' unit.
      options: options of the import.
      notes: the repairs are appended.
      is_scan: True if the surfaces may include a table and other bodies, which are removed.
    """
    if is_scan:
        surfaces = [_object_of_scan(mesh, options, notes) for mesh in surfaces]
    return [repair.close_and_orient(mesh, notes) for mesh in surfaces]


def _files_with_colours(
    source: Source, visual_meshes: Sequence[trimesh.Trimesh]
) -> list[pathlib.Path]:
    """Files of surfaces whose format has colours: all but STL."""
    paths = []
    for file, mesh in zip(source.visuals, visual_meshes, strict=True):
        if mesh.metadata["kind"] != "stl":
            paths.append(file.path)
    return paths


def _object_of_scan(
    mesh: trimesh.Trimesh, options: ImportOptions, notes: list[str]
) -> trimesh.Trimesh:
    """The mesh of a scan without its table and other bodies."""
    if options.unit in METRES:
        metres = METRES[options.unit] * options.scale
        mesh = without_table(mesh, metres, notes)
    return largest_body(mesh, notes)


def _scale(source: Source, files: _Files, options: ImportOptions, notes: list[str]) -> _Scale:
    """The conversion of the files to metres.

    Raises:
      CongraspError: no hand can grasp an object of that size.
    """
    surface = trimesh.util.concatenate(files.visuals)
    sides = tuple(surface.extents.tolist())
    factor = metres_per_unit(source.path, sides, options.unit, options.scale, notes)
    low, high = surface.bounds
    middle = np.zeros(3)
    if np.abs(low + high).max() / 2 > _MAX_OFFSET * (high - low).max():
        middle = (low + high) / 2
    return _Scale(factor, factor * middle)


def _surfaces(meshes: list[trimesh.Trimesh], solid: Enclosed | None, notes: list[str]) -> Surfaces:
    """The surfaces of meshes, closed ones without hollows that no finger enters."""
    if solid is None:
        triangles = np.concatenate([np.asarray(mesh.triangles) for mesh in meshes])
        return Surfaces(meshes, meshes, triangles, None, open_volume(triangles))
    approximated = [without_hollows(mesh, notes) for mesh in meshes]
    triangles = np.concatenate([np.asarray(mesh.triangles) for mesh in approximated])
    if any(new is not old for new, old in zip(approximated, meshes, strict=True)):
        solid = enclosed(triangles)
    return Surfaces(meshes, approximated, triangles, solid.volume)


def _collision(
    source: Source,
    file_pieces: Sequence[np.ndarray],
    surfaces: Surfaces,
    options: ImportOptions,
    notes: list[str],
    progress: Progress,
) -> Collision:
    """Convex pieces of an object (`collision.convex_pieces`).

    Raises:
      CongraspError: it has no volume.
    """
    has_surface = bool(source.visuals)
    try:
        return convex_pieces(
            file_pieces, surfaces, options, notes, has_surface=has_surface, progress=progress
        )
    except QhullError:
        raise CongraspError(
            f"{source.path} has no volume: its points lie in a plane.",
            "Give it a thickness in a modelling program.",
        ) from None


def _pieces(collision: Collision, center: np.ndarray) -> tuple[Piece, ...]:
    """The convex pieces relative to the centre of mass (3,)."""
    return tuple(
        _piece(hull, center, owner)
        for hull, owner in zip(collision.hulls, collision.owners, strict=True)
    )


def _piece(hull: np.ndarray, center: np.ndarray, part: int) -> Piece:
    """A convex piece of vertices (V, 3), with its origin at their mean, relative to `center`."""
    middle = hull.mean(0)
    return Piece(
        "mesh",
        (0.0, 0.0, 0.0),
        tuple((middle - center).tolist()),
        vertices=hull - middle,
        part=part,
    )


def _labels(
    source: Source,
    shape: _Shape,
    center: np.ndarray,
    points: np.ndarray,
    faces: np.ndarray,
) -> _Labels:
    """Parts of an object: those of its part files, or two halves.

    Args:
      source: the files.
      shape: the surfaces of the object and of its parts.
      center: (3,) centre of mass, in the frame of `shape`.
      points: (N, 3) surface points, relative to the centre of mass.
      faces: (N,) triangle of each surface point, among those of all surfaces.
    """
    if not source.parts:
        return _labels_of_halves(points)
    if shape.parts:
        return _labels_of_parts(source, _nearest_part(shape.parts, center, points))
    return _labels_of_parts(source, _part_of_faces(shape.meshes, faces))


def _labels_of_halves(points: np.ndarray) -> _Labels:
    """Two halves of surface points (N, 3), the slimmer one graspable."""
    of_points = halves(points, 0.5)
    widths = []
    for half in (0, 1):
        half_points = points[of_points == half]
        centered = half_points - half_points.mean(0)
        singular_values = np.linalg.svd(centered, compute_uv=False)
        widths.append(singular_values[2] / np.sqrt(len(half_points)))
    graspable = np.arange(2) == int(np.argmin(widths))
    return _Labels(UNLABELLED, graspable, of_points)


def _nearest_part(
    parts: Sequence[trimesh.Trimesh], center: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """(N,) the part nearest to each surface point (N, 3), which are relative to `center`."""
    distances = []
    for part in parts:
        samples = trimesh.sample.sample_surface(part, _PART_SAMPLES, seed=0)[0]
        distances.append(cKDTree(samples - center).query(points)[0])
    return np.argmin(distances, axis=0)


def _part_of_faces(meshes: Sequence[trimesh.Trimesh], faces: np.ndarray) -> np.ndarray:
    """(N,) the mesh of faces (N,) of all meshes together."""
    ends = np.cumsum([len(mesh.faces) for mesh in meshes])
    return np.searchsorted(ends, faces, side="right")


def _labels_of_parts(source: Source, of_points: np.ndarray) -> _Labels:
    """Parts by their files; the largest is graspable if otherwise all or none are."""
    graspable = np.array([bool(part.graspable) for part in source.parts])
    if graspable.all() or not graspable.any():
        counts = np.bincount(of_points, minlength=len(source.parts))
        graspable = np.arange(len(source.parts)) == counts.argmax()
    names = tuple(part.part for part in source.parts)
    return _Labels(names, graspable, of_points)


def _note_graspable_share(labels: _Labels, notes: list[str]) -> None:
    """Appends a note if the graspable region is a small or a large share of the surface."""
    low, high = _GRASPABLE_SHARES
    share = labels.graspable[labels.of_points].mean()
    if not low <= share <= high:
        notes.append(f"its graspable region is {share:.0%} of the surface (10 to 90 % work best)")


def _colours(
    files: _Files,
    factor: float,
    origin: np.ndarray,
    seed: int,
    options: ImportOptions,
    notes: list[str],
) -> Colours | None:
    """Colours of the files, in the object frame; None without colours, or if they are unreadable.

    Args:
      files: the meshes of the source.
      factor: metres per unit.
      origin: (3,) origin of the object frame, m, in the axes of the files.
      seed: seed of the points.
      options: options of the import.
      notes: unreadable colours are appended.
    """
    try:
        colours = sample_colours(files.coloured, seed, options.up, notes)
    except CongraspError as error:
        notes.append(f"its colours are left out: {str(error).rstrip('.')}")
        return None
    if colours is None:
        return None
    return colours._replace(points=(factor * colours.points - origin).astype(np.float32))
