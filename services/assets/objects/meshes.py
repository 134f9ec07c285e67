"""Import of meshes: from files to a `GraspObject`."""

import collections
import contextlib
import dataclasses
import hashlib
import pathlib
import queue
import threading
from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import cache_folder
from congrasp.common.objects import shapes, store
from congrasp.common.objects.resting import rest_poses
from congrasp.common.objects.spec import Colours, GraspObject, Piece
from congrasp.common.objects.surface import halves, mass_properties, sample_mesh
from congrasp.common.runtime.parallel import cores, memory
from congrasp.services.assets.objects import decompose, repair
from congrasp.services.assets.objects.affordance import cut_to_hold
from congrasp.services.assets.objects.collision import convex_pieces
from congrasp.services.assets.objects.colours import sample_colours
from congrasp.services.assets.objects.fidelity import Enclosed, enclosed
from congrasp.services.assets.objects.materials import Weight, guessed_mass, materials_of, weigh
from congrasp.services.assets.objects.mesh_files import read_mesh, up_of
from congrasp.services.assets.objects.options import ImportOptions, check_options
from congrasp.services.assets.objects.repair import encloses
from congrasp.services.assets.objects.sizes import Up, metres_per_unit
from congrasp.services.assets.objects.sources import Source

UNLABELLED = ("near half", "far half")
"""Parts of an object without part files."""
_CACHE_VERSION = 10
_DRAWS = 8  # changes the surface points of every object, and with them all measurements
_PATIENCE = 600.0  # s beyond the limits of an object's decompositions


def import_source(source: Source, options: ImportOptions) -> GraspObject:
    """Imports one object, or reads it from the cache of finished imports; its `notes` are for the user.

    Its origin moves to the centre of mass; its orientation stays that of the file. Parts come from part files; an
    object without them is labelled by two halves, the slimmer one graspable if a hand can close on it (`cut_to_hold`).

    Raises:
      CongraspError: an option is invalid, or a mesh cannot be used; the message names it, its fault and the remedy.
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
    """Imports objects in parallel, one for each core if memory suffices; yields each index, and the object or error.

    Each decomposition is a separate process with a deadline and a memory limit, for which daemon threads of this
    process wait.

    Raises:
      CongraspError: an option is invalid, or no import ends for much longer than the deadlines of the decompositions.
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
        raise CongraspError(f"No import has ended for {patience:.0f} s.", "Import fewer objects at once.") from None
    finally:
        todo.clear()


def _key(source: Source, options: ImportOptions) -> str:
    """24 hex digits of the files and options of an import, which are also the seed of its surface points."""
    settings = dataclasses.replace(options, cache_dir="")
    content = hashlib.sha256(f"{_DRAWS} {source.name} {settings}".encode())
    for file in source.files():
        content.update(f" {file.path.name} {file.role} {file.part} ".encode())
        content.update(hashlib.sha256(file.path.read_bytes()).digest())
    return content.hexdigest()[:24]


def _build(source: Source, options: ImportOptions, seed: int) -> GraspObject:
    """The object of a source; the seed draws its surface points."""
    notes: list[str] = []
    given, visuals, up = _read(source, options.up, notes)
    sides = tuple(_joined(visuals).extents.tolist())
    factor = metres_per_unit(source.path, sides, options.unit, options.scale, notes)
    meshes = [_scaled(mesh, factor) for mesh in visuals]
    whole = _joined(meshes)
    closed = all(encloses(mesh) for mesh in meshes)
    if not (closed or options.material):
        notes.append(
            f"its surface is open: mass and inertia are those of its convex {'pieces' if source.pieces else 'hull'} "
            "(--material weighs its wall, and --mass sets the mass)"
        )
    solid = enclosed(np.asarray(whole.triangles)) if closed else None
    if solid and solid.overlaps:
        notes.append("its bodies overlap: what lies in several of them weighs once")
    hulls, owners, errors = convex_pieces(
        source, meshes, np.asarray(whole.triangles), solid and solid.volume, [factor * x for x in given], options, notes
    )
    mass, center, inertia = _weighed(source, meshes, factor, solid, hulls if source.pieces else None, options)
    pieces = tuple(_piece(hull, center, owner) for hull, owner in zip(hulls, owners, strict=True))
    whole.apply_translation(-center)
    points, normals, face = sample_mesh(
        np.asarray(whole.triangles), pieces, np.random.default_rng(seed), oriented=closed
    )
    part_names, graspable, labels = _labels(source, meshes, factor, center, points, face, options.up)
    share = graspable[labels].mean()
    if not 0.1 <= share <= 0.9:
        notes.append(f"its graspable region is {share:.0%} of the surface (10 to 90 % work best)")
    if not source.parts_are_pieces:
        pieces = _labelled(pieces, points, labels)
    picture = repair.with_few_faces(whole)
    colours = _colours(source, factor, center, seed, options.up, notes)
    obj = GraspObject(
        name=source.name,
        family="imported",
        pieces=pieces,
        part_names=part_names,
        graspable=graspable,
        mass=mass,
        inertia=inertia,
        points=points.astype(np.float32),
        normals=normals.astype(np.float32),
        labels=labels.astype(np.int32),
        rest_poses=np.zeros((0, 7)),
        visual_vertices=np.asarray(picture.vertices, np.float32),
        visual_faces=np.asarray(picture.faces, np.int32),
        origin=tuple((-center).tolist()),
        file_scale=factor,
        file_up=up,
        notes=tuple(dict.fromkeys(notes)),
        surface_error=errors.surface,
        volume_error=errors.volume,
        colours=colours,
    )
    obj = dataclasses.replace(obj, rest_poses=rest_poses(obj))
    return obj if source.parts else cut_to_hold(obj)


