"""Collision shapes of a compiled model's geoms."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from congrasp.actors.physics.physx.library import px, sapien
from congrasp.actors.physics.physx.units import LENGTH_SCALE, scaled_pose
from congrasp.common.errors import CongraspError
from congrasp.common.runtime.physics_library import mujoco

_SIDES = 64
"""Sides of the prism that stands for a cylinder."""
_SPHERE_POINTS = 128
"""Vertices of the polyhedron that stands for an ellipsoid; a convex mesh has at most 255 faces."""
_X_TO_Z = (np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0)
"""Rotation from PhysX's axis of capsules and normal of planes, x, to MuJoCo's, z."""


@functools.cache
def material(friction: float) -> Any:
    """A material without restitution. The friction of a contact is the mean of its two
    materials.
    """
    return px.PhysxMaterial(friction, friction, 0.0)


def geom_shape(model: mujoco.MjModel, geom: int, surface: Any) -> Any:
    """Returns the collision shape of a geom at its pose in its body.

    Args:
      model: the compiled scene.
      geom: index of the geom.
      surface: the shape's material.

    Raises:
      CongraspError: PhysX has no shape for this type of geom.
    """
    kind = mujoco.mjtGeom(int(model.geom_type[geom]))
    if kind not in _SHAPES:
        raise CongraspError(
            f"The 'physx' engine has no shape for '{model.geom(geom).name}' ({kind.name}).",
            "Pass --physics native.",
        )
    shape, pose_in_geom = _SHAPES[kind](model, geom, surface)
    pose = scaled_pose(model.geom_pos[geom], model.geom_quat[geom])
    shape.local_pose = pose * pose_in_geom
    return shape


def plane(surface: Any) -> Any:
    """Returns the plane z = 0, solid below."""
    shape = px.PhysxCollisionShapePlane(surface)
    shape.local_pose = sapien.Pose(q=_X_TO_Z)
    return shape


def _box(model: mujoco.MjModel, geom: int, surface: Any) -> tuple[Any, Any]:
    """A box, and its pose in the geom."""
    half_size = (LENGTH_SCALE * model.geom_size[geom]).astype(np.float32)
    return px.PhysxCollisionShapeBox(half_size, surface), sapien.Pose()


def _sphere(model: mujoco.MjModel, geom: int, surface: Any) -> tuple[Any, Any]:
    """A sphere, and its pose in the geom."""
    radius = LENGTH_SCALE * model.geom_size[geom, 0]
    return px.PhysxCollisionShapeSphere(radius, surface), sapien.Pose()


def _capsule(model: mujoco.MjModel, geom: int, surface: Any) -> tuple[Any, Any]:
    """A capsule, and its pose in the geom."""
    radius, half_length, _ = LENGTH_SCALE * model.geom_size[geom]
    shape = px.PhysxCollisionShapeCapsule(radius, half_length, surface)
    return shape, sapien.Pose(q=_X_TO_Z)


def _cylinder(model: mujoco.MjModel, geom: int, surface: Any) -> tuple[Any, Any]:
    """A prism, since sapien makes a polyhedron of a cylinder too; and its pose in the geom."""
    radius, half_length, _ = model.geom_size[geom]
    return _convex(_unit_prism(), (radius, radius, half_length), surface), sapien.Pose()


def _ellipsoid(model: mujoco.MjModel, geom: int, surface: Any) -> tuple[Any, Any]:
    """A polyhedron with the volume of the ellipsoid, and its pose in the geom."""
    return _convex(_unit_sphere(), model.geom_size[geom], surface), sapien.Pose()


def _mesh(model: mujoco.MjModel, geom: int, surface: Any) -> tuple[Any, Any]:
    """The convex hull of a mesh, and its pose in the geom."""
    mesh = model.geom_dataid[geom]
    first = model.mesh_vertadr[mesh]
    vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(float)
    lowest = vertices.min(0)
    highest = vertices.max(0)
    middle = (lowest + highest) / 2
    half_size = (highest - lowest).max() / 2
    shape = _convex((vertices - middle) / half_size, (half_size,) * 3, surface)
    return shape, scaled_pose(middle)


_SHAPES: dict[Any, Callable[[mujoco.MjModel, int, Any], tuple[Any, Any]]] = {
    mujoco.mjtGeom.mjGEOM_BOX: _box,
    mujoco.mjtGeom.mjGEOM_SPHERE: _sphere,
    mujoco.mjtGeom.mjGEOM_CAPSULE: _capsule,
    mujoco.mjtGeom.mjGEOM_CYLINDER: _cylinder,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: _ellipsoid,
    mujoco.mjtGeom.mjGEOM_MESH: _mesh,
}


def _convex(vertices: np.ndarray, scale: Any, surface: Any) -> Any:
    """The convex hull of vertices (V, 3) within the cube from -1 to 1, scaled (3,) to metres
    afterwards: PhysX merges vertices that are near in its units.
    """
    size = (LENGTH_SCALE * np.asarray(scale)).astype(np.float32)
    return px.PhysxCollisionShapeConvexMesh(vertices.astype(np.float32), size, surface)


@functools.cache
def _unit_prism() -> np.ndarray:
    """Vertices (2 * sides, 3) of a prism of radius 1 and half length 1 along z."""
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    ring = np.stack([np.cos(angle), np.sin(angle)], 1)
    bottom = np.pad(ring, ((0, 0), (0, 1)), constant_values=-1.0)
    top = np.pad(ring, ((0, 0), (0, 1)), constant_values=1.0)
    return np.concatenate([bottom, top])


@functools.cache
def _unit_sphere() -> np.ndarray:
    """Vertices (V, 3) of a polyhedron with the volume of the unit sphere, along a spiral."""
    turns = np.pi * (1 + np.sqrt(5)) * (np.arange(_SPHERE_POINTS) + 0.5)
    z = 1 - 2 * (np.arange(_SPHERE_POINTS) + 0.5) / _SPHERE_POINTS
    radius = np.sqrt(1 - z * z)
    vertices = np.stack([radius * np.cos(turns), radius * np.sin(turns), z], 1)
    return vertices * np.cbrt(4 / 3 * np.pi / ConvexHull(vertices).volume)
