"""Checks of an object, whatever its source: names, numbers, shapes of arrays and pieces."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import LONGEST_NAME, file_name
from congrasp.common.objects.spec import COLOUR_POINTS, SURFACE_POINTS, GraspObject, Piece

LARGEST = 10.0
"""Greatest distance from the object frame's origin to any part of the object, m."""
HEAVIEST = 1000.0
"""Greatest mass, kg."""
_LARGEST_INERTIA = HEAVIEST * LARGEST**2
"""kg m^2."""
_LARGEST_FILE_NUMBER = 1e9
"""Exclusive bound of scale and origin in the units of the file."""
_MAX_PIECES = 64
_MAX_PARTS = 256
_MAX_REST_POSES = 256
_MAX_NOTES = 100
_MIN_VERTICES = 4
_MAX_VERTICES = 4096
"""Limits of a piece's vertices."""
_SIZES_OF_KIND = {"box": 3, "cylinder": 2, "capsule": 2, "ellipsoid": 3, "mesh": 0}
"""Numbers of a piece's size that its kind uses."""
_ROUNDING = 1e-3
"""Tolerance of norms and of relations between numbers."""


def faults(obj: GraspObject) -> Iterator[str]:
    """Yields the faults of an object, one phrase each; later ones assume that earlier checks
    passed.
    """
    yield from _name_faults(obj)
    yield from _number_faults(obj)
    wrong_shapes = list(_shape_faults(obj))
    yield from wrong_shapes
    if not wrong_shapes:
        yield from _value_faults(obj)
        yield from _inertia_faults(obj)
    if not 1 <= len(obj.pieces) <= _MAX_PIECES:
        yield f"it has {len(obj.pieces)} pieces, not 1 to {_MAX_PIECES}"
    for i, piece in enumerate(obj.pieces[:_MAX_PIECES]):
        for fault in _piece_faults(piece, len(obj.part_names)):
            yield f"its piece {i} {fault}"


def _name_faults(obj: GraspObject) -> Iterator[str]:
    """Yields faults of names and texts."""
    try:
        file_name(obj.name, "an object")
    except CongraspError as error:
        sentence, _, _ = str(error).partition(". ")
        yield sentence
    if not _is_name(obj.family):
        yield "its family is not a name"
    if not 1 <= len(obj.part_names) <= _MAX_PARTS or not all(map(_is_name, obj.part_names)):
        yield f"its parts have no names, or exceed {_MAX_PARTS}"
    if len(obj.notes) > _MAX_NOTES or not all(isinstance(note, str) for note in obj.notes):
        yield f"its notes are not texts, or exceed {_MAX_NOTES}"
    if obj.file_up not in ("y", "z"):
        yield f"its file_up is {obj.file_up!r:.20}, not 'y' or 'z'"


def _number_faults(obj: GraspObject) -> Iterator[str]:
    """Yields faults of scalars and of the origin."""
    if not (_is_number(obj.mass) and 0 < obj.mass <= HEAVIEST):
        yield f"its mass is {obj.mass!r:.20}, not above 0 and at most {HEAVIEST:g} kg"
    if not (_is_number(obj.file_scale) and 0 < obj.file_scale < _LARGEST_FILE_NUMBER):
        yield f"its file_scale is {obj.file_scale!r:.20}"
    if len(obj.origin) != 3 or not all(map(_is_coordinate, obj.origin)):
        yield "its origin is not three finite numbers"
    for name in ("surface_error", "volume_error"):
        error = getattr(obj, name)
        if error is not None and not _is_number(error):
            yield f"its {name} is {error!r:.20}, which is not a number"


def _is_number(value: object) -> bool:
    """True for a finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return -1e300 < value < 1e300


def _is_coordinate(value: object) -> bool:
    """True for a number of the file's origin."""
    return isinstance(value, (int, float)) and _is_number(value) and abs(value) < 1e9


def _is_name(value: object) -> bool:
    """True for a text that is not too long for a name."""
    return isinstance(value, str) and len(value) <= LONGEST_NAME


