"""Objects on disk: one safetensors file each, and folders of them."""

import hashlib
import os
import pathlib
from typing import Any

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import file_name, read_file
from congrasp.common.objects.checks import faults
from congrasp.common.objects.spec import Colours, GraspObject, Piece
from congrasp.common.wire.codec import Message, decode, encode

SUFFIX = ".safetensors"
MAX_BYTES = 64 << 20
"""Largest size of an object file in bytes."""
_FORMAT = 1
_KINDS = ("box", "cylinder", "capsule", "ellipsoid", "mesh")
_ERRORS = ("surface_error", "volume_error")
_ARRAYS = ("graspable", "inertia", "points", "normals", "labels", "rest_poses", "visual_vertices", "visual_faces")


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
      CongraspError: the file is missing, of another kind, damaged, or has implausible values (`faults`).
    """
    path = pathlib.Path(path)
    remedy = "Run 'congrasp objects import' or 'congrasp objects generate' again."
    if not path.exists():
        raise CongraspError(
            f"There is no object file {path}.", "'congrasp objects list' shows the content of a folder."
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
                f"There is no folder {self.folder}.", "Make one with 'congrasp objects generate' or 'objects import'."
            )
        return sorted(path.stem for path in self.folder.glob(f"*{SUFFIX}") if not path.name.startswith("."))

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
    arrays["piece_kind"] = np.array([_KINDS.index(piece.kind) for piece in pieces], np.int32)
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
        "units": "m, kg, kg.m^2; quaternions (w, x, y, z); object frame with its origin at the centre of mass",
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
    """Returns the object of a message; raises KeyError, IndexError or ValueError if a field is missing or invalid."""
    arrays, meta = message.arrays, message.meta
    ends = np.cumsum(arrays["piece_vertex_count"])
    vertices = np.split(arrays["piece_vertices"], ends[:-1])
    pieces = tuple(
        Piece(
            kind=_KINDS[arrays["piece_kind"][i]],  # type: ignore[arg-type]
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
        colours=Colours(arrays["colour_points"], arrays["colour_values"]) if "colour_points" in arrays else None,
    )
