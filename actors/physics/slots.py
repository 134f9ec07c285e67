"""One model for a whole pool of objects: fields that differ between objects become arrays batched over environments.

Primitive pieces of all objects share a fixed number of geom slots, whose sizes and poses are swapped; an unused slot
shrinks to 0.4 mm inside the object. Mesh pieces of a `Pool` cannot be swapped: each mesh object has separate geoms, and
those of other objects get a margin that no contact can reach.
"""

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np

from congrasp.actors.physics.scene import HAND_CONTYPE, OBJECT_CONTYPE, finish_spec, object_contact, scene_spec
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.mjcf import GEOM_TYPES, add_object
from congrasp.common.objects.spec import PRIMITIVE_SLOTS, GraspObject, Piece
from congrasp.common.task.config import TaskConfig

_UNUSED = 0.0004
_NO_CONTACT = -1000.0
"""Margin (m) of other objects' meshes: contact would need a penetration of a kilometre."""

LEAVES = (
    "geom_size",
    "geom_pos",
    "geom_quat",
    "geom_rbound",
    "geom_aabb",
    "geom_margin",
    "body_mass",
    "body_inertia",
    "body_iquat",
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
)
"""Fields of the model that differ between objects."""


class Pool:
    """Model shared by a pool of objects, and the fields that differ between them."""

    def __init__(self, hand: Hand, task: TaskConfig, objects: Sequence[GraspObject]):
        """Compiles the model.

        Args:
          hand: the hand.
          task: timing and collision settings.
          objects: at most `PRIMITIVE_SLOTS` primitive pieces each; meshes add geoms to the model.
        """
        spec = scene_spec(hand, task)
        pieces = empty_slots()
        slots = len(pieces)
        self._owners: list[int] = []
        for n, obj in enumerate(objects):
            meshes = [piece for piece in obj.pieces if piece.kind == "mesh"]
            pieces += meshes
            self._owners += [n] * len(meshes)
        shared = dataclasses.replace(objects[0], pieces=tuple(pieces))
        body = add_object(spec, shared, contype=OBJECT_CONTYPE, conaffinity=HAND_CONTYPE, contact=object_contact(task))
        body.simple = 0  # MuJoCo's shortcut for a diagonal inertia, which other objects may not have
        finish_spec(spec, hand)
        self.model: mujoco.MjModel = spec.compile()
        geoms = np.array([self.model.geom(f"object_{i}").id for i in range(len(pieces))])
        self._slots, self._meshes = geoms[:slots], geoms[slots:]

    def leaves(self, objects: Sequence[GraspObject]) -> dict[str, np.ndarray]:
        """Fields (N, ...) of the model for each object, by the names in `LEAVES`.

        Args:
          objects: the pool, or as many others without meshes.

        Raises:
          CongraspError: a mesh object is not in the pool, or there are more pieces than slots.
        """
        base = {name: getattr(self.model, name).copy() for name in LEAVES}
        data = mujoco.MjData(self.model)
        rows = [self._leaves(base, data, obj, n) for n, obj in enumerate(objects)]
        for name, value in base.items():
            getattr(self.model, name)[:] = value
        return {name: np.stack([row[name] for row in rows]) for name in LEAVES}

    def _leaves(
        self, base: dict[str, np.ndarray], data: mujoco.MjData, obj: GraspObject, index: int
    ) -> dict[str, np.ndarray]:
        """Returns the leaves of one object: written into the model, completed by MuJoCo, and copied out."""
        model = self.model
        for name, value in base.items():
            getattr(model, name)[:] = value
        meshes = sum(piece.kind == "mesh" for piece in obj.pieces)
        if meshes != self._owners.count(index):
            raise CongraspError(
                f"The meshes of the object '{obj.name}' are not in the model.", "Build another engine for its pool."
            )
        for geom, owner in zip(self._meshes, self._owners, strict=True):
            if owner != index:
                model.geom_margin[geom] = _NO_CONTACT
        fill_primitives(model, self._slots, obj)
        fill_body(model, data, obj)
        return {name: getattr(model, name).copy() for name in LEAVES}


def empty_slots() -> list[Piece]:
    """Primitive slots of an environment without an object."""
    return [Piece(kind, _shrunk(kind)) for kind, count in PRIMITIVE_SLOTS.items() for _ in range(count)]  # type: ignore[arg-type]


def fill_primitives(model: mujoco.MjModel, slots: np.ndarray, obj: GraspObject) -> None:
    """Writes an object's primitive pieces into empty slots.

    Args:
      model: the model, changed in place.
      slots: the geoms of `empty_slots`.
      obj: the object; its mesh pieces are ignored.

    Raises:
      CongraspError: there are more pieces of a kind than slots.
    """
    free = {kind: [g for g in slots if model.geom_type[g] == GEOM_TYPES[kind]] for kind in PRIMITIVE_SLOTS}
    for piece in obj.pieces:
        if piece.kind == "mesh":
            continue
        if not free[piece.kind]:
            raise CongraspError(
                f"The object '{obj.name}' has more than {PRIMITIVE_SLOTS[piece.kind]} {piece.kind} pieces.",
                "Use fewer pieces, or import it as a mesh.",
            )
        geom = free[piece.kind].pop(0)
        model.geom_size[geom] = piece.size
        model.geom_pos[geom] = piece.pos
        model.geom_quat[geom] = piece.quat
        model.geom_aabb[geom] = [0, 0, 0, *_half_extent(piece)]
        model.geom_rbound[geom] = _bounding_radius(piece)


def fill_body(model: mujoco.MjModel, data: mujoco.MjData, obj: GraspObject) -> None:
    """Writes mass and inertia into the body `object`, and the quantities that MuJoCo derives from them.

    Args:
      model: the model, changed in place.
      data: scratch memory of that model.
      obj: the object.
    """
    body = model.body("object").id
    principal, axes = np.linalg.eigh(obj.inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    model.body_mass[body], model.body_inertia[body] = obj.mass, principal
    mujoco.mju_mat2Quat(model.body_iquat[body], axes.ravel())
    mujoco.mj_setConst(model, data)


def _shrunk(kind: str) -> tuple[float, float, float]:
    """Size of an unused slot."""
    return (_UNUSED, _UNUSED, 0.0) if kind in ("cylinder", "capsule") else (_UNUSED, _UNUSED, _UNUSED)


def _half_extent(piece: Piece) -> tuple[float, float, float]:
    """Half extents of a primitive's bounding box in its frame, m."""
    a, b, c = piece.size
    if piece.kind == "cylinder":
        return a, a, b
    return (a, a, a + b) if piece.kind == "capsule" else (a, b, c)


def _bounding_radius(piece: Piece) -> float:
    """Radius of the bounding sphere around a primitive's centre, m."""
    a, b, c = piece.size
    if piece.kind == "box":
        return float(np.linalg.norm(piece.size))
    if piece.kind == "cylinder":
        return float(np.hypot(a, b))
    return a + b if piece.kind == "capsule" else max(a, b, c)