def _shape_faults(obj: GraspObject) -> Iterator[str]:
    """Yields arrays whose shape or type differs from `GraspObject`."""
    yield from _array_faults("graspable", obj.graspable, "b", (len(obj.part_names),))
    yield from _array_faults("inertia", obj.inertia, "f", (3, 3))
    yield from _array_faults("points", obj.points, "f", (SURFACE_POINTS, 3))
    yield from _array_faults("normals", obj.normals, "f", (SURFACE_POINTS, 3))
    yield from _array_faults("labels", obj.labels, "iu", (SURFACE_POINTS,))
    yield from _array_faults("rest_poses", obj.rest_poses, "f", (None, 7))
    yield from _array_faults("visual_vertices", obj.visual_vertices, "f", (None, 3))
    yield from _array_faults("visual_faces", obj.visual_faces, "iu", (None, 3))
    if not obj.colours:
        return
    points = obj.colours.points
    values = obj.colours.values
    if values.dtype != np.uint8:
        yield f"its colour_values are {values.dtype}, not uint8"
    count = min(max(points.size // 3, 1), COLOUR_POINTS)
    yield from _array_faults("colour_points", points, "f", (count, 3))
    yield from _array_faults("colour_values", values, "u", (count, 3))


def _array_faults(
    name: str, values: object, kinds: str, shape: Sequence[int | None]
) -> Iterator[str]:
    """Yields a fault if an array is not of one of the `kinds` of types, or not of this shape, in
    which None is any size.
    """
    array = np.asarray(values)
    fits = len(array.shape) == len(shape)
    if fits:
        for size, expected in zip(array.shape, shape, strict=True):
            fits = fits and expected in (None, size)
    if array.dtype.kind not in kinds or not fits:
        sizes = ", ".join("n" if size is None else str(size) for size in shape)
        yield f"its {name} has the shape {array.shape} and type {array.dtype}, not ({sizes})"


def _value_faults(obj: GraspObject) -> Iterator[str]:
    """Yields implausible values of arrays."""
    yield from _bound_faults("inertia", obj.inertia, _LARGEST_INERTIA)
    yield from _bound_faults("points", obj.points, LARGEST)
    yield from _bound_faults("normals", obj.normals, LARGEST)
    yield from _bound_faults("rest_poses", obj.rest_poses, LARGEST)
    yield from _bound_faults("visual_vertices", obj.visual_vertices, LARGEST)
    if obj.colours:
        yield from _bound_faults("colour_points", obj.colours.points, LARGEST)
    if obj.labels.min() < 0 or obj.labels.max() >= len(obj.part_names):
        yield "its labels name parts that do not exist"
    if not 1 <= len(obj.rest_poses) <= _MAX_REST_POSES:
        yield f"it has {len(obj.rest_poses)} resting poses, not 1 to {_MAX_REST_POSES}"
    elif _norm_error(obj.rest_poses[:, 3:]) > _ROUNDING:
        yield "its rest_poses hold quaternions that are not normalised"
    if _norm_error(obj.normals) > 10 * _ROUNDING:
        yield "its normals are not normalised"
    faces = obj.visual_faces
    if not len(faces) or faces.min() < 0 or faces.max() >= len(obj.visual_vertices):
        yield "its visual_faces are empty, or name vertices that do not exist"


def _bound_faults(name: str, values: np.ndarray, largest: float) -> Iterator[str]:
    """Yields a fault if values are not finite, or larger than `largest`."""
    if not np.isfinite(values).all():
        yield f"its {name} holds numbers that are not finite"
    elif values.size and np.abs(values).max() > largest:
        yield f"its {name} goes up to {np.abs(values).max():.3g}, which is too large for an object"


def _norm_error(vectors: np.ndarray) -> float:
    """Greatest difference of the norm of vectors (n, d) from 1; NaN if one is not finite."""
    return float(np.abs(np.linalg.norm(vectors, axis=-1) - 1).max())


def _inertia_faults(obj: GraspObject) -> Iterator[str]:
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


def _piece_faults(piece: Piece, parts: int) -> Iterator[str]:
    """Yields the faults of a piece of an object with this number of parts."""
    numbers = [*piece.size, *piece.pos, *piece.quat]
    complete = (len(piece.size), len(piece.pos), len(piece.quat)) == (3, 3, 4)
    if not complete or not all(map(math.isfinite, numbers)):
        yield "has a size or pose with numbers that are not finite"
        return
    sizes = piece.size[: _SIZES_OF_KIND[piece.kind]]
    too_far = any(abs(coordinate) > LARGEST for coordinate in piece.pos)
    if too_far or any(not 0 < size <= LARGEST for size in sizes):
        yield f"has the size {piece.size} and position {piece.pos}"
    if abs(math.hypot(*piece.quat) - 1) > _ROUNDING:
        yield "has a quaternion that is not normalised"
    if not 0 <= piece.part < parts:
        yield "belongs to a part that does not exist"
    if (piece.kind == "mesh") != (piece.vertices is not None):
        yield "needs vertices if it is a mesh, and none otherwise"
    elif piece.vertices is not None and not _are_vertices(piece.vertices):
        yield (
            f"has vertices that are not {_MIN_VERTICES} to {_MAX_VERTICES} points of finite "
            f"numbers within {LARGEST:g} m"
        )


def _are_vertices(vertices: np.ndarray) -> bool:
    """True for the vertices (n, 3) of a piece."""
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        return False
    if not _MIN_VERTICES <= len(vertices) <= _MAX_VERTICES:
        return False
    return bool(np.isfinite(vertices).all() and np.abs(vertices).max() <= LARGEST)
