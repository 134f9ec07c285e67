"""Catalogue of objects for environments of one model: a row of arrays each, with indices of shared meshes."""

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np

from congrasp.actors.physics.scene import HAND_CONTYPE, OBJECT_CONTYPE, finish_spec, object_contact, scene_spec
from congrasp.actors.physics.slots import empty_slots, fill_body, fill_primitives
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.mjcf import add_object
from congrasp.common.objects.spec import GraspObject, Piece
from congrasp.common.task.config import TaskConfig

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
        spec = scene_spec(hand, task)
        primitives = empty_slots()
        meshes = [Piece("mesh", (0.0, 0.0, 0.0), vertices=_PLACEHOLDER)] * mesh_slots
        shared = dataclasses.replace(example, pieces=(*primitives, *meshes))
        body = add_object(spec, shared, contype=OBJECT_CONTYPE, conaffinity=HAND_CONTYPE, contact=object_contact(task))
        body.simple = 0  # MuJoCo's shortcut for a diagonal inertia, which other objects may not have
        finish_spec(spec, hand)
        self.model: mujoco.MjModel = spec.compile()
        self.geoms = np.array([self.model.geom(f"object_{i}").id for i in range(len(shared.pieces))])
        """(S,) geoms of the object: primitive slots, then mesh slots."""
        self._primitives, self._meshes = self.geoms[: len(primitives)], self.geoms[len(primitives) :]
        self._body = self.model.body("object").id
        self._dofs = self.model.jnt_dofadr[self.model.body_jntadr[self._body]] + np.arange(6)

    def rows(self, objects: Sequence[GraspObject]) -> tuple[dict[str, np.ndarray], mujoco.MjModel]:
        """Converts objects to rows of the fields that differ between them, and a model that holds their meshes.

        Args:
          objects: N objects of primitive and mesh pieces in any mixture.

        Returns:
          Fields by their names in the model, and the model. Geom fields are (N, S, ...), with `geom_dataid` -1 in
          unused mesh slots; body fields are (N, ...), but `body_subtreemass` is (N, 2) for world and object;
          `dof_invweight0` is (N, 6). Mesh fields are in the model.

        Raises:
          CongraspError: an object has more pieces than slots.
        """
        for obj in objects:
            count = sum(piece.kind == "mesh" for piece in obj.pieces)
            if count > len(self._meshes):
                raise CongraspError(
                    f"The object '{obj.name}' has {count} mesh pieces, but the environments have only "
                    f"{len(self._meshes)} slots.",
                    "Import it with fewer pieces.",
                )
        meshes = _compile_meshes(objects)
        model, data = self.model, mujoco.MjData(self.model)
        empty = {name: getattr(model, name).copy() for name in (*_SLOT_FIELDS, *_BODY_FIELDS, "dof_invweight0")}
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
        """Writes an object's mesh pieces, from mesh `first` on, into mesh slots; returns the next mesh."""
        count = sum(piece.kind == "mesh" for piece in obj.pieces)
        for name in _SLOT_FIELDS:
            getattr(self.model, name)[self._meshes[:count]] = getattr(meshes, name)[first : first + count]
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
    for i, piece in enumerate(piece for obj in objects for piece in obj.pieces if piece.kind == "mesh"):
        spec.add_mesh(name=str(i), uservert=np.asarray(piece.vertices, np.float32).ravel())
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=str(i), pos=piece.pos, quat=piece.quat)
    return spec.compile()
