"""Objects as messages, with which files and digests are made."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from congrasp.common.objects.spec import PIECE_KINDS, Colours, GraspObject, Piece
from congrasp.common.wire.codec import Message

FORMAT = 1
"""Version of the messages."""
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
"""Arrays that a message has under the names of the object's attributes."""
_UNITS = (
    "m, kg, kg.m^2; quaternions (w, x, y, z); object frame with its origin at the centre of mass"
)
_NO_VERTICES = np.zeros((0, 3))
_PIECE_COLUMNS: dict[str, tuple[str, tuple[int, ...]]] = {
    "piece_kind": ("iu", ()),
    "piece_part": ("iu", ()),
    "piece_size": ("f", (3,)),
    "piece_pos": ("f", (3,)),
    "piece_quat": ("f", (4,)),
    "piece_vertex_count": ("iu", ()),
}
"""Columns of a message with a row for each piece: codes of NumPy's kinds of dtypes, and the shape
of a row.
"""


def object_to_message(obj: GraspObject) -> Message:
    """Returns the object as a message."""
    arrays = {name: np.asarray(getattr(obj, name)) for name in _ARRAYS}
    if obj.colours:
        arrays["colour_points"] = obj.colours.points
        arrays["colour_values"] = obj.colours.values
    arrays |= _piece_arrays(obj)
    meta: dict[str, Any] = {
        "kind": "object",
        "format": FORMAT,
        "name": obj.name,
        "family": obj.family,
        "part_names": list(obj.part_names),
        "mass": float(obj.mass),
        "units": _UNITS,
    }
    if any(obj.origin):
        meta["origin"] = list(obj.origin)
    if obj.file_scale != 1.0:
        meta["file_scale"] = obj.file_scale
    if obj.file_up != "z":
        meta["file_up"] = obj.file_up
    if obj.surface_error is not None:
        meta["surface_error"] = obj.surface_error
    if obj.volume_error is not None:
        meta["volume_error"] = obj.volume_error
    if obj.notes:
        meta["notes"] = list(obj.notes)
    return Message(arrays, meta)


def _piece_arrays(obj: GraspObject) -> dict[str, np.ndarray]:
    """Returns columns of the pieces; the vertices of all are one after the other."""
    pieces = obj.pieces
    meshes = []
    for piece in pieces:
        meshes.append(_NO_VERTICES if piece.vertices is None else piece.vertices)
    return {
        "piece_kind": np.array([PIECE_KINDS.index(piece.kind) for piece in pieces], np.int32),
        "piece_part": np.array([piece.part for piece in pieces], np.int32),
        "piece_size": np.array([piece.size for piece in pieces], np.float64),
        "piece_pos": np.array([piece.pos for piece in pieces], np.float64),
        "piece_quat": np.array([piece.quat for piece in pieces], np.float64),
        "piece_vertex_count": np.array([len(vertices) for vertices in meshes], np.int32),
        "piece_vertices": np.concatenate(meshes).astype(np.float64),
    }


def object_from_message(message: Message) -> GraspObject:
    """Returns the object of a message, without checks of its values.

    Raises:
      KeyError, IndexError, ValueError, TypeError, AttributeError: a field is missing or invalid.
    """
    arrays = message.arrays
    meta = message.meta
    colours = None
    if "colour_points" in arrays:
        colours = Colours(arrays["colour_points"], arrays["colour_values"])
    return GraspObject(
        name=meta["name"],
        family=meta["family"],
        pieces=_pieces(message),
        part_names=tuple(meta["part_names"]),
        mass=meta["mass"],
        origin=tuple(meta.get("origin", (0.0, 0.0, 0.0))),
        file_scale=meta.get("file_scale", 1.0),
        file_up=meta.get("file_up", "z"),
        notes=tuple(meta.get("notes", ())),
        surface_error=meta.get("surface_error"),
        volume_error=meta.get("volume_error"),
        **{name: arrays[name] for name in _ARRAYS},
        colours=colours,
    )


def _pieces(message: Message) -> tuple[Piece, ...]:
    """Returns the pieces of the columns in a message."""
    arrays = message.arrays
    _check_columns(arrays)
    ends = np.cumsum(arrays["piece_vertex_count"])
    pieces = []
    for i, vertices in enumerate(np.split(arrays["piece_vertices"], ends[:-1])):
        pieces.append(
            Piece(
                kind=PIECE_KINDS[arrays["piece_kind"][i]],
                size=tuple(arrays["piece_size"][i].tolist()),
                pos=tuple(arrays["piece_pos"][i].tolist()),
                quat=tuple(arrays["piece_quat"][i].tolist()),
                vertices=vertices if len(vertices) else None,
                part=int(arrays["piece_part"][i]),
            )
        )
    return tuple(pieces)


def _check_columns(arrays: Mapping[str, np.ndarray]) -> None:
    """Raises a ValueError if the columns of the pieces do not belong together."""
    pieces = len(arrays["piece_kind"])
    for name, (kinds, row_shape) in _PIECE_COLUMNS.items():
        column = arrays[name]
        expected = (pieces, *row_shape)
        if column.dtype.kind not in kinds:
            raise ValueError(f"{name} has the invalid type {column.dtype}")
        if column.shape != expected:
            raise ValueError(f"{name} has the shape {column.shape}, not {expected}")
    kind = arrays["piece_kind"]
    if ((kind < 0) | (kind >= len(PIECE_KINDS))).any():
        raise ValueError("piece_kind has a number without a kind")
    vertex_counts = arrays["piece_vertex_count"]
    if (vertex_counts < 0).any() or vertex_counts.sum() != len(arrays["piece_vertices"]):
        raise ValueError("piece_vertex_count does not match the vertices")
