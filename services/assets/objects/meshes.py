"""Import of meshes: from files to a `GraspObject`."""

import collections
import contextlib
import dataclasses
import hashlib
import pathlib
import queue
import threading
from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
import trimesh
from scipy.spatial import QhullError, cKDTree

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import cache_folder
from congrasp.common.io.inputs import read_file
from congrasp.common.objects import shapes, store
from congrasp.common.objects.resting import rest_poses
from congrasp.common.objects.shapes import halves, sample_mesh
from congrasp.common.objects.spec import Colours, GraspObject, Piece
from congrasp.common.runtime.parallel import cores, memory
from congrasp.services.assets.objects import decompose, repair
from congrasp.services.assets.objects.affordance import cut_to_hold, with_labels
from congrasp.services.assets.objects.fidelity import Enclosed, enclosed
from congrasp.services.assets.objects.materials import weigh_evenly, weigh_parts
from congrasp.services.assets.objects.mesh_files import (
    CHECK,
    MAX_BYTES,
    read_mesh,
    sample_colours,
    up_of,
)
from congrasp.services.assets.objects.options import (
    METRES,
    ImportOptions,
    Up,
    check_options,
    metres_per_unit,
)
from congrasp.services.assets.objects.repair import encloses

UNLABELLED = ("near half", "far half")
"""Parts of an object without part files."""
_CACHE_VERSION = 14
_FAR = 100  # sizes of an object that its middle may be from the origin
_DRAWS = 8  # changes the surface points of every object, and with them all measurements
_PATIENCE = 600.0  # s beyond the limits of an object's decompositions


@dataclasses.dataclass(frozen=True)
class MeshFile:
    """One mesh of an object."""

    path: pathlib.Path
    role: Literal["visual", "piece", "part"]
    part: str = ""
    """Name of the part that it shows."""
    graspable: bool = True
    """True if that part may be grasped."""


@dataclasses.dataclass(frozen=True)
class Source:
    """The files of one object."""

    name: str
    path: pathlib.Path
    visuals: tuple[MeshFile, ...]
    """The surface; the part files if they form the surface together."""
    pieces: tuple[MeshFile, ...] = ()
    """Convex pieces, if it is already decomposed."""
    parts: tuple[MeshFile, ...] = ()
    """Meshes of the parts of the surface."""

    @property
    def parts_are_pieces(self) -> bool:
        """True if the part files together are the object, so that no collision piece spans two of
        them.
        """
        return bool(self.parts) and self.visuals == self.parts

    def files(self) -> tuple[MeshFile, ...]:
        """All files, without repetition."""
        return tuple(dict.fromkeys(self.visuals + self.pieces + self.parts))


def import_source(source: Source, options: ImportOptions) -> GraspObject:
    """Imports one object, or reads it from the cache of finished imports; its `notes` are for the
    user.

    Its origin moves to the centre of mass; its orientation stays that of the file. Parts come from
    part files; an object without them is labelled by two halves, the slimmer one graspable if a
    hand can close on it (`cut_to_hold`).

    Raises:
      CongraspError: an option is invalid, or a mesh cannot be used; the message names it, its fault
        and the remedy.
    """
    check_options(options)
    key = _key(source, options)
    folder = pathlib.Path(options.cache_dir) if options.cache_dir else cache_folder("objects")
    cached = folder / f"{key}-{_CACHE_VERSION}-{options.up}{store.SUFFIX}"
    if cached.is_file():
        try:
            return store.load(cached)
        except CongraspError:
            pass  # it is damaged, and replaced below
    obj = _build(source, options, int(key, 16))
    with contextlib.suppress(CongraspError):  # of a full disk, or of a read-only folder
        store.save(obj, cached)
    return obj


