"""Mesh files: read with trimesh within limits, and checked.

What trimesh's readers leave to the caller is done before them: STL files are read by `stl`, an
OBJ's relative indices become absolute (`obj`), a PLY's polygons triangles (`ply`), and a GLB's
integers the numbers that they stand for (`gltf`).
"""

import io
import pathlib
import re
from typing import Any, Literal

import numpy as np
import trimesh

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import read_file
from congrasp.services.assets.objects import repair
from congrasp.services.assets.objects.file_kinds import (
    MAX_BYTES,
    RECONSTRUCT,
    START_BYTES,
    read_with_kind,
)
from congrasp.services.assets.objects.gltf import MAX_FACES, packed, plain_glb
from congrasp.services.assets.objects.obj import NO_POINT, lacks_points, plain_obj
from congrasp.services.assets.objects.options import Up
from congrasp.services.assets.objects.ply import plain_ply
from congrasp.services.assets.objects.stl import read_stl

_EXPORT_AGAIN = "Export it again, or convert it."
_DECIMAL_COMMA = re.compile(rb"(?mi)^[ \t]*(v[ \t]+|vertex[ \t]+)?[-+]?\d+,\d+(?:e[-+]?\d+)?[ \t]")
_MAX_COORDINATE = 1e12
"""Largest coordinate in the file's unit, so that squares and products are finite."""
_MAX_ROUNDING = 0.01
"""Largest rounding of coordinates in single precision, as a share of a mesh's size."""
_MIN_TRIANGLES = 4
"""Triangles of a tetrahedron."""
_MAX_REASON_LENGTH = 200
_PREPARE = {"ply": plain_ply, "glb": plain_glb, "obj": plain_obj}
"""Functions of the content and of notes, which return the content as trimesh reads it."""


@np.errstate(all="ignore")  # of numbers that are refused, or far out
def read_mesh(
    path: pathlib.Path, notes: list[str] | None = None, up: Up = "auto"
) -> trimesh.Trimesh:
    """Reads one mesh, in the file's own unit, with merged vertices and each proper triangle once.

    Args:
      path: the file; its content determines the kind, not its name.
      notes: repairs are appended.
      up: axis that points up in the file (`up_of`); a y axis becomes z.

    Raises:
      CongraspError: not a mesh, empty, or not finite.
    """
    if notes is None:
        notes = []
    kind, data = read_with_kind(path)
    if f".{kind}" != path.suffix.lower():
        notes.append(f"its content is {kind.upper()}, whatever its name says, and was read as that")
    geometry = _geometry(path, kind, data, _EXPORT_AGAIN, notes, skip_materials=True)
    axis = up_of(geometry, up)
    mesh = geometry.to_mesh() if isinstance(geometry, trimesh.Scene) else geometry
    if not len(getattr(mesh, "faces", ())):
        raise _no_triangles(path, kind, data, len(getattr(mesh, "vertices", ())))
    if mesh.vertices.shape[1:] != (3,) or mesh.faces.shape[1:] != (3,):
        raise CongraspError(f"{path} has points without three coordinates.", _EXPORT_AGAIN)
    check_triangles(path, mesh)
    vertices, faces = _finite(path, mesh, notes)
    _check_coordinates(path, vertices)
    vertices, faces = repair.reduce_large(vertices, faces, notes)
    mesh = repair.merge_vertices(upright(vertices, axis), faces, notes)
    if len(mesh.faces) < _MIN_TRIANGLES:
        raise CongraspError(
            f"{path} has no volume: it has {len(mesh.faces)} triangles with an area, and "
            f"{_MIN_TRIANGLES} are the minimum.",
            "Export a closed mesh.",
        )
    mesh.metadata["kind"] = geometry.metadata["kind"]
    return mesh


def check_triangles(path: pathlib.Path, mesh: trimesh.Trimesh) -> None:
    """Checks that the triangles of a mesh are not too many, and that their vertices exist.

    Raises:
      CongraspError: they are too many, or one refers to a vertex that the mesh lacks.
    """
    too_many = len(mesh.faces) > MAX_FACES
    if too_many or mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise CongraspError(
            f"{path} has too many triangles, or triangles whose vertices do not exist.",
            _EXPORT_AGAIN,
        )


def up_of(geometry: Any, up: Up = "auto") -> Literal["y", "z"]:
    """Returns the axis that points up in the file of a geometry.

    That is `up`, unless it is auto: then y in GLB, by the standard of glTF, and z in others.
    """
    if up != "auto":
        return up
    return "y" if geometry.metadata["kind"] == "glb" else "z"


def upright(points: np.ndarray, up: Literal["y", "z"]) -> np.ndarray:
    """Returns points or vectors (..., 3) of a file whose `up` axis points up, with z up."""
    if up == "z":
        return points
    return np.asarray(points)[..., [0, 2, 1]] * [1, -1, 1]


