"""What a hand looks like in its file: a mesh for each link, kept beside the hand's file, for pictures.

Physics and policies know the capsules alone; a hand without this file is drawn by those.
"""

import io
import pathlib
from typing import Any

import mujoco
import numpy as np
import trimesh

from common.errors import CongraspError
from common.files import write_atomically
from common.hands.skin import Skin
from common.hands.spec import Hand, Link, link_origin
from common.npz import read_npz
from services.assets.hands.geometry import geom_mesh

SUFFIX = ".visual.npz"
MAX_FACES = 3000
"""Triangles of a link; finer meshes are simplified."""
MAX_BYTES = 16 << 20
"""Bytes of all meshes."""
_PARTS = ("vertices", "faces")
_REMEDY = "Make it anew with 'congrasp hands import', or delete it."

Meshes = dict[str, tuple[np.ndarray, np.ndarray]]
"""Vertices (V, 3) m, wrist frame at zero, and triangles (E, 3) by the names of links."""


def link_mesh(
    model: mujoco.MjModel, data: mujoco.MjData, bodies: list[int], turn: np.ndarray, origin: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """What is drawn of bodies, in the frame that `turn` (3, 3) brings to the world and that lies at `origin` (3,) m.

    None where that is nothing.
    """
    parts = []
    for body in bodies:
        mine = [g for g in range(model.ngeom) if model.geom_bodyid[g] == body]
        drawn = [g for g in mine if not model.geom_contype[g] | model.geom_conaffinity[g]] or mine
        for g in drawn:
            if (mesh := geom_mesh(model, g)) is not None:
                world = np.asarray(mesh.vertices) @ data.geom_xmat[g].reshape(3, 3).T + data.geom_xpos[g]
                parts.append(trimesh.Trimesh((world - origin) @ turn, mesh.faces, process=False))
    if not parts:
        return None
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)])
    whole = trimesh.Trimesh(np.concatenate([part.vertices for part in parts]), faces)
    if len(whole.faces) > MAX_FACES:
        whole = whole.simplify_quadric_decimation(face_count=MAX_FACES)
    if not 0 < len(whole.faces) <= MAX_FACES:  # many separate parts cannot be simplified so far
        whole = trimesh.Trimesh(np.concatenate([part.vertices for part in parts])).convex_hull
    return np.asarray(whole.vertices, np.float32), np.asarray(whole.faces, np.int32)


def skin_of_meshes(hand: Hand, meshes: Meshes) -> Skin:
    """A surface of links' meshes, and of the capsules of links that have none."""
    parts = [
        trimesh.Trimesh(*meshes[link.name], process=False) if link.name in meshes else _capsules(link)
        for link in hand.links
    ]
    counts = [len(part.vertices) for part in parts]
    starts = np.cumsum([0, *counts[:-1]])
    return Skin(
        points=np.concatenate([part.vertices for part in parts]).astype(np.float32),
        normals=np.concatenate([part.vertex_normals for part in parts]).astype(np.float32),
        faces=np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]).astype(np.int32),
        weights=np.eye(len(parts), dtype=np.float32)[np.repeat(np.arange(len(parts)), counts)],
        origins=np.array([link_origin(link) for link in hand.links]),
        flesh=False,
        joint=np.zeros(sum(counts), bool),
    )


def _capsules(link: Link) -> trimesh.Trimesh:
    """A link's capsules, in the wrist frame at zero."""
    parts = []
    for capsule in link.capsules:
        way = np.subtract(capsule.end, capsule.start)
        part = trimesh.creation.capsule(float(np.linalg.norm(way)), capsule.radius, count=(12, 12))
        if way.any():
            part.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], way))
        parts.append(part.apply_translation(np.add(capsule.start, capsule.end) / 2))
    whole = trimesh.util.concatenate(parts)
    assert isinstance(whole, trimesh.Trimesh)
    return whole


def beside(path: pathlib.Path) -> pathlib.Path:
    """Where the meshes of a hand file are."""
    return path.with_suffix(SUFFIX)


def save_meshes(path: pathlib.Path, meshes: Meshes) -> None:
    """Writes the meshes of a hand beside its file; without any, what was there is removed."""
    if not meshes:
        beside(path).unlink(missing_ok=True)
        return
    parts = [(name, *part) for name, mesh in meshes.items() for part in zip(_PARTS, mesh, strict=True)]
    arrays: dict[str, Any] = {f"{name}/{part}": array for name, part, array in parts}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_atomically(beside(path), buffer.getvalue())


def load_meshes(path: pathlib.Path, hand: Hand) -> Meshes:
    """The meshes beside a hand file; none where there is no such file.

    Raises:
      CongraspError: it is damaged, or not of this hand's links.
    """
    file = beside(path)
    if not file.is_file():
        return {}
    arrays = read_npz(file, _REMEDY, kind="the meshes of a hand", largest=MAX_BYTES)
    found = {}
    for name in dict.fromkeys(key.rpartition("/")[0] for key in arrays):
        vertices, faces = (arrays.get(f"{name}/{part}", np.zeros(0)) for part in _PARTS)
        fits = vertices.ndim == faces.ndim == 2 and vertices.shape[1] == faces.shape[1] == 3 and faces.size
        fits = fits and vertices.dtype.kind == "f" and faces.dtype.kind == "i" and np.isfinite(vertices).all()
        if not fits or faces.min() < 0 or faces.max() >= len(vertices) or len(faces) > MAX_FACES:
            raise CongraspError(f"{file} holds no mesh of '{name[:60]}'.", _REMEDY)
        found[name] = vertices, faces
    if odd := sorted({*found} - {link.name for link in hand.links}):
        raise CongraspError(f"{file} is not of the hand '{hand.name}', which has no link '{odd[0][:60]}'.", _REMEDY)
    return found
