"""Checks of an object, whatever its source: names, numbers, shapes of arrays and pieces."""

import math
from collections.abc import Iterator, Sequence
from typing import TypeGuard

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import LONGEST_NAME, file_name
from congrasp.common.objects.spec import COLOUR_POINTS, SURFACE_POINTS, GraspObject, Piece

MAX_COORDINATE = 10.0
"""Greatest coordinate of any part of the object in the object frame, m."""
_MAX_MASS = 1000.0  # kg
_MAX_INERTIA = _MAX_MASS * MAX_COORDINATE**2  # kg.m^2
_FILE_NUMBER_BOUND = 1e9
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
_NORMAL_ROUNDING = 1e-2
"""Tolerance of the norms of normals; larger than that of quaternions, since nothing is rotated by
normals.
"""
_BOOL_KINDS = "b"
_FLOAT_KINDS = "f"
_INDEX_KINDS = "iu"
_BYTE_KINDS = "u"
_KIND_NAMES = {
    _BOOL_KINDS: "booleans",
    _FLOAT_KINDS: "floating-point numbers",
    _INDEX_KINDS: "integers",
    _BYTE_KINDS: "unsigned integers",
}
"""Names of types in messages, by the codes of NumPy's kinds of dtypes."""


def faults(obj: GraspObject) -> Iterator[str]:
    """Yields the faults of an object, one phrase each. Callers report the first: it may be the
    cause of those that follow.
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
        yield error.fault.removesuffix(".")
    if not _is_short_text(obj.family):
        yield f"its family is not a text of at most {LONGEST_NAME} characters"
    if not 1 <= len(obj.part_names) <= _MAX_PARTS:
        yield f"it has {len(obj.part_names)} parts, not 1 to {_MAX_PARTS}"
    if not all(map(_is_short_text, obj.part_names)):
        yield f"the names of its parts are not texts of at most {LONGEST_NAME} characters"
    if len(obj.notes) > _MAX_NOTES:
        yield f"it has {len(obj.notes)} notes, more than {_MAX_NOTES}"
    if not all(isinstance(note, str) for note in obj.notes):
        yield "its notes are not texts"
    if obj.file_up not in ("y", "z"):
        yield f"its file_up is {_shown(obj.file_up)}, not 'y' or 'z'"


def _number_faults(obj: GraspObject) -> Iterator[str]:
    """Yields faults of scalars and of the origin."""
    if not (_is_number(obj.mass) and 0 < obj.mass <= _MAX_MASS):
        yield f"its mass is {_shown(obj.mass)}, not above 0 and at most {_MAX_MASS:g} kg"
    if not (_is_number(obj.file_scale) and 0 < obj.file_scale < _FILE_NUMBER_BOUND):
        bound = f"{_FILE_NUMBER_BOUND:g}"
        yield f"its file_scale is {_shown(obj.file_scale)}, not above 0 and below {bound}"
    if len(obj.origin) != 3 or not all(map(_is_coordinate, obj.origin)):
        yield f"its origin is not three numbers below {_FILE_NUMBER_BOUND:g}"
    for name in ("surface_error", "volume_error"):
        error = getattr(obj, name)
        if error is not None and not _is_number(error):
            yield f"its {name} is {_shown(error)}, which is not a finite number"
    if _is_number(obj.surface_error) and obj.surface_error < 0:
        yield f"its surface_error is {_shown(obj.surface_error)}, below 0 m"


def _shown(value: object) -> str:
    """Returns at most 20 characters of a value's `repr`, for a message."""
    return repr(value)[:20]


def _is_number(value: object) -> TypeGuard[float]:
    """Returns True for a finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    # `math.isfinite` would fail for an integer that is too large for a float
    return -1e300 < value < 1e300


def _is_coordinate(value: object) -> bool:
    """Returns True for a number of the file's origin."""
    return _is_number(value) and abs(value) < _FILE_NUMBER_BOUND


def _is_short_text(value: object) -> bool:
    """Returns True for a text that is not too long for a name."""
    return isinstance(value, str) and len(value) <= LONGEST_NAME


def _shape_faults(obj: GraspObject) -> Iterator[str]:
    """Yields a fault for each array whose shape or type differs from `GraspObject`."""
    yield from _array_faults("graspable", obj.graspable, _BOOL_KINDS, (len(obj.part_names),))
    yield from _array_faults("inertia", obj.inertia, _FLOAT_KINDS, (3, 3))
    yield from _array_faults("points", obj.points, _FLOAT_KINDS, (SURFACE_POINTS, 3))
    yield from _array_faults("normals", obj.normals, _FLOAT_KINDS, (SURFACE_POINTS, 3))
    yield from _array_faults("labels", obj.labels, _INDEX_KINDS, (SURFACE_POINTS,))
    yield from _array_faults("rest_poses", obj.rest_poses, _FLOAT_KINDS, (None, 7))
    yield from _array_faults("visual_vertices", obj.visual_vertices, _FLOAT_KINDS, (None, 3))
    yield from _array_faults("visual_faces", obj.visual_faces, _INDEX_KINDS, (None, 3))
    if not obj.colours:
        return
    points = np.asarray(obj.colours.points)
    values = np.asarray(obj.colours.values)
    if values.dtype != np.uint8:
        yield f"its colour_values are {values.dtype}, not uint8"
    wrong_points = list(_array_faults("colour_points", points, _FLOAT_KINDS, (None, 3)))
    if wrong_points:
        yield from wrong_points
        return
    if not 1 <= len(points) <= COLOUR_POINTS:
        yield f"it has {len(points)} colour_points, not 1 to {COLOUR_POINTS}"
    yield from _array_faults("colour_values", values, _BYTE_KINDS, (len(points), 3))


