"""Geometry of a hand's links in a model: meshes for pictures and capsules, and collision solids."""

from typing import Any, Literal

import numpy as np
import trimesh

from congrasp.common.hands.meshes import MAX_FACES
from congrasp.common.hands.spec import Solid, vector
from congrasp.common.runtime.physics_library import mujoco
from congrasp.services.assets.hands.links import Tree

_SOLID_KINDS: dict[mujoco.mjtGeom, Literal["box", "cylinder", "capsule", "ellipsoid"]] = {
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "ellipsoid",
    mujoco.mjtGeom.mjGEOM_SPHERE: "ellipsoid",
}

_AGGRESSION = 4
"""Haste of the simplification of meshes, from 0 to 10; with the default of 7 the points of LEAP's
links deviate twice as far.
"""


def placed(tree: Tree, link: int, *, colliding: bool) -> list[trimesh.Trimesh]:
    """Returns meshes of a link's geometry in the palm's frame, m.

    Args:
      tree: the hand.
      link: the link.
      colliding: True for what collides of each body, False for what is drawn of it (`_drawn`); a
        body without either is placed whole.
    """
    model = tree.model
    data = tree.data
    meshes = []
    for body in tree.groups[link]:
        geoms = np.flatnonzero(model.geom_bodyid == body)
        collides = (model.geom_contype[geoms] | model.geom_conaffinity[geoms]) > 0
        chosen = collides if colliding else _drawn(model, geoms, collides)
        if chosen.any():
            geoms = geoms[chosen]
        for geom in geoms.tolist():
            mesh = geom_mesh(model, geom)
            if mesh is None:
                continue
            rotation = data.geom_xmat[geom].reshape(3, 3)
            mesh.vertices = mesh.vertices @ rotation.T + data.geom_xpos[geom]
            meshes.append(mesh)
    return meshes


def _drawn(model: mujoco.MjModel, geoms: np.ndarray, collides: np.ndarray) -> np.ndarray:
    """Selects the geoms of a body that are drawn: those that do not collide and, if there are any,
    also colliding meshes of an opaque material, such as the rubber tips of the LEAP Hand.

    Args:
      model: the model.
      geoms: (n,) indices of the body's geoms.
      collides: (n,) True for geoms that collide.

    Returns:
      (n,) True for geoms that are drawn.
    """
    if collides.all():
        return ~collides
    is_painted = np.array([_is_painted_mesh(model, geom) for geom in geoms])
    return ~collides | is_painted


def _is_painted_mesh(model: mujoco.MjModel, geom: int) -> bool:
    """True for a mesh of an opaque material."""
    material = model.geom_matid[geom]
    if material < 0 or model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_MESH:
        return False
    return bool(model.mat_rgba[material, 3] == 1.0)


def solids_of(tree: Tree, link: int) -> tuple[Solid, ...]:
    """Returns the collision geometry of a link; empty without any, or with a mesh."""
    model = tree.model
    data = tree.data
    solids = []
    for geom in np.flatnonzero(np.isin(model.geom_bodyid, tree.groups[link])):
        if not model.geom_contype[geom] | model.geom_conaffinity[geom]:
            continue
        kind = _SOLID_KINDS.get(mujoco.mjtGeom(model.geom_type[geom]))
        if kind is None:
            return ()
        size = model.geom_size[geom].copy()
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
            size = np.repeat(size[0], 3)
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, data.geom_xmat[geom])
        w, x, y, z = quaternion.round(9).tolist()
        position = vector(data.geom_xpos[geom].round(6))
        solids.append(Solid(kind, vector(size.round(6)), position, (w, x, y, z)))
    return tuple(solids)


def geom_mesh(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh | None:
    """Returns the mesh of a geom in its frame, m; None for a plane."""
    kind = mujoco.mjtGeom(model.geom_type[geom])
    size = model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return _stored_mesh(model, model.geom_dataid[geom])
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


def link_mesh(tree: Tree, link: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Returns vertices (V, 3) and faces (F, 3) of a link's visual mesh; None if there is none."""
    parts = placed(tree, link, colliding=False)
    if not parts:
        return None
    joined: Any = trimesh.util.concatenate(parts)
    mesh = trimesh.Trimesh(joined.vertices, joined.faces)
    if len(mesh.faces) > MAX_FACES:
        mesh = mesh.simplify_quadric_decimation(face_count=MAX_FACES, aggression=_AGGRESSION)
    if not 0 < len(mesh.faces) <= MAX_FACES:  # many separate parts cannot be simplified that far
        mesh = _small_hull(joined)
    _remove_degenerate_faces(mesh)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)


def _remove_degenerate_faces(mesh: trimesh.Trimesh) -> None:
    """Removes faces without an area and, of faces with the same corners, all but one.

    Simplification leaves such faces, and their normals are zero or cancel. A mesh of nothing else
    stays unchanged.
    """
    is_regular = mesh.nondegenerate_faces() & mesh.unique_faces()
    if is_regular.any():
        mesh.update_faces(is_regular)
        mesh.remove_unreferenced_vertices()


def _stored_mesh(model: mujoco.MjModel, mesh: int) -> trimesh.Trimesh:
    """A mesh of the model."""
    first_vertex = model.mesh_vertadr[mesh]
    first_face = model.mesh_faceadr[mesh]
    vertices = model.mesh_vert[first_vertex : first_vertex + model.mesh_vertnum[mesh]]
    faces = model.mesh_face[first_face : first_face + model.mesh_facenum[mesh]]
    return trimesh.Trimesh(vertices, faces, process=False)


def _small_hull(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The convex hull of a mesh, with at most `MAX_FACES` triangles."""
    corners = np.asarray(mesh.convex_hull.vertices)
    # A hull of N points has 2 N - 4 faces
    directions = np.random.default_rng(0).normal(size=(3, MAX_FACES // 2))
    extremes = np.unique((corners @ directions).argmax(0))
    return trimesh.Trimesh(corners[extremes]).convex_hull