def import_sources(
    sources: Sequence[Source], options: ImportOptions
) -> Iterator[tuple[int, GraspObject | CongraspError]]:
    """Imports objects in parallel, one for each core if memory suffices; yields each index, and the
    object or error.

    Each decomposition is a separate process with a deadline and a memory limit, for which daemon
    threads of this process wait.

    Raises:
      CongraspError: an option is invalid, or no import ends for much longer than the deadlines of
        the decompositions.
    """
    check_options(options)
    todo = collections.deque(range(len(sources)))
    done: queue.SimpleQueue[tuple[int, GraspObject | Exception]] = queue.SimpleQueue()

    def work() -> None:
        """Imports until no source is left."""
        with contextlib.suppress(IndexError):
            while True:
                i = todo.popleft()
                try:
                    done.put((i, import_source(sources[i], options)))
                except Exception as error:  # raised in the caller's thread
                    done.put((i, error))

    for _ in range(min(len(sources), cores(), max(1, memory() // decompose.LEAST_MEMORY))):
        threading.Thread(target=work, daemon=True).start()
    meshes = max((len(source.visuals) for source in sources), default=0)
    patience = meshes * (options.time_limit + decompose.FALLBACK_LIMIT) + _PATIENCE
    try:
        for _ in sources:
            i, result = done.get(timeout=patience)
            if isinstance(result, Exception) and not isinstance(result, CongraspError):
                raise result
            yield i, result
    except queue.Empty:
        raise CongraspError(
            f"No import has ended for {patience:.0f} s.", "Import fewer objects at once."
        ) from None
    finally:
        todo.clear()


def _key(source: Source, options: ImportOptions) -> str:
    """24 hex digits of the files and options of an import, which are also the seed of its surface
    points.
    """
    settings = dataclasses.replace(options, cache_dir="")
    content = hashlib.sha256(f"{_DRAWS} {source.name} {settings}".encode())
    for file in source.files():
        content.update(
            f" {file.path.name} {file.role} {file.part} ".encode(errors="surrogateescape")
        )
        content.update(hashlib.sha256(read_file(file.path, MAX_BYTES, CHECK)).digest())
    return content.hexdigest()[:24]


def _build(source: Source, options: ImportOptions, seed: int) -> GraspObject:
    """The object of a source; the seed draws its surface points."""
    notes: list[str] = []
    given, visuals, parts, up, coloured = _read(source, options, notes)
    sides = tuple(trimesh.util.concatenate(visuals).extents.tolist())
    factor = metres_per_unit(source.path, sides, options.unit, options.scale, notes)
    middle = factor * _far_middle(visuals)
    meshes, parts = ([_scaled(mesh, factor, middle) for mesh in some] for some in (visuals, parts))
    whole = trimesh.util.concatenate(meshes).copy()
    closed = all(encloses(mesh) for mesh in meshes)
    if not (closed or options.material):
        notes.append(
            f"its surface is open: mass and inertia are those of its convex "
            f"{'pieces' if source.pieces else 'hull'} "
            "(--material weighs its wall, and --mass sets the mass)"
        )
    solid = enclosed(np.asarray(whole.triangles)) if closed else None
    if solid and solid.overlaps:
        notes.append("its bodies overlap: what lies in several of them weighs once")
    surfaces = _surfaces(meshes, solid, notes)
    names = [part.part for part in source.parts]
    weighed = (
        weigh_parts(meshes, parts or meshes, options.material, names) if options.material else None
    )
    hulls, owners, errors = _cut(
        source, [factor * piece - middle for piece in given], surfaces, options, notes
    )
    hull = hulls if source.pieces else [np.asarray(whole.vertices)]
    found = weighed or weigh_evenly(whole, solid, hull, options.density)
    mass, center = found.mass if options.mass is None else options.mass, found.center
    pieces = tuple(_piece(hull, center, owner) for hull, owner in zip(hulls, owners, strict=True))
    whole.apply_translation(-center)
    points, normals, face = sample_mesh(
        np.asarray(whole.triangles), pieces, np.random.default_rng(seed), oriented=closed
    )
    part_names, graspable, labels = _labels(source, meshes, parts, center, points, face)
    share = graspable[labels].mean()
    if not 0.1 <= share <= 0.9:
        notes.append(f"its graspable region is {share:.0%} of the surface (10 to 90 % work best)")
    picture = repair.with_few_faces(whole)
    colours = _colours(coloured, factor, center + middle, seed, options.up, notes)
    obj = GraspObject(
        name=source.name,
        family="imported",
        pieces=pieces if source.parts_are_pieces else with_labels(pieces, points, labels),
        part_names=part_names,
        graspable=graspable,
        mass=mass,
        inertia=found.inertia * (mass / found.mass),
        points=points.astype(np.float32),
        normals=normals.astype(np.float32),
        labels=labels.astype(np.int32),
        rest_poses=np.zeros((0, 7)),
        visual_vertices=np.asarray(picture.vertices, np.float32),
        visual_faces=np.asarray(picture.faces, np.int32),
        origin=tuple((-center - middle).tolist()),
        file_scale=factor,
        file_up=up,
        notes=tuple(dict.fromkeys(notes)),
        surface_error=errors.surface,
        volume_error=errors.volume,
        colours=colours,
    )
    obj = dataclasses.replace(obj, rest_poses=rest_poses(obj))
    return obj if source.parts else cut_to_hold(obj)


class _Files(NamedTuple):
    """The meshes of a source, in the files' unit, z up."""

    given: list[np.ndarray]
    """Vertices (V, 3) of the convex pieces in its folder."""
    visuals: list[trimesh.Trimesh]
    """Its repaired surfaces."""
    parts: list[trimesh.Trimesh]
    """Those of its parts, unless they are the surfaces."""
    up: Literal["y", "z"]
    """The files' axis that was up."""
    coloured: list[pathlib.Path]
    """Files of the surfaces that may have colours."""


def _read(source: Source, options: ImportOptions, notes: list[str]) -> _Files:
    """Reads the meshes of a source."""
    up = options.up
    pieces = [read_mesh(file.path, up=up) for file in source.pieces]
    visuals = [read_mesh(file.path, notes, up) for file in source.visuals]
    parts = (
        [] if source.parts_are_pieces else [read_mesh(file.path, up=up) for file in source.parts]
    )
    found = up_of((visuals or pieces)[0], up)
    kinds = [mesh.metadata["kind"] for mesh in visuals]
    coloured = [
        file.path for file, kind in zip(source.visuals, kinds, strict=True) if kind != "stl"
    ]
    if found == "y":
        notes.append(
            "its y axis, which points up in the file, became its z axis (--up z leaves the axes)"
        )
    given = [np.asarray(mesh.vertices, np.float64) for mesh in pieces]
    visuals = visuals or [shapes.triangulate(piece) for piece in given]
    if not (given or source.parts):
        if options.unit in METRES:
            metres = METRES[options.unit] * options.scale
            visuals = [repair.without_table(mesh, metres, notes) for mesh in visuals]
        visuals = [repair.largest_body(mesh, notes) for mesh in visuals]
    if not source.parts:
        visuals = [repair.closed(mesh, notes) for mesh in visuals]
    return _Files(given, visuals, parts, found, coloured)


def _surfaces(
    meshes: list[trimesh.Trimesh], solid: Enclosed | None, notes: list[str]
) -> decompose.Surfaces:
    """The surfaces of meshes, closed ones without hollows that no finger enters."""
    shown = meshes if solid is None else [repair.without_hollows(mesh, notes) for mesh in meshes]
    triangles = np.concatenate([np.asarray(mesh.triangles) for mesh in shown])
    if solid is not None and any(
        some is not mesh for some, mesh in zip(shown, meshes, strict=True)
    ):
        solid = enclosed(triangles)
    return decompose.Surfaces(meshes, shown, triangles, solid and solid.volume)


def _cut(
    source: Source,
    given: Sequence[np.ndarray],
    surfaces: decompose.Surfaces,
    options: ImportOptions,
    notes: list[str],
) -> decompose.Collision:
    """Convex pieces of an object (`decompose.convex_pieces`)."""
    try:
        return decompose.convex_pieces(given, surfaces, options, notes, shown=bool(source.visuals))
    except QhullError:
        raise CongraspError(
            f"{source.path} has no volume: its points lie in a plane.",
            "Give it a thickness in a modelling program.",
        ) from None


def _colours(
    paths: Sequence[pathlib.Path],
    factor: float,
    center: np.ndarray,
    seed: int,
    up: Up,
    notes: list[str],
) -> Colours | None:
    """Colours of files, in the object frame; None if they have none, or cannot be read."""
    try:
        found = sample_colours(paths, seed, up, notes)
    except CongraspError as error:
        notes.append(f"its colours are left out: {str(error).rstrip('.')}")
        return None
    return found and found._replace(points=(factor * found.points - center).astype(np.float32))


def _scaled(mesh: trimesh.Trimesh, factor: float, middle: np.ndarray) -> trimesh.Trimesh:
    """A mesh in metres, relative to a point (3,), that faces outwards."""
    mesh = mesh.copy()
    mesh.apply_scale(factor)
    mesh.apply_translation(-middle)
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def _far_middle(meshes: list[trimesh.Trimesh]) -> np.ndarray:
    """Middle (3,) of meshes so far from the origin that products of their coordinates are inexact;
    else zeros.
    """
    low, high = trimesh.util.concatenate(meshes).bounds
    return (
        (low + high) / 2
        if np.abs(low + high).max() / 2 > _FAR * (high - low).max()
        else np.zeros(3)
    )


def _piece(hull: np.ndarray, center: np.ndarray, part: int) -> Piece:
    """A convex piece of vertices (V, 3), with its origin at their mean, relative to the centre of
    mass.
    """
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
    meshes: Sequence[trimesh.Trimesh],
    parts: Sequence[trimesh.Trimesh],
    center: np.ndarray,
    points: np.ndarray,
    face: np.ndarray,
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Names of the parts, which of them form the graspable region, and the part (N,) of each
    surface point.
    """
    if not source.parts:
        labels = halves(points, 0.5)
        middle = [points[labels == k] - points[labels == k].mean(0) for k in (0, 1)]
        slim = int(
            np.argmin(
                [np.linalg.svd(half, compute_uv=False)[2] / np.sqrt(len(half)) for half in middle]
            )
        )
        return UNLABELLED, np.arange(2) == slim, labels
    if parts:
        dense = [trimesh.sample.sample_surface(part, 4000, seed=0)[0] for part in parts]
        labels = np.argmin([cKDTree(some - center).query(points)[0] for some in dense], axis=0)
    else:
        labels = np.searchsorted(
            np.cumsum([len(mesh.faces) for mesh in meshes]), face, side="right"
        )
    graspable = np.array([bool(part.graspable) for part in source.parts])
    if graspable.all() or not graspable.any():
        graspable = (
            np.arange(len(source.parts))
            == np.bincount(labels, minlength=len(source.parts)).argmax()
        )
    return tuple(part.part for part in source.parts), graspable, labels