def load_geometry(
    path: pathlib.Path, remedy: str, *, notes: list[str] | None = None, **options: Any
) -> Any:
    """Loads a file with trimesh, as a mesh, a point cloud or a scene, in the file's axes and unit.

    Args:
      path: the file; its content determines the kind, not its name.
      remedy: remedy for the error message.
      notes: what was left out of it, or is missing, is appended.
      **options: of `trimesh.load`.

    Returns:
      The geometry; its `metadata["kind"]` is stl, obj, ply or glb, also of a glTF file.

    Raises:
      CongraspError: it cannot be read; the line ends with the remedy.
    """
    kind, data = read_with_kind(path)
    if notes is None:
        notes = []
    return _geometry(path, kind, data, remedy, notes, **options)


def _geometry(
    path: pathlib.Path, kind: str, data: bytes, remedy: str, notes: list[str], **options: Any
) -> Any:
    """The geometry of a file of this kind and content; see `load_geometry`."""
    try:
        _check_decimal_points(kind, data)
        if kind == "gltf":
            data = packed(data)
            kind = "glb"
        if kind == "stl":
            geometry: Any = read_stl(data, notes)
        else:
            geometry = trimesh.load(
                io.BytesIO(_PREPARE[kind](data, notes)),
                file_type=kind,
                resolver=_NeighbouringFiles(path, notes),
                process=False,
                **options,
            )
    except CongraspError as error:
        raise CongraspError(f"{path} {error}") from None
    except Exception as error:  # trimesh's readers raise whatever they stumble over
        message = str(error) or type(error).__name__
        reason = message.splitlines()[0][:_MAX_REASON_LENGTH].rstrip(" .!")
        if kind == "obj" and isinstance(error, IndexError) and lacks_points(data):
            reason = NO_POINT
        raise CongraspError(f"{path} cannot be read as {kind.upper()}: {reason}.", remedy) from None
    geometry.metadata["kind"] = kind
    return geometry


def _check_decimal_points(kind: str, data: bytes) -> None:
    """Raises a ValueError for text whose numbers have decimal commas.

    Points are behind a keyword in OBJ and STL, and begin a line in PLY.
    """
    if b"\0" in data[:START_BYTES]:
        return
    for match in _DECIMAL_COMMA.finditer(data):
        if kind == "ply" or match[1]:
            raise ValueError("it uses decimal commas")


class _NeighbouringFiles(trimesh.resolvers.FilePathResolver):
    """Finds the materials and pictures that a mesh file names, and notes missing ones.

    They may have paths of Windows.
    """

    def __init__(self, path: pathlib.Path, notes: list[str]):
        super().__init__(str(path))
        self._folder = path.parent
        self._notes = notes

    def get(self, name: str) -> bytes:
        """Returns the content of a file next to the mesh.

        Raises:
          FileNotFoundError: there is none.
        """
        relative = str(name).strip().replace("\\", "/")
        for candidate in (relative, pathlib.PurePosixPath(relative).name):
            file = self._folder / candidate
            if file.is_file():
                return read_file(file, MAX_BYTES)
        note = f"the file '{name}' that it names is missing"
        if note not in self._notes:
            self._notes.append(note)
        raise FileNotFoundError(note)


def _no_triangles(path: pathlib.Path, kind: str, data: bytes, points: int) -> CongraspError:
    """The error of a file without triangles, which may have points."""
    if b"property float f_dc_0" in data[:START_BYTES]:
        fault = f"{path} is a Gaussian splat of {points} points: it has no triangles."
        return CongraspError(fault, RECONSTRUCT)
    if points:
        fault = f"{path} has no triangles: it contains only {points} points."
        return CongraspError(fault, RECONSTRUCT)
    fault = f"{path} has no triangles: it contains nothing that can be read as a mesh."
    return CongraspError(fault, f"Export it as a triangle mesh ({kind.upper()}).")


def _finite(
    path: pathlib.Path, mesh: trimesh.Trimesh, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3) of a mesh, without a few that are not finite.

    Raises:
      CongraspError: too many are not finite.
    """
    finite = repair.without_invalid_vertices(
        np.asarray(mesh.vertices), np.asarray(mesh.faces), notes
    )
    if finite is None:
        count = int((~np.isfinite(mesh.vertices)).any(-1).sum())
        raise CongraspError(
            f"{path} has {count} vertices whose coordinates are not finite numbers.",
            "Repair it, or export it again.",
        )
    return finite


def _check_coordinates(path: pathlib.Path, vertices: np.ndarray) -> None:
    """Raises a CongraspError for vertices (V, 3) too far from the origin for their numbers.

    Single precision, which most formats have, rounds coordinates in proportion to their distance.
    """
    farthest = np.abs(vertices).max(initial=0.0)
    if farthest > _MAX_COORDINATE:
        raise CongraspError(
            f"{path} has a coordinate of {farthest:.3g}.",
            f"Move it to the origin, or scale it: {_MAX_COORDINATE:g} is the limit in any unit.",
        )
    rounding = float(np.spacing(np.float32(farthest)))
    size = np.ptp(vertices, axis=0).max(initial=0.0)
    is_single_precision = (vertices.astype(np.float32) == vertices).all()
    if is_single_precision and 0 < _MAX_ROUNDING * size < rounding:
        raise CongraspError(
            f"{path} is so far from its origin that its coordinates are rounded to {rounding:.2g}.",
            "Move it to the origin in the program that wrote it, and export it again.",
        )
