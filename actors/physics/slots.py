"""One model for a whole pool of objects: what differs between objects becomes arrays that are batched over worlds.

Primitive pieces of every object share a fixed number of geom slots, whose sizes and poses are swapped; a slot that an
object does not use shrinks to 0.4 mm inside it. Mesh pieces cannot be swapped: each mesh object owns its geoms, and
those of the other objects are put out of reach.
"""

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np

from actors.physics.scene import HAND_CONTYPE, OBJECT_CONTYPE, finish_spec, scene_spec
from common.config import TaskConfig
from common.hands.spec import Hand
from common.objects.mjcf import GEOM_TYPES, add_object
from common.objects.spec import PRIMITIVE_SLOTS, GraspObject, Piece

_UNUSED = 0.0004
_OUT_OF_REACH = (0.0, 0.0, 500.0)
"""Offset of other objects' meshes: far from everything, table included, in any orientation of the object."""

LEAVES = (
    "geom_size",
    "geom_pos",
    "geom_quat",
    "geom_rbound",
    "geom_aabb",
    "body_mass",
    "body_inertia",
    "body_iquat",
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
)
"""Fields of the model that differ between objects."""


@dataclasses.dataclass(frozen=True)
class Pool:
    """A compiled model and its per-object leaves (N, ...), by the names in `LEAVES`."""

    model: mujoco.MjModel
    leaves: dict[str, np.ndarray]


def build_pool(hand: Hand, task: TaskConfig, objects: Sequence[GraspObject]) -> Pool:
    """The shared model of a pool of objects.

    Args:
      hand: the hand.
      task: timing and collision settings.
      objects: at most `PRIMITIVE_SLOTS` primitive pieces each; meshes add geoms to the model.
    """
    spec = scene_spec(hand, task)
    pieces = [Piece(kind, _shrunk(kind)) for kind, count in PRIMITIVE_SLOTS.items() for _ in range(count)]  # type: ignore[arg-type]
    owners: list[tuple[int, int]] = []
    for n, obj in enumerate(objects):
        for k, piece in enumerate(obj.pieces):
            if piece.kind == "mesh":
                pieces.append(piece)
                owners.append((n, k))
    add_object(
        spec,
        dataclasses.replace(objects[0], pieces=tuple(pieces)),
        contype=OBJECT_CONTYPE,
        conaffinity=HAND_CONTYPE,
    )
    finish_spec(spec, hand)
    model = spec.compile()
    slots = sum(PRIMITIVE_SLOTS.values())
    geoms = np.array([model.geom(f"object_{i}").id for i in range(len(pieces))])
    base = {name: getattr(model, name).copy() for name in LEAVES}
    rows = [_leaves(model, base, obj, n, geoms[:slots], geoms[slots:], owners) for n, obj in enumerate(objects)]
    for name, value in base.items():
        getattr(model, name)[:] = value
    return Pool(model, {name: np.stack([row[name] for row in rows]) for name in LEAVES})


def _shrunk(kind: str) -> tuple[float, float, float]:
    return (_UNUSED, _UNUSED, 0.0) if kind in ("cylinder", "capsule") else (_UNUSED, _UNUSED, _UNUSED)


def _leaves(
    model: mujoco.MjModel,
    base: dict[str, np.ndarray],
    obj: GraspObject,
    index: int,
    slots: np.ndarray,
    meshes: np.ndarray,
    owners: list[tuple[int, int]],
) -> dict[str, np.ndarray]:
    """Leaves of one object: written into the model, completed by MuJoCo, and copied out."""
    for name, value in base.items():
        getattr(model, name)[:] = value
    for geom, (owner, _) in zip(meshes, owners, strict=True):
        if owner != index:
            model.geom_pos[geom] = _OUT_OF_REACH
    free = {kind: [g for g in slots if model.geom_type[g] == GEOM_TYPES[kind]] for kind in PRIMITIVE_SLOTS}
    for piece in obj.pieces:
        if piece.kind == "mesh":
            continue
        geom = free[piece.kind].pop(0)
        model.geom_size[geom] = piece.size
        model.geom_pos[geom] = piece.pos
        model.geom_quat[geom] = piece.quat
        half = _half_extent(piece)
        model.geom_aabb[geom] = [0, 0, 0, *half]
        model.geom_rbound[geom] = _bounding_radius(piece)
    body = model.body("object").id
    principal, axes = np.linalg.eigh(obj.inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    model.body_mass[body], model.body_inertia[body] = obj.mass, principal
    mujoco.mju_mat2Quat(model.body_iquat[body], axes.ravel())
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return {name: getattr(model, name).copy() for name in LEAVES}


def _half_extent(piece: Piece) -> tuple[float, float, float]:
    a, b, c = piece.size
    if piece.kind == "cylinder":
        return a, a, b
    return (a, a, a + b) if piece.kind == "capsule" else (a, b, c)


def _bounding_radius(piece: Piece) -> float:
    a, b, c = piece.size
    if piece.kind == "box":
        return float(np.linalg.norm(piece.size))
    if piece.kind == "cylinder":
        return float(np.hypot(a, b))
    return a + b if piece.kind == "capsule" else max(a, b, c)
