"""Objects as rows of the fields that differ between them, for MuJoCo Warp.

Each environment has slots for primitive pieces (`actors.physics.slots`) and for meshes, which refer
to the meshes of one model by index.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from congrasp.actors.physics.slots import (
    BODY_FIELDS,
    DOF_FIELDS,
    GEOM_FIELDS,
    empty_slots,
    fill_body,
    fill_primitives,
    mesh_count,
    restore_at_end,
    slot_model,
    stacked,
)
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject, Piece
from congrasp.common.runtime.physics_library import mujoco
from congrasp.common.task.config import TaskConfig

_SLOT_FIELDS = (*GEOM_FIELDS, "geom_dataid")
"""Fields of the model that describe a slot: a mesh slot also has the index of its mesh."""
_PLACEHOLDER = 0.001 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
"""Vertices of the mesh with which mesh slots are compiled, m."""


class ObjectRows:
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
        shared = dataclasses.replace(example, pieces=(*primitives, *meshes))
        self.model, self.geoms = slot_model(hand, task, shared)
        """(S,) geoms of the object: primitive slots, then mesh slots."""
        self._primitive_geoms = self.geoms[: len(primitives)]
        self._mesh_geoms = self.geoms[len(primitives) :]
        self._body = self.model.body("object").id
        first_dof = self.model.jnt_dofadr[self.model.body_jntadr[self._body]]
        self._dofs = first_dof + np.arange(6)

    def rows(self, objects: Sequence[GraspObject]) -> tuple[dict[str, np.ndarray], mujoco.MjModel]:
        """Converts objects to rows of the fields in which objects differ, and to a model with their
        meshes.

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
            self._check_meshes(obj)
        meshes = _compile_meshes(objects)
        data = mujoco.MjData(self.model)
        rows = []
        first_mesh = 0
        for obj in objects:
            with restore_at_end(self.model, (*_SLOT_FIELDS, *BODY_FIELDS, *DOF_FIELDS)):
                self.model.geom_dataid[self._mesh_geoms] = -1
                fill_primitives(self.model, self._primitive_geoms, obj)
                self._fill_meshes(meshes, first_mesh, mesh_count(obj))
                fill_body(self.model, data, obj)
                rows.append(self._row())
            first_mesh += mesh_count(obj)
        return stacked(rows), meshes

    def _check_meshes(self, obj: GraspObject) -> None:
        """Raises a CongraspError for more mesh pieces than slots."""
        slots = len(self._mesh_geoms)
        if mesh_count(obj) > slots:
            raise CongraspError(
                f"The object '{obj.name}' has {mesh_count(obj)} mesh pieces, but the environments "
                f"have only {slots} slots.",
                "Import it with fewer pieces.",
            )

    def _fill_meshes(self, meshes: mujoco.MjModel, first: int, count: int) -> None:
        """Writes `count` meshes of the model `meshes`, from `first` on, into mesh slots."""
        slots = self._mesh_geoms[:count]
        for name in _SLOT_FIELDS:
            getattr(self.model, name)[slots] = getattr(meshes, name)[first : first + count]

    def _row(self) -> dict[str, np.ndarray]:
        """Values of the current object in the fields that differ between objects."""
        model = self.model
        row = {}
        for name in _SLOT_FIELDS:
            row[name] = getattr(model, name)[self.geoms].copy()
        for name in BODY_FIELDS:
            row[name] = getattr(model, name)[self._body].copy()
        row["body_subtreemass"] = model.body_subtreemass[[0, self._body]]
        for name in DOF_FIELDS:
            row[name] = getattr(model, name)[self._dofs]
        return row


def _compile_meshes(objects: Sequence[GraspObject]) -> mujoco.MjModel:
    """Compiles a model with a geom and a mesh for each mesh piece of the objects, in order."""
    pieces = []
    for obj in objects:
        pieces += [piece for piece in obj.pieces if piece.kind == "mesh"]
    spec = mujoco.MjSpec()
    for i, piece in enumerate(pieces):
        spec.add_mesh(name=str(i), uservert=np.asarray(piece.vertices, np.float32).ravel())
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=str(i), pos=piece.pos, quat=piece.quat
        )
    return spec.compile()
