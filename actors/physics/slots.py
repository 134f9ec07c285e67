"""Slots of one model for different objects: geoms whose sizes and poses are overwritten.

Primitive pieces of all objects share a fixed number of slots; an unused slot shrinks to 0.4 mm
inside the object. Mass and inertia of the object's body are overwritten likewise.
"""

import contextlib
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from congrasp.actors.physics.scene import (
    HAND_CONTYPE,
    OBJECT_CONTYPE,
    finish_spec,
    object_contact,
    scene_spec,
)
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.mjcf import GEOM_TYPES, add_object
from congrasp.common.objects.spec import PRIMITIVE_SLOTS, GraspObject, Piece
from congrasp.common.runtime.physics_library import mujoco
from congrasp.common.task.config import TaskConfig

GEOM_FIELDS = ("geom_size", "geom_pos", "geom_quat", "geom_rbound", "geom_aabb")
"""Fields of the model that describe an object's pieces."""
BODY_FIELDS = ("body_mass", "body_inertia", "body_iquat", "body_subtreemass", "body_invweight0")
"""Fields of the model that describe the object's body."""
DOF_FIELDS = ("dof_invweight0",)
"""Fields of the model that describe the object's free joint."""
_UNUSED_SIZE = 0.0004
"""Size of an unused slot, m."""


def slot_model(
    hand: Hand, task: TaskConfig, shared: GraspObject
) -> tuple[mujoco.MjModel, np.ndarray]:
    """Compiles the model of a scene for objects that replace the fields of a shared object.

    Returns:
      The model, and the geoms (S,) of the shared object's pieces.
    """
    spec = scene_spec(hand, task)
    body = add_object(
        spec, shared, contype=OBJECT_CONTYPE, conaffinity=HAND_CONTYPE, contact=object_contact(task)
    )
    body.simple = 0  # MuJoCo's shortcut for a diagonal inertia, which other objects may not have
    finish_spec(spec, hand)
    model: mujoco.MjModel = spec.compile()
    return model, np.array([model.geom(f"object_{i}").id for i in range(len(shared.pieces))])


def empty_slots() -> list[Piece]:
    """Primitive slots of an environment without an object."""
    slots = []
    for kind, count in PRIMITIVE_SLOTS.items():
        slots += [Piece(kind, _unused_size(kind))] * count  # type: ignore[arg-type]
    return slots


@contextlib.contextmanager
def restore_at_end(model: mujoco.MjModel, names: Sequence[str]) -> Iterator[None]:
    """Context at whose end the fields of a model are restored, also after an error."""
    before = {name: getattr(model, name).copy() for name in names}
    try:
        yield
    finally:
        for name, value in before.items():
            getattr(model, name)[:] = value


def stacked(rows: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Arrays (N, ...) of N rows with the same names."""
    arrays = {}
    for name in rows[0]:
        arrays[name] = np.stack([row[name] for row in rows])
    return arrays


def mesh_count(obj: GraspObject) -> int:
    """Number of an object's mesh pieces."""
    return sum(piece.kind == "mesh" for piece in obj.pieces)


def fill_primitives(model: mujoco.MjModel, slots: np.ndarray, obj: GraspObject) -> None:
    """Writes an object's primitive pieces into empty slots.

    Args:
      model: the model, changed in place.
      slots: the geoms of `empty_slots`.
      obj: the object; its mesh pieces are ignored.

    Raises:
      CongraspError: there are more pieces of a kind than slots.
    """
    free = {}
    for kind in PRIMITIVE_SLOTS:
        free[kind] = [geom for geom in slots if model.geom_type[geom] == GEOM_TYPES[kind]]
    for piece in obj.pieces:
        if piece.kind == "mesh":
            continue
        if not free[piece.kind]:
            raise CongraspError(
                f"The object '{obj.name}' has more than {PRIMITIVE_SLOTS[piece.kind]} {piece.kind} "
                f"pieces.",
                "Use fewer pieces, or import it as a mesh.",
            )
        geom = free[piece.kind].pop(0)
        model.geom_size[geom] = piece.size
        model.geom_pos[geom] = piece.pos
        model.geom_quat[geom] = piece.quat
        model.geom_aabb[geom] = [0, 0, 0, *_half_extent(piece)]
        model.geom_rbound[geom] = _bounding_radius(piece)


def fill_body(model: mujoco.MjModel, data: mujoco.MjData, obj: GraspObject) -> None:
    """Writes mass and inertia into the body `object`, and the quantities that MuJoCo derives from
    them.

    Args:
      model: the model, changed in place.
      data: scratch memory of that model.
      obj: the object.
    """
    body = model.body("object").id
    principal, axes = np.linalg.eigh(obj.inertia)
    # Eigenvectors may be left-handed
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    model.body_mass[body] = obj.mass
    model.body_inertia[body] = principal
    mujoco.mju_mat2Quat(model.body_iquat[body], axes.ravel())
    mujoco.mj_setConst(model, data)


def _unused_size(kind: str) -> tuple[float, float, float]:
    """Size of an unused slot."""
    if kind in ("cylinder", "capsule"):
        return _UNUSED_SIZE, _UNUSED_SIZE, 0.0
    return _UNUSED_SIZE, _UNUSED_SIZE, _UNUSED_SIZE


def _half_extent(piece: Piece) -> tuple[float, float, float]:
    """Half extents of a primitive's bounding box in its frame, m."""
    a, b, c = piece.size
    if piece.kind == "cylinder":
        return a, a, b
    if piece.kind == "capsule":
        return a, a, a + b
    return a, b, c


def _bounding_radius(piece: Piece) -> float:
    """Radius of the bounding sphere around a primitive's centre, m."""
    a, b, c = piece.size
    if piece.kind == "box":
        return float(np.linalg.norm(piece.size))
    if piece.kind == "cylinder":
        return float(np.hypot(a, b))
    if piece.kind == "capsule":
        return a + b
    return max(a, b, c)
