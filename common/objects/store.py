"""Objects on disk: one safetensors file each, and folders of them, with checks of an object
whatever its source.
"""

import hashlib
import math
import os
import pathlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import LONGEST_NAME, file_name, read_file
from congrasp.common.objects.spec import (
    COLOUR_POINTS,
    PIECE_KINDS,
    SURFACE_POINTS,
    Colours,
    GraspObject,
    Piece,
)
from congrasp.common.wire.codec import Message, decode, encode

SUFFIX = ".safetensors"
MAX_BYTES = 64 << 20
"""Largest size of an object file in bytes."""
_FORMAT = 1
_ERRORS = ("surface_error", "volume_error")
_ARRAYS = (
    "graspable",
    "inertia",
    "points",
    "normals",
    "labels",
    "rest_poses",
    "visual_vertices",
    "visual_faces",
)


def digest(obj: GraspObject) -> str:
    """Returns sixteen hex digits that identify the object's content."""
    return hashlib.sha256(encode(_to_message(obj))).hexdigest()[:16]


def save(obj: GraspObject, path: str | os.PathLike[str]) -> None:
    """Writes an object atomically.

    Raises:
      CongraspError: the file cannot be written.
    """
    write_atomically(pathlib.Path(path), encode(_to_message(obj)))


def load(path: str | os.PathLike[str]) -> GraspObject:
    """Reads an object. Its arrays are read-only.

    Raises:
      CongraspError: the file is missing, of another kind, damaged, or has implausible values
        (`faults`).
    """
    path = pathlib.Path(path)
    remedy = "Run 'congrasp objects import' or 'congrasp objects generate' again."
    if not path.exists():
        raise CongraspError(
            f"There is no object file {path}.",
            "'congrasp objects list' shows the content of a folder.",
        )
    data = read_file(path, MAX_BYTES, remedy)
    try:
        message = decode(data)
    except CongraspError as error:
        raise CongraspError(f"{path} cannot be read as an object: {error}", remedy) from None
    if message.meta.get("kind") != "object" or message.meta.get("format") != _FORMAT:
        raise CongraspError(f"{path} is not an object of this version of congrasp.", remedy)
    try:
        obj = _from_message(message)
    except (KeyError, IndexError, ValueError, TypeError, AttributeError) as error:
        raise CongraspError(f"{path} lacks an array or a field: {error}.", remedy) from None
    for fault in faults(obj):
        raise CongraspError(f"{path}: {fault}.", remedy)
    return obj


class Catalogue:
    """A folder of object files, `<name>.safetensors`."""

    def __init__(self, folder: str | os.PathLike[str]):
        self.folder = pathlib.Path(folder)

    def list(self) -> list[str]:
        """Names of the objects, sorted.

        Raises:
          CongraspError: the folder does not exist.
        """
        if not self.folder.is_dir():
            raise CongraspError(
                f"There is no folder {self.folder}.",
                "Make one with 'congrasp objects generate' or 'objects import'.",
            )
        return sorted(
            path.stem for path in self.folder.glob(f"*{SUFFIX}") if not path.name.startswith(".")
        )

    def get(self, name: str) -> GraspObject:
        """Returns the object of this name.

        Raises:
          CongraspError: there is no such object, or its file is damaged.
        """
        return load(self.path(name))

    def add(self, obj: GraspObject) -> pathlib.Path:
        """Stores an object under its name, replacing one of the same name; returns the file."""
        path = self.path(obj.name)
        save(obj, path)
        return path

    def path(self, name: str) -> pathlib.Path:
        """Returns the file of a name.

        Raises:
          CongraspError: the name cannot be a file name.
        """
        return self.folder / f"{file_name(name, 'an object')}{SUFFIX}"


def _to_message(obj: GraspObject) -> Message:
    """Returns the object as a message."""
    arrays = {name: np.asarray(getattr(obj, name)) for name in _ARRAYS}
    if obj.colours:
        arrays |= {"colour_points": obj.colours.points, "colour_values": obj.colours.values}
    pieces = obj.pieces
    meshes = [np.zeros((0, 3)) if piece.vertices is None else piece.vertices for piece in pieces]
    arrays["piece_kind"] = np.array([PIECE_KINDS.index(piece.kind) for piece in pieces], np.int32)
    arrays["piece_part"] = np.array([piece.part for piece in pieces], np.int32)
    for name in ("size", "pos", "quat"):
        arrays[f"piece_{name}"] = np.array([getattr(piece, name) for piece in pieces], np.float64)
    arrays["piece_vertex_count"] = np.array([len(vertices) for vertices in meshes], np.int32)
    arrays["piece_vertices"] = np.concatenate(meshes).astype(np.float64)
    meta: dict[str, Any] = {
        "kind": "object",
        "format": _FORMAT,
        "name": obj.name,
        "family": obj.family,
        "part_names": list(obj.part_names),
        "mass": float(obj.mass),
        "units": (
            "m, kg, kg.m^2; quaternions (w, x, y, z); object frame with its origin at the centre "
            "of mass"
        ),
    }
    if any(obj.origin):
        meta["origin"] = list(obj.origin)
    if obj.file_scale != 1.0:
        meta["file_scale"] = obj.file_scale
    if obj.file_up != "z":
        meta["file_up"] = obj.file_up
    for name in _ERRORS:
        if getattr(obj, name) is not None:
            meta[name] = getattr(obj, name)
    if obj.notes:
        meta["notes"] = list(obj.notes)
    return Message(arrays, meta)