def _read(
    source: Source, up: Up, notes: list[str]
) -> tuple[list[np.ndarray], list[trimesh.Trimesh], Literal["y", "z"]]:
    """The convex pieces (V, 3) in a source's folder, its repaired surfaces, z up, and the files' axis that was up."""
    given = [np.asarray(read_mesh(file.path, up=up).vertices, np.float64) for file in source.pieces]
    visuals = [read_mesh(file.path, notes, up) for file in source.visuals]
    visuals = visuals or [shapes.triangulate(piece) for piece in given]
    found = up_of(source.files()[0].path, up)
    if found == "y":
        notes.append("its y axis, which points up in the file, became its z axis (--up z leaves the axes)")
    if not (given or source.parts):
        visuals = [repair.largest_body(mesh, notes) for mesh in visuals]
    if not source.parts:
        visuals = [repair.closed(mesh, notes) for mesh in visuals]
    return given, visuals, found


def _colours(source: Source, factor: float, center: np.ndarray, seed: int, up: Up, notes: list[str]) -> Colours | None:
    """Colours of the files, in the object frame; None if they have none, or cannot be read."""
    try:
        found = sample_colours([file.path for file in source.visuals], seed, up, notes)
    except CongraspError as error:
        notes.append(f"its colours are left out: {error}")
        return None
    return found and found._replace(points=(factor * found.points - center).astype(np.float32))


def _joined(meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Several meshes as one, faces in their order."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]
    return trimesh.Trimesh(np.concatenate([m.vertices for m in meshes]), np.concatenate(faces), process=False)


def _scaled(mesh: trimesh.Trimesh, factor: float) -> trimesh.Trimesh:
    """A mesh in metres that faces outwards."""
    mesh = mesh.copy()
    mesh.apply_scale(factor)
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def _scaled_parts(source: Source, factor: float, up: Up) -> list[trimesh.Trimesh]:
    """Meshes of the part files in metres."""
    return [_scaled(read_mesh(part.path, up=up), factor) for part in source.parts]


def _weighed(
    source: Source,
    meshes: Sequence[trimesh.Trimesh],
    factor: float,
    solid: Enclosed | None,
    hulls: Sequence[np.ndarray] | None,
    options: ImportOptions,
) -> Weight:
    """Mass properties by the options: of materials, or of an evenly dense body.

    Args:
      source: the object's files.
      meshes: its surface, m.
      factor: metres per unit of the files.
      solid: measures of what the surface encloses; None for an open one.
      hulls: vertices (V, 3) of the convex solids that replace an open surface, m; the surface's hull if None.
      options: material, density and mass.
    """
    whole, text = _joined(meshes), options.material
    if "=" in text:
        bodies = meshes if source.parts_are_pieces else _scaled_parts(source, factor, options.up)
        found = weigh(bodies, materials_of(text, [part.part for part in source.parts]))
    elif text:
        found = weigh(meshes, materials_of(text, [""] * len(meshes)))
    else:
        area = float(whole.area)
        if solid:
            volume, area, center, inertia, _ = solid
        else:
            solids = [np.asarray(whole.vertices)] if hulls is None else hulls
            pieces = tuple(Piece("mesh", (0, 0, 0), vertices=solid) for solid in solids)
            volume, center, inertia = mass_properties(pieces, np.ones(len(pieces)))
        mass = guessed_mass(volume, area) if options.density is None else options.density * volume
        found = Weight(mass, center, inertia * mass / volume)
    mass = found.mass if options.mass is None else options.mass
    return Weight(mass, found.center, found.inertia * (mass / found.mass))


def _piece(hull: np.ndarray, center: np.ndarray, part: int) -> Piece:
    """A convex piece of vertices (V, 3), with its origin at their mean, relative to the centre of mass."""
    middle = hull.mean(0)
    return Piece("mesh", (0.0, 0.0, 0.0), tuple((middle - center).tolist()), vertices=hull - middle, part=part)


def _labelled(pieces: tuple[Piece, ...], points: np.ndarray, labels: np.ndarray) -> tuple[Piece, ...]:
    """The pieces with the part to which most of their vertices are nearest, by labels (N,) of points (N, 3)."""
    near = cKDTree(points)
    votes = (labels[near.query(np.asarray(piece.vertices) + piece.pos)[1]] for piece in pieces)
    return tuple(
        dataclasses.replace(piece, part=int(np.bincount(vote).argmax()))
        for piece, vote in zip(pieces, votes, strict=True)
    )


def _labels(
    source: Source,
    meshes: list[trimesh.Trimesh],
    factor: float,
    center: np.ndarray,
    points: np.ndarray,
    face: np.ndarray,
    up: Up,
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Names of the parts, which of them form the graspable region, and the part (N,) of each surface point."""
    if source.parts_are_pieces:
        ends = np.cumsum([len(mesh.faces) for mesh in meshes])
        labels = np.searchsorted(ends, face, side="right")
    elif source.parts:
        distances = []
        for part in _scaled_parts(source, factor, up):
            dense, _ = trimesh.sample.sample_surface(part, 4000, seed=0)
            distances.append(cKDTree(dense - center).query(points)[0])
        labels = np.argmin(distances, axis=0)
    else:
        labels = halves(points, 0.5)
        middle = [points[labels == k] - points[labels == k].mean(0) for k in (0, 1)]
        slim = int(np.argmin([np.linalg.svd(half, compute_uv=False)[2] / np.sqrt(len(half)) for half in middle]))
        return UNLABELLED, np.arange(2) == slim, labels
    files = source.parts
    graspable = np.array([bool(file.graspable) for file in files])
    if graspable.all() or not graspable.any():
        graspable = np.arange(len(files)) == np.bincount(labels, minlength=len(files)).argmax()
    return tuple(file.part for file in files), graspable, labels