def _array_faults(
    name: str, values: object, kinds: str, shape: Sequence[int | None]
) -> Iterator[str]:
    """Yields a fault if an array has another shape or type.

    Args:
      name: name of the array.
      values: the array.
      kinds: codes of NumPy's kinds of dtypes that are valid, a key of `_KIND_NAMES`.
      shape: the expected shape, in which None is any size.
    """
    array = np.asarray(values)
    if array.dtype.kind not in kinds:
        yield f"its {name} has the type {array.dtype}; it must have {_KIND_NAMES[kinds]}"
    if not _has_shape(array, shape):
        sizes = ", ".join("n" if size is None else str(size) for size in shape)
        yield f"its {name} has the shape {array.shape}, not ({sizes})"


def _has_shape(array: np.ndarray, shape: Sequence[int | None]) -> bool:
    """Returns True if an array has a shape, in which None is any size."""
    if array.ndim != len(shape):
        return False
    return all(expected in (None, size) for size, expected in zip(array.shape, shape, strict=True))


def _value_faults(obj: GraspObject) -> Iterator[str]:
    """Yields implausible values of arrays."""
    yield from _bound_faults("inertia", obj.inertia, _MAX_INERTIA)
    yield from _bound_faults("points", obj.points, MAX_COORDINATE)
    yield from _bound_faults("normals", obj.normals, MAX_COORDINATE)
    yield from _bound_faults("rest_poses", obj.rest_poses, MAX_COORDINATE)
    yield from _bound_faults("visual_vertices", obj.visual_vertices, MAX_COORDINATE)
    if obj.colours:
        yield from _bound_faults("colour_points", obj.colours.points, MAX_COORDINATE)
    if obj.labels.min() < 0 or obj.labels.max() >= len(obj.part_names):
        yield "its labels name parts that do not exist"
    if not 1 <= len(obj.rest_poses) <= _MAX_REST_POSES:
        yield f"it has {len(obj.rest_poses)} resting poses, not 1 to {_MAX_REST_POSES}"
    elif _norm_error(obj.rest_poses[:, 3:]) > _ROUNDING:
        yield "its rest_poses hold quaternions that are not normalised"
    if _norm_error(obj.normals) > _NORMAL_ROUNDING:
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
    """Yields faults of the inertia. The principal moments of a rigid body are positive, and each is
    at most the sum of the other two.
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


def _piece_faults(piece: Piece, part_count: int) -> Iterator[str]:
    """Yields the faults of a piece of an object with this number of parts."""
    if (len(piece.size), len(piece.pos), len(piece.quat)) != (3, 3, 4):
        yield "does not have 3 numbers as its size, 3 as its position and 4 as its quaternion"
        return
    if not all(map(math.isfinite, [*piece.size, *piece.pos, *piece.quat])):
        yield "has a size or pose with numbers that are not finite"
        return
    sizes = piece.size[: _SIZES_OF_KIND[piece.kind]]
    if any(not 0 < size <= MAX_COORDINATE for size in sizes):
        yield f"has the size {piece.size}, not above 0 and at most {MAX_COORDINATE:g} m"
    if any(abs(coordinate) > MAX_COORDINATE for coordinate in piece.pos):
        yield f"has the position {piece.pos}, more than {MAX_COORDINATE:g} m from the origin"
    if abs(math.hypot(*piece.quat) - 1) > _ROUNDING:
        yield "has a quaternion that is not normalised"
    if not 0 <= piece.part < part_count:
        yield "belongs to a part that does not exist"
    is_mesh = piece.kind == "mesh"
    if is_mesh and piece.vertices is None:
        yield "is a mesh without vertices"
    if not is_mesh and piece.vertices is not None:
        yield f"has vertices, which a {piece.kind} does not have"
    if is_mesh and piece.vertices is not None and not _are_vertices(piece.vertices):
        yield (
            f"has vertices that are not {_MIN_VERTICES} to {_MAX_VERTICES} points of finite "
            f"numbers within {MAX_COORDINATE:g} m"
        )


def _are_vertices(vertices: np.ndarray) -> bool:
    """Returns True for the vertices (n, 3) of a piece."""
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        return False
    if not _MIN_VERTICES <= len(vertices) <= _MAX_VERTICES:
        return False
    return bool(np.isfinite(vertices).all() and np.abs(vertices).max() <= MAX_COORDINATE)