def _from_message(message: Message) -> GraspObject:
    """Returns the object of a message; raises KeyError, IndexError or ValueError if a field is
    missing or invalid.
    """
    arrays, meta = message.arrays, message.meta
    ends = np.cumsum(arrays["piece_vertex_count"])
    vertices = np.split(arrays["piece_vertices"], ends[:-1])
    pieces = tuple(
        Piece(
            kind=PIECE_KINDS[arrays["piece_kind"][i]],
            size=tuple(arrays["piece_size"][i].tolist()),
            pos=tuple(arrays["piece_pos"][i].tolist()),
            quat=tuple(arrays["piece_quat"][i].tolist()),
            vertices=vertices[i] if len(vertices[i]) else None,
            part=int(arrays["piece_part"][i]),
        )
        for i in range(len(ends))
    )
    return GraspObject(
        name=meta["name"],
        family=meta["family"],
        pieces=pieces,
        part_names=tuple(meta["part_names"]),
        mass=meta["mass"],
        origin=tuple(meta.get("origin", (0.0, 0.0, 0.0))),
        file_scale=meta.get("file_scale", 1.0),
        file_up=meta.get("file_up", "z"),
        notes=tuple(meta.get("notes", ())),
        surface_error=meta.get("surface_error"),
        volume_error=meta.get("volume_error"),
        **{name: arrays[name] for name in _ARRAYS},
        colours=Colours(arrays["colour_points"], arrays["colour_values"])
        if "colour_points" in arrays
        else None,
    )


LARGEST = 10.0
"""Greatest distance from the object frame's origin to any part of the object, m."""
HEAVIEST = 1000.0
"""Kilograms."""
_PIECES, _PARTS, _RESTS, _NOTES = 64, 256, 256, 100  # limits
_CORNERS = 4096  # limit of a piece's vertices
_SIZES = {"box": 3, "cylinder": 2, "capsule": 2, "ellipsoid": 3, "mesh": 0}
_ROUNDING = 1e-3


def faults(obj: GraspObject) -> Iterator[str]:
    """Yields the faults of an object, one phrase each; later ones assume that earlier checks
    passed.
    """
    yield from _facts(obj)
    wrong_shape = list(_shapes(obj))
    yield from wrong_shape
    if not wrong_shape:
        yield from _arrays(obj)
        yield from _inertia(obj)
    if not 1 <= len(obj.pieces) <= _PIECES:
        yield f"it has {len(obj.pieces)} pieces, not 1 to {_PIECES}"
    for i, piece in enumerate(obj.pieces[:_PIECES]):
        yield from (f"its piece {i} {fault}" for fault in _piece(piece, len(obj.part_names)))


def _facts(obj: GraspObject) -> Iterator[str]:
    """Yields faults of names and scalars."""
    try:
        file_name(obj.name, "an object")
    except CongraspError as error:
        yield str(error).split(". ")[0]
    if not isinstance(obj.family, str) or len(obj.family) > LONGEST_NAME:
        yield "its family is not a name"
    if not 1 <= len(obj.part_names) <= _PARTS or not all(_is_text(name) for name in obj.part_names):
        yield f"its parts have no names, or exceed {_PARTS}"
    if len(obj.notes) > _NOTES or not all(isinstance(note, str) for note in obj.notes):
        yield f"its notes are not texts, or exceed {_NOTES}"
    if not (_is_number(obj.mass) and 0 < obj.mass <= HEAVIEST):
        yield f"its mass is {obj.mass!r:.20}, not above 0 and at most {HEAVIEST:g} kg"
    if not (_is_number(obj.file_scale) and 0 < obj.file_scale < 1e9):
        yield f"its file_scale is {obj.file_scale!r:.20}"
    if obj.file_up not in ("y", "z"):
        yield f"its file_up is {obj.file_up!r:.20}, not 'y' or 'z'"
    if len(obj.origin) != 3 or not all(_is_number(x) and abs(x) < 1e9 for x in obj.origin):
        yield "its origin is not three finite numbers"
    for name in ("surface_error", "volume_error"):
        if getattr(obj, name) is not None and not _is_number(getattr(obj, name)):
            yield f"its {name} is {getattr(obj, name)!r:.20}, which is not a number"


def _is_number(value: object) -> bool:
    return (
        isinstance(value, (int, float)) and not isinstance(value, bool) and -1e300 < value < 1e300
    )


def _is_text(value: object) -> bool:
    return isinstance(value, str) and len(value) <= LONGEST_NAME


