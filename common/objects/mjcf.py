"""An object as a free body of a MuJoCo model, and the contact settings shared by all scenes."""

import dataclasses

import numpy as np

from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.mujoco import mujoco


@dataclasses.dataclass(frozen=True)
class ContactSettings:
    """Contact parameters of hand, object and table.

    Contacts have three dimensions, without torsional or rolling friction, except those of
    fingertips (`common.hands.mjcf`). The damping of the object's free joint stops a rolling ball:
    it acts the same way in every engine and costs nothing.
    """

    friction: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """Sliding (dimensionless), torsional (m) and rolling (m) friction."""
    condim: int = 3
    """Dimensions of a contact (condim)."""
    solref: tuple[float, float] = (0.012, 1.0)
    """Time constant (s) and damping ratio of the contact's spring."""
    solimp: tuple[float, float, float, float, float] = (0.9, 0.95, 0.001, 0.5, 2.0)
    """Impedance: MuJoCo's default."""
    free_damping: float = 5e-4
    """Damping of the object's free joint: N.s/m along its axes and N.m.s/rad about them."""
    timestep: float = 0.0025
    """Seconds of one physics step."""


CONTACT = ContactSettings()
GEOM_TYPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    "mesh": mujoco.mjtGeom.mjGEOM_MESH,
}


def add_object(
    spec: mujoco.MjSpec,
    obj: GraspObject,
    name: str = "object",
    *,
    contype: int = 1,
    conaffinity: int = 1,
    contact: ContactSettings = CONTACT,
) -> mujoco.MjsBody:
    """Adds the object's body, with a free joint, its inertia and its collision geoms, to a model
    under construction.

    The body's frame is the object frame, whose origin is the centre of mass. The joint is named
    `<name>`, the geoms and their meshes (made from vertices, without files) `<name>_<i>` in the
    order of `obj.pieces`. The free joint's six damping values can be changed in the compiled model.

    Args:
      spec: the model.
      obj: the object.
      name: name of the body.
      contype: contype of the geoms.
      conaffinity: conaffinity of the geoms.
      contact: contact settings.

    Returns:
      The new body, a child of the world body.
    """
    body = spec.worldbody.add_body(name=name, mass=obj.mass, ipos=[0, 0, 0], explicitinertial=True)
    i = obj.inertia
    body.fullinertia = [i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]]
    body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_FREE, damping=[contact.free_damping, 0, 0])
    for index, piece in enumerate(obj.pieces):
        geom_name = f"{name}_{index}"
        geom = body.add_geom(
            name=geom_name,
            type=GEOM_TYPES[piece.kind],
            pos=piece.pos,
            quat=piece.quat,
            contype=contype,
            conaffinity=conaffinity,
            friction=contact.friction,
            condim=contact.condim,
            solref=contact.solref,
            solimp=contact.solimp,
            mass=0.0,
        )
        if piece.vertices is None:
            geom.size = piece.size
        else:
            spec.add_mesh(name=geom_name, uservert=np.asarray(piece.vertices, np.float32).ravel())
            geom.meshname = geom_name
    return body
