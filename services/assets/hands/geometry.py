"""A link's geometry: capsules for its collision shapes, else visual shapes, else its inertia; and its visual mesh."""

from typing import Literal

import mujoco
import numpy as np
import trimesh

from congrasp.common.hands.meshes import MAX_FACES
from congrasp.common.hands.spec import Capsule, Solid, vector
from congrasp.services.assets.hands.compile import LEAST

_KINDS: dict[mujoco.mjtGeom, Literal["box", "cylinder", "capsule", "ellipsoid"]] = {
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "ellipsoid",
    mujoco.mjtGeom.mjGEOM_SPHERE: "ellipsoid",
}
_FLAT = 1.6  # a broader link gets several parallel capsules
_PLAUSIBLE = (0.002, 0.15)  # half extent of an inertia's box, m
_BARE = 0.005  # radius of a link without any geometry, m


def surface(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> list[np.ndarray]:
    """Points on a body's collision geometry, or on its visual geometry if there is none."""
    mine = [g for g in range(model.ngeom) if model.geom_bodyid[g] == body]
    solid = [g for g in mine if model.geom_contype[g] | model.geom_conaffinity[g]] or mine
    found: list[np.ndarray] = []
    for g in solid:
        if (mesh := geom_mesh(model, g)) is not None:
            local = np.asarray(mesh.vertices)
            found += list(local @ data.geom_xmat[g].reshape(3, 3).T + data.geom_xpos[g])
    return found


def solids_of(model: mujoco.MjModel, data: mujoco.MjData, bodies: list[int]) -> tuple[Solid, ...]:
    """Collision geometry of bodies; empty if there is none, or a mesh is among it."""
    found = []
    for g in np.flatnonzero(np.isin(model.geom_bodyid, bodies)):
        if not model.geom_contype[g] | model.geom_conaffinity[g]:
            continue
        kind, size = _KINDS.get(mujoco.mjtGeom(model.geom_type[g])), model.geom_size[g].copy()
        if kind is None:
            return ()
        if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_SPHERE:
            size = np.repeat(size[0], 3)
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, data.geom_xmat[g])
        w, x, y, z = quaternion.round(9).tolist()
        place = vector(data.geom_xpos[g].round(6))
        found.append(Solid(kind, vector(size.round(6)), place, (w, x, y, z)))
    return tuple(found)


def geom_mesh(model: mujoco.MjModel, g: int) -> trimesh.Trimesh | None:
    """Mesh of a geom in its frame; None for a plane."""
    kind, size = mujoco.mjtGeom(model.geom_type[g]), model.geom_size[g]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        m = model.geom_dataid[g]
        vertices = slice(model.mesh_vertadr[m], model.mesh_vertadr[m] + model.mesh_vertnum[m])
        faces = slice(model.mesh_faceadr[m], model.mesh_faceadr[m] + model.mesh_facenum[m])
        return trimesh.Trimesh(model.mesh_vert[vertices], model.mesh_face[faces], process=False)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return trimesh.creation.box(2 * size)
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return trimesh.creation.icosphere(1, size[0])
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return trimesh.creation.capsule(2 * size[1], size[0], count=(8, 8))
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(size[0], 2 * size[1], sections=12)
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        ball = trimesh.creation.icosphere(1)
        ball.vertices *= size
        return ball
    return None


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


def inertia_box(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> list[np.ndarray]:
    """Corners of the box with a body's mass and inertia, if the file has them and its size is that of a link."""
    mass, (x, y, z) = model.body_mass[body], model.body_inertia[body]
    if mass < 1e-4 or (mass, x, y, z) == (LEAST[0], *3 * (LEAST[1],)):
        return []
    half = np.sqrt(np.maximum(1.5 * np.array([y + z - x, x + z - y, x + y - z]) / mass, 0.0))
    if half.max() > _PLAUSIBLE[1] or half.max() < _PLAUSIBLE[0]:
        return []
    corners = np.array(trimesh.creation.box(2 * np.maximum(half, _PLAUSIBLE[0])).vertices)
    return list(corners @ data.ximat[body].reshape(3, 3).T + data.xipos[body])


def bare(*centers: np.ndarray) -> list[np.ndarray]:
    """Points around centres, for a link without geometry in the file."""
    return [c + _BARE * d for c in centers for d in np.concatenate([np.eye(3), -np.eye(3)])]


def fit_capsules(points: np.ndarray) -> tuple[Capsule, ...]:
    """Fits capsules along the longest side of the points' box (n, 3); several in parallel if it is flat."""
    to_box, extents = trimesh.bounds.oriented_bounds(points)
    order = np.argsort(extents)[::-1]
    length, breadth, height = np.maximum(extents[order], 1e-3)
    center, axes = np.linalg.inv(to_box)[:3, 3], np.linalg.inv(to_box)[:3, order]
    flat = breadth > _FLAT * height
    radius = height / 2 if flat else (breadth + height) / 4
    count = min(5, int(np.ceil(breadth / height))) if flat else 1
    half = max(length / 2 - radius, 1e-3)
    across = np.linspace(-1, 1, count) * (breadth / 2 - radius) if count > 1 else np.zeros(1)
    return tuple(
        Capsule(
            vector((center + x * axes[:, 1] - half * axes[:, 0]).round(6)),
            vector((center + x * axes[:, 1] + half * axes[:, 0]).round(6)),
            round(float(radius), 6),
        )
        for x in across
    )


def far_end(capsules: tuple[Capsule, ...], origin: np.ndarray) -> np.ndarray:
    """Mean (3,) of the capsules' ends that are farther from a point (3,): the tip of a finger."""
    ends = [
        max((capsule.start, capsule.end), key=lambda end: float(np.linalg.norm(np.subtract(end, origin))))
        for capsule in capsules
    ]
    return np.mean(ends, axis=0)