def _shapes(obj: GraspObject) -> Iterator[str]:
    """Yields arrays whose shape or type differs from `GraspObject`."""
    wanted: dict[str, tuple[str, tuple[int | None, ...]]] = {
        "graspable": ("b", (len(obj.part_names),)),
        "inertia": ("f", (3, 3)),
        "points": ("f", (SURFACE_POINTS, 3)),
        "normals": ("f", (SURFACE_POINTS, 3)),
        "labels": ("iu", (SURFACE_POINTS,)),
        "rest_poses": ("f", (None, 7)),
        "visual_vertices": ("f", (None, 3)),
        "visual_faces": ("iu", (None, 3)),
    }
    arrays = {name: np.asarray(getattr(obj, name)) for name in wanted}
    if obj.colours:
        arrays |= {"colour_points": obj.colours.points, "colour_values": obj.colours.values}
        count = min(max(obj.colours.points.size // 3, 1), COLOUR_POINTS)
        wanted |= {"colour_points": ("f", (count, 3)), "colour_values": ("u", (count, 3))}
        if obj.colours.values.dtype != np.uint8:
            yield f"its colour_values are {obj.colours.values.dtype}, not uint8"
    for name, (kinds, shape) in wanted.items():
        array = arrays[name]
        fits = len(array.shape) == len(shape) and all(
            w in (None, n) for w, n in zip(shape, array.shape, strict=True)
        )
        if array.dtype.kind not in kinds or not fits:
            words = ", ".join("n" if size is None else str(size) for size in shape)
            yield f"its {name} has the shape {array.shape} and type {array.dtype}, not ({words})"


def _arrays(obj: GraspObject) -> Iterator[str]:
    """Yields implausible values of arrays."""
    placed = {
        name: getattr(obj, name)
        for name in ("inertia", "points", "normals", "rest_poses", "visual_vertices")
    }
    for name, values in (
        placed | ({"colour_points": obj.colours.points} if obj.colours else {})
    ).items():
        if not np.isfinite(values).all():
            yield f"its {name} holds numbers that are not finite"
        elif values.size and np.abs(values).max() > (
            HEAVIEST * LARGEST**2 if name == "inertia" else LARGEST
        ):
            yield (
                f"its {name} goes up to {np.abs(values).max():.3g}, which is too large for an "
                f"object"
            )
    if obj.labels.min() < 0 or obj.labels.max() >= len(obj.part_names):
        yield "its labels name parts that do not exist"
    if not 1 <= len(obj.rest_poses) <= _RESTS:
        yield f"it has {len(obj.rest_poses)} resting poses, not 1 to {_RESTS}"
    elif np.abs(np.linalg.norm(obj.rest_poses[:, 3:], axis=-1) - 1).max() > _ROUNDING:
        yield "its rest_poses hold quaternions that are not normalised"
    if np.abs(np.linalg.norm(obj.normals, axis=-1) - 1).max() > 10 * _ROUNDING:
        yield "its normals are not normalised"
    faces = obj.visual_faces
    if not len(faces) or faces.min() < 0 or faces.max() >= len(obj.visual_vertices):
        yield "its visual_faces are empty, or name vertices that do not exist"


def _inertia(obj: GraspObject) -> Iterator[str]:
    """Yields faults of the inertia: principal moments are positive, and two of them exceed the
    third.
    """
    if not np.isfinite(obj.inertia).all():
        return
    if np.abs(obj.inertia - obj.inertia.T).max() > _ROUNDING * np.abs(obj.inertia).max():
        yield "its inertia is not symmetric"
        return
    small, middle, large = np.linalg.eigvalsh(obj.inertia.astype(float))
    if small <= 0 or small + middle < (1 - _ROUNDING) * large:
        yield (
            f"its inertia has principal moments {small:.3g}, {middle:.3g} and {large:.3g}, which "
            f"no rigid body has"
        )


def _piece(piece: Piece, parts: int) -> Iterator[str]:
    """Yields the faults of a piece."""
    numbers = [*piece.size, *piece.pos, *piece.quat]
    if (len(piece.size), len(piece.pos), len(piece.quat)) != (3, 3, 4) or not all(
        map(math.isfinite, numbers)
    ):
        yield "has a size or pose with numbers that are not finite"
        return
    used = piece.size[: _SIZES[piece.kind]]
    if any(not 0 < x <= LARGEST for x in used) or any(abs(x) > LARGEST for x in piece.pos):
        yield f"has the size {piece.size} and position {piece.pos}"
    if abs(math.hypot(*piece.quat) - 1) > _ROUNDING:
        yield "has a quaternion that is not normalised"
    if not 0 <= piece.part < parts:
        yield "belongs to a part that does not exist"
    vertices = piece.vertices
    if (piece.kind == "mesh") != (vertices is not None):
        yield "needs vertices if it is a mesh, and none otherwise"
    elif vertices is not None and not (
        vertices.ndim == 2
        and vertices.shape[1] == 3
        and 4 <= len(vertices) <= _CORNERS
        and np.isfinite(vertices).all()
        and np.abs(vertices).max() <= LARGEST
    ):
        yield (
            f"has vertices that are not 4 to {_CORNERS} points of finite numbers within "
            f"{LARGEST:g} m"
        )
