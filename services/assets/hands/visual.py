"""Visual meshes of each link in a hand's file, simplified, and stored next to the hand's file."""

import io
import pathlib
from typing import Any

import mujoco
import numpy as np
import trimesh

from congrasp.common.hands.meshes import MAX_FACES, PARTS, Meshes, beside
from congrasp.common.io.files import write_atomically
from congrasp.services.assets.hands.geometry import geom_mesh


def link_mesh(model: mujoco.MjModel, data: mujoco.MjData, bodies: list[int]) -> tuple[np.ndarray, np.ndarray] | None:
    """Visual mesh of bodies; None if there is none."""
    parts = []
    for body in bodies:
        mine = [g for g in range(model.ngeom) if model.geom_bodyid[g] == body]
        drawn = [g for g in mine if not model.geom_contype[g] | model.geom_conaffinity[g]] or mine
        for g in drawn:
            if (mesh := geom_mesh(model, g)) is not None:
                placed = np.asarray(mesh.vertices) @ data.geom_xmat[g].reshape(3, 3).T + data.geom_xpos[g]
                parts.append(trimesh.Trimesh(placed, mesh.faces, process=False))
    if not parts:
        return None
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)])
    whole = trimesh.Trimesh(np.concatenate([part.vertices for part in parts]), faces)
    if len(whole.faces) > MAX_FACES:
        whole = whole.simplify_quadric_decimation(face_count=MAX_FACES)
    if not 0 < len(whole.faces) <= MAX_FACES:  # many separate parts cannot be simplified that far
        whole = trimesh.Trimesh(np.concatenate([part.vertices for part in parts])).convex_hull
    return np.asarray(whole.vertices, np.float32), np.asarray(whole.faces, np.int32)


def save_meshes(path: pathlib.Path, meshes: Meshes) -> None:
    """Writes the meshes of a hand next to its file; without any, removes an existing file."""
    if not meshes:
        beside(path).unlink(missing_ok=True)
        return
    parts = [(name, *part) for name, mesh in meshes.items() for part in zip(PARTS, mesh, strict=True)]
    arrays: dict[str, Any] = {f"{name}/{part}": array for name, part, array in parts}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_atomically(beside(path), buffer.getvalue())
