"""One model for a pool of objects, for MJX: fields that differ between objects become arrays
batched over environments.

Primitive pieces fill slots (`actors.physics.slots`). Meshes cannot be swapped: each mesh object has
separate geoms, and those of other objects get a margin that no contact can reach.
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
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.physics_library import mujoco
from congrasp.common.task.config import TaskConfig

LEAVES = (*GEOM_FIELDS, "geom_margin", *BODY_FIELDS, *DOF_FIELDS)
"""Fields of the model that differ between objects."""
_NO_CONTACT_MARGIN = -1000.0
"""Margin of other objects' meshes, m: contact would need a penetration of a kilometre."""


class PooledModel:
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
        self._owners: list[int] = []  # index of the object of each mesh
        for index, obj in enumerate(objects):
            meshes = [piece for piece in obj.pieces if piece.kind == "mesh"]
            pieces += meshes
            self._owners += [index] * len(meshes)
        shared = dataclasses.replace(objects[0], pieces=tuple(pieces))
        self.model, geoms = slot_model(hand, task, shared)
        self._primitive_geoms = geoms[:slots]
        self._mesh_geoms = geoms[slots:]

    def leaves(self, objects: Sequence[GraspObject]) -> dict[str, np.ndarray]:
        """Fields (N, ...) of the model for each object, by the names in `LEAVES`.

        Args:
          objects: the pool, or as many others without meshes.

        Raises:
          CongraspError: a mesh object is not in the pool, or there are more pieces than slots.
        """
        data = mujoco.MjData(self.model)
        rows = []
        for index, obj in enumerate(objects):
            with restore_at_end(self.model, LEAVES):
                self._fill(data, obj, index)
                rows.append({name: getattr(self.model, name).copy() for name in LEAVES})
        return stacked(rows)

    def _fill(self, data: mujoco.MjData, obj: GraspObject, index: int) -> None:
        """Writes an object into the model, with the quantities that MuJoCo derives."""
        if mesh_count(obj) != self._owners.count(index):
            raise CongraspError(
                f"The meshes of the object '{obj.name}' are not in the model.",
                "Build another engine for its pool.",
            )
        for geom, owner in zip(self._mesh_geoms, self._owners, strict=True):
            if owner != index:
                self.model.geom_margin[geom] = _NO_CONTACT_MARGIN
        fill_primitives(self.model, self._primitive_geoms, obj)
        fill_body(self.model, data, obj)
