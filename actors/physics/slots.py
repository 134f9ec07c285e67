"""One model for a whole pool of objects: fields that differ between objects become arrays batched
over environments.

Primitive pieces of all objects share a fixed number of geom slots, whose sizes and poses are
swapped; an unused slot shrinks to 0.4 mm inside the object. Mesh pieces of a `Pool` cannot be
swapped: each mesh object has separate geoms, and those of other objects get a margin that no
contact can reach.
"""

import dataclasses
from collections.abc import Sequence

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
from congrasp.common.runtime.mujoco import mujoco
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
        pieces = empty_slots()
        slots = len(pieces)
        self._owners: list[int] = []
        for n, obj in enumerate(objects):
            meshes = [piece for piece in obj.pieces if piece.kind == "mesh"]
            pieces += meshes
            self._owners += [n] * len(meshes)
        self.model, geoms = _model(
            hand, task, dataclasses.replace(objects[0], pieces=tuple(pieces))
        )
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
        """Returns the leaves of one object: written into the model, completed by MuJoCo, and copied
        out.
        """
        model = self.model
        for name, value in base.items():
            getattr(model, name)[:] = value
        meshes = sum(piece.kind == "mesh" for piece in obj.pieces)
        if meshes != self._owners.count(index):
            raise CongraspError(
                f"The meshes of the object '{obj.name}' are not in the model.",
                "Build another engine for its pool.",
            )
        for geom, owner in zip(self._meshes, self._owners, strict=True):
            if owner != index:
                model.geom_margin[geom] = _NO_CONTACT
        fill_primitives(model, self._slots, obj)
        fill_body(model, data, obj)
        return {name: getattr(model, name).copy() for name in LEAVES}


def _model(hand: Hand, task: TaskConfig, shared: GraspObject) -> tuple[mujoco.MjModel, np.ndarray]:
    """Compiles the model of a scene with an object whose fields others replace; and the geoms (S,)
    of its pieces.
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
    return [
        Piece(kind, _shrunk(kind))  # type: ignore[arg-type]
        for kind, count in PRIMITIVE_SLOTS.items()
        for _ in range(count)
    ]


def fill_primitives(model: mujoco.MjModel, slots: np.ndarray, obj: GraspObject) -> None:
    """Writes an object's primitive pieces into empty slots.

    Args:
      model: the model, changed in place.
      slots: the geoms of `empty_slots`.
      obj: the object; its mesh pieces are ignored.

    Raises:
      CongraspError: there are more pieces of a kind than slots.
    """
    free = {
        kind: [g for g in slots if model.geom_type[g] == GEOM_TYPES[kind]]
        for kind in PRIMITIVE_SLOTS
    }
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
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    model.body_mass[body], model.body_inertia[body] = obj.mass, principal
    mujoco.mju_mat2Quat(model.body_iquat[body], axes.ravel())
    mujoco.mj_setConst(model, data)


def _shrunk(kind: str) -> tuple[float, float, float]:
    """Size of an unused slot."""
    return (
        (_UNUSED, _UNUSED, 0.0) if kind in ("cylinder", "capsule") else (_UNUSED, _UNUSED, _UNUSED)
    )


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


_PLACEHOLDER = 0.001 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
_SLOT_FIELDS = ("geom_size", "geom_pos", "geom_quat", "geom_rbound", "geom_aabb", "geom_dataid")
_BODY_FIELDS = ("body_mass", "body_inertia", "body_iquat", "body_subtreemass", "body_invweight0")


class Catalogue:
    """Model shared by the environments, and objects as rows that fill its slots."""

    def __init__(self, hand: Hand, task: TaskConfig, example: GraspObject, mesh_slots: int):
        """Compiles the model.

        Args:
          hand: the hand.
          task: timing and collision settings.
          example: any object; rows of others replace it in every environment.
          mesh_slots: most mesh pieces of an object.
        """
        primitives = empty_slots()
        meshes = [Piece("mesh", (0.0, 0.0, 0.0), vertices=_PLACEHOLDER)] * mesh_slots
        self.model, self.geoms = _model(
            hand, task, dataclasses.replace(example, pieces=(*primitives, *meshes))
        )
        """(S,) geoms of the object: primitive slots, then mesh slots."""
        self._primitives, self._meshes = (
            self.geoms[: len(primitives)],
            self.geoms[len(primitives) :],
        )
        self._body = self.model.body("object").id
        self._dofs = self.model.jnt_dofadr[self.model.body_jntadr[self._body]] + np.arange(6)

    def rows(self, objects: Sequence[GraspObject]) -> tuple[dict[str, np.ndarray], mujoco.MjModel]:
        """Converts objects to rows of the fields that differ between them, and a model that holds
        their meshes.

        Args:
          objects: N objects of primitive and mesh pieces in any mixture.

        Returns:
          Fields by their names in the model, and the model. Geom fields are (N, S, ...), with
          `geom_dataid` -1 in unused mesh slots; body fields are (N, ...), but `body_subtreemass` is
          (N, 2) for world and object; `dof_invweight0` is (N, 6). Mesh fields are in the model.

        Raises:
          CongraspError: an object has more pieces than slots.
        """
        for obj in objects:
            count = sum(piece.kind == "mesh" for piece in obj.pieces)
            if count > len(self._meshes):
                raise CongraspError(
                    f"The object '{obj.name}' has {count} mesh pieces, but the environments have "
                    f"only "
                    f"{len(self._meshes)} slots.",
                    "Import it with fewer pieces.",
                )
        meshes = _compile_meshes(objects)
        model, data = self.model, mujoco.MjData(self.model)
        empty = {
            name: getattr(model, name).copy()
            for name in (*_SLOT_FIELDS, *_BODY_FIELDS, "dof_invweight0")
        }
        rows, first = [], 0
        for obj in objects:
            model.geom_dataid[self._meshes] = -1
            fill_primitives(model, self._primitives, obj)
            first = self._fill_meshes(meshes, obj, first)
            fill_body(model, data, obj)
            rows.append(self._row())
            for name, value in empty.items():
                getattr(model, name)[:] = value
        return {name: np.stack([row[name] for row in rows]) for name in rows[0]}, meshes

    def _fill_meshes(self, meshes: mujoco.MjModel, obj: GraspObject, first: int) -> int:
        """Writes an object's mesh pieces, from mesh `first` on, into mesh slots; returns the next
        mesh.
        """
        count = sum(piece.kind == "mesh" for piece in obj.pieces)
        for name in _SLOT_FIELDS:
            getattr(self.model, name)[self._meshes[:count]] = getattr(meshes, name)[
                first : first + count
            ]
        return first + count

    def _row(self) -> dict[str, np.ndarray]:
        """Values of the current object in the fields that differ between objects."""
        model, body = self.model, self._body
        row = {name: getattr(model, name)[self.geoms].copy() for name in _SLOT_FIELDS}
        row |= {name: getattr(model, name)[body].copy() for name in _BODY_FIELDS}
        row["body_subtreemass"] = model.body_subtreemass[[0, body]]
        row["dof_invweight0"] = model.dof_invweight0[self._dofs]
        return row


def _compile_meshes(objects: Sequence[GraspObject]) -> mujoco.MjModel:
    """Compiles a model with a geom and a mesh for each mesh piece of the objects, in order."""
    spec = mujoco.MjSpec()
    for i, piece in enumerate(
        piece for obj in objects for piece in obj.pieces if piece.kind == "mesh"
    ):
        spec.add_mesh(name=str(i), uservert=np.asarray(piece.vertices, np.float32).ravel())
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=str(i), pos=piece.pos, quat=piece.quat
        )
    return spec.compile()
