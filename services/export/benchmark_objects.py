"""Object of a motion in the format of DexGraspBench: a folder with its mesh, its convex pieces and its mass."""

import hashlib
import json
import pathlib

import numpy as np
import trimesh
from scipy.spatial import QhullError

import congrasp.common.objects
import congrasp.services.assets.objects
from congrasp.common.errors import CongraspError
from congrasp.common.io.caches import keep, read_kept, source_digest
from congrasp.common.io.files import cache_folder, write_atomically
from congrasp.common.objects import shapes
from congrasp.common.objects.procedural import plain_object
from congrasp.common.objects.spec import MAX_MESH_PIECES, GraspObject, Piece
from congrasp.common.wire.codec import Message
from congrasp.services.assets.objects.decompose import decompose
from congrasp.services.assets.objects.pieces import simplify
from congrasp.services.export.motion_file import GraspMotion

_DENSITY = 500.0  # kg/m^3
_SECONDS = 60.0  # deadline of the convex decomposition of a body
_MOST_FILES = 1024  # bodies whose pieces are cached


def convex_object(motion: GraspMotion) -> GraspObject:
    """Returns the object in the motion's object frame, made of convex pieces, since a motion only has its mesh.

    Raises:
      CongraspError: the mesh has no volume.
    """
    shape = motion.object_vertices.astype(float), motion.object_faces
    # Bodies that only touch have no vertex in common, unless equal ones are merged.
    bodies = trimesh.Trimesh(*shape, process=False).split(only_watertight=False, repair=False)
    if len(bodies) > MAX_MESH_PIECES:
        bodies = [trimesh.Trimesh(*shape)]
    pieces = [piece for body in bodies for piece in _pieces(body, max(1, MAX_MESH_PIECES // len(bodies)))]
    if not pieces:
        raise CongraspError(f"The mesh of '{motion.object}' has no volume.", "Generate the motion again.")
    return plain_object(motion.object, tuple(pieces), _DENSITY)


def write_object(folder: pathlib.Path, obj: GraspObject, origin: np.ndarray, scale: float) -> None:
    """Writes an object as the benchmark's preprocessing does, in the frame and unit of its file.

    Args:
      folder: gets `mesh/simplified.obj`, `urdf/meshes/convex_piece_*.obj` and `info/simplified.json`.
      obj: convex pieces in the object frame.
      origin: (3,) m: object frame = scale * file - origin.
      scale: m per unit of the file.
    """

    def in_file(points: np.ndarray) -> np.ndarray:
        return (points + origin) / scale

    _write_mesh(folder / "mesh" / "simplified.obj", in_file(obj.visual_vertices), obj.visual_faces)
    for number, piece in enumerate(obj.pieces):
        vertices, faces = shapes.tessellate(piece)
        _write_mesh(folder / "urdf" / "meshes" / f"convex_piece_{number:03d}.obj", in_file(vertices), faces)
    info = {
        "gravity_center": (origin / scale).tolist(),
        "obb": (np.ptp(obj.visual_vertices, axis=0) / scale).tolist(),
        "scale": 1.0,
        "density": 1.0,
        "mass": sum(shapes.volume(piece) for piece in obj.pieces) / scale**3,
    }
    write_atomically(folder / "info" / "simplified.json", json.dumps(info, indent=1).encode())


def _pieces(body: trimesh.Trimesh, most: int) -> list[Piece]:
    """Convex pieces of one body; empty for a flat one.

    Results of CoACD are cached in the user's cache folder until the code of the decomposition changes. Substitutes
    after a timeout of CoACD are not cached.
    """
    vertices, faces = np.asarray(body.vertices), np.asarray(body.faces)
    code = source_digest(congrasp.services.assets.objects, congrasp.common.objects).encode()
    key = hashlib.sha256(b"".join([code, vertices.tobytes(), faces.tobytes(), bytes([most])])).hexdigest()[:32]
    file = cache_folder("pieces") / f"{key}.safetensors"
    if (kept := read_kept(file)) is not None:
        return [_piece(kept.arrays[name]) for name in sorted(kept.arrays)]
    try:
        volume = float(body.volume) if body.is_volume else None
        found = decompose(vertices, faces, volume=volume, time_limit=_SECONDS, max_pieces=most)
        hulls = [simplify(piece) for piece in found.pieces]
    except QhullError:
        return []
    if found.method == "coacd":
        keep(file, Message({f"{i:03d}": hull.astype(np.float32) for i, hull in enumerate(hulls)}), _MOST_FILES)
    return [_piece(hull) for hull in hulls]


def _piece(vertices: np.ndarray) -> Piece:
    """A convex piece of vertices (V, 3) in the object frame."""
    return Piece("mesh", (0.0, 0.0, 0.0), vertices=vertices.astype(np.float64))


def _write_mesh(path: pathlib.Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Writes triangles as Wavefront OBJ."""
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    write_atomically(path, "\n".join([*lines, ""]).encode())
