"""A hand as MuJoCo bodies: virtual wrist, links with capsules or solids, and position actuators."""

import functools
from typing import Any

import numpy as np

from congrasp.common.hands.spec import CONTACT_TIME, Capsule, Hand, Link, Solid, link_origin
from congrasp.common.objects import shapes
from congrasp.common.objects.mjcf import GEOM_TYPES
from congrasp.common.objects.spec import Piece
from congrasp.common.runtime.mujoco import mujoco

HAND_CONTYPE = 1
"""Collision bit of the hand: geoms that collide with it have this bit in their conaffinity."""
_COUPLING_TIME = 0.005  # time constant of joint couplings, s
WRIST_JOINTS = ("wrist_x", "wrist_y", "wrist_z", "wrist_rx", "wrist_ry", "wrist_rz")


def add_hand(
    spec: mujoco.MjSpec,
    hand: Hand,
    *,
    self_collision: bool = False,
    contact_time: float = CONTACT_TIME,
    torsional_friction: float = 0.0,
) -> mujoco.MjsBody:
    """Adds the hand under a fixed body `hand_base` and returns that body.

    The base carries three slides (x, y, z) and three hinges (intrinsic x-y-z) of the first link;
    their origin is the initial wrist pose, so that all six start at zero. The actuators are those
    of the wrist's joints, then the motors. Gravity on the hand is compensated, because the wrist is
    a virtual mount.

    With `self_collision`, links collide without friction, except neighbours and `overlapping`
    pairs. All contacts of the hand have the time constant `contact_time` in seconds. Contacts of
    fingertips have the torsional friction `torsional_friction` in metres.
    """
    base = spec.worldbody.add_body(name="hand_base")
    bodies: dict[str, mujoco.MjsBody] = {}
    for link in hand.links:
        parent = bodies[link.parent] if link.parent else base
        parent_origin = np.array(
            link_origin(next(x for x in hand.links if x.name == link.parent)) if link.parent else 0
        )
        origin = np.array(link_origin(link))
        body = parent.add_body(name=link.name, pos=origin - parent_origin, gravcomp=1.0)
        bodies[link.name] = body
        if not link.parent:
            _add_wrist(spec, body, hand)
        for joint in link.joints:
            body.add_joint(
                name=joint.name,
                type=mujoco.mjtJoint.mjJNT_HINGE,
                axis=joint.axis,
                pos=np.array(joint.anchor) - origin,
                range=(joint.lower, joint.upper),
                limited=mujoco.mjtLimited.mjLIMITED_TRUE,
                damping=joint.damping,
                armature=joint.armature,
            )
        _add_shapes(
            body,
            link,
            origin,
            self_collision,
            contact_time,
            torsional_friction if link.tip else 0.0,
        )
    _add_transmission(spec, hand)
    if self_collision:
        for first, second in overlapping(hand):
            spec.add_exclude(bodyname1=first, bodyname2=second)
    return base


@functools.cache
def _alone(hand: Hand) -> mujoco.MjModel:
    """A model of the hand only, with its wrist at the origin."""
    spec = mujoco.MjSpec()
    add_hand(spec, hand)
    return spec.compile()


def posed(hand: Hand, q: np.ndarray) -> mujoco.MjData:
    """Bodies and joints of the hand at finger angles (F,) rad, with its wrist at the origin.

    `kinematics.link_poses` computes the same for batches in JAX; this needs no JAX backend.
    """
    data = mujoco.MjData(_alone(hand))
    for joint, angle in zip(hand.joints, q, strict=True):
        data.joint(joint.name).qpos[0] = angle
    mujoco.mj_kinematics(data.model, data)
    return data


def mujoco_link_poses(hand: Hand, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins (L, 3) and orientations (L, 4) of the links' frames in the wrist frame, at finger
    angles (F,) rad.
    """
    data = posed(hand, q)
    bodies = [data.body(link.name).id for link in hand.links]
    return data.xpos[bodies], data.xquat[bodies]


@functools.cache
def overlapping(hand: Hand) -> tuple[tuple[str, str], ...]:
    """Pairs of links whose shapes overlap in the open pose or at zero; their contacts are excluded.

    They represent housings that nest at the knuckles. Pairs that touch only in a fist are not
    included.
    """
    spec = mujoco.MjSpec()
    bodies: dict[str, mujoco.MjsBody] = {}
    for link in hand.links:
        parent = bodies[link.parent] if link.parent else spec.worldbody
        bodies[link.name] = body = parent.add_body(name=link.name)
        if not link.parent:
            body.add_freejoint()
        for joint in link.joints:
            body.add_joint(name=joint.name, axis=joint.axis, pos=joint.anchor)
        _add_shapes(body, link, np.zeros(3), True, CONTACT_TIME, 0.0)
    model = spec.compile()
    data = mujoco.MjData(model)
    found: set[tuple[int, int]] = set()
    for q in (hand.q_open, np.clip(0.0, hand.lower, hand.upper)):
        data.qpos[7:] = q
        mujoco.mj_forward(model, data)
        touching = data.contact.geom[data.contact.dist < 0]
        found |= {tuple(pair) for pair in np.sort(model.geom_bodyid[touching], axis=-1).tolist()}
    return tuple((model.body(a).name, model.body(b).name) for a, b in sorted(found))


def _add_wrist(spec: mujoco.MjSpec, body: mujoco.MjsBody, hand: Hand) -> None:
    """Adds the six joints of the virtual wrist with their actuators."""
    gains = hand.wrist
    for i, name in enumerate(WRIST_JOINTS):
        slide = i < 3
        body.add_joint(
            name=name,
            type=mujoco.mjtJoint.mjJNT_SLIDE if slide else mujoco.mjtJoint.mjJNT_HINGE,
            axis=np.eye(3)[i % 3],
            armature=gains.slide_armature if slide else gains.hinge_armature,
        )
        _add_position_actuator(
            spec,
            name,
            mujoco.mjtTrn.mjTRN_JOINT,
            gains.slide_kp if slide else gains.hinge_kp,
            gains.slide_kv if slide else gains.hinge_kv,
            gains.slide_limit if slide else gains.hinge_limit,
        )


def _add_transmission(spec: mujoco.MjSpec, hand: Hand) -> None:
    """Adds motors, tendons that pull several joints, and couplings of joints."""
    for motor in hand.motors:
        alone = motor.joints == {motor.name: 1.0}
        if not alone:
            tendon = spec.add_tendon(name=motor.name)
            for joint, coefficient in motor.joints.items():
                tendon.wrap_joint(joint, coefficient)
        kind = mujoco.mjtTrn.mjTRN_JOINT if alone else mujoco.mjtTrn.mjTRN_TENDON
        _add_position_actuator(spec, motor.name, kind, motor.kp, motor.kv, motor.torque_limit)
    for coupling in hand.couplings:
        spec.add_equality(
            name=coupling.joint,
            type=mujoco.mjtEq.mjEQ_JOINT,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            name1=coupling.joint,
            name2=coupling.leader,
            data=[coupling.offset, coupling.ratio, *[0.0] * 10],
            solref=(_COUPLING_TIME, 1.0),
            solimp=(0.99, 0.99, 0.001, 0.5, 2.0),
        )


def _add_position_actuator(
    spec: mujoco.MjSpec, name: str, kind: mujoco.mjtTrn, kp: float, kv: float, limit: float
) -> None:
    """Adds a position servo for the joint or tendon of this name, with this force limit."""
    actuator = spec.add_actuator(
        name=name,
        target=name,
        trntype=kind,
        forcerange=(-limit, limit),
        forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
    )
    actuator.set_to_position(kp, kv=kv)


def _add_shapes(
    body: mujoco.MjsBody,
    link: Link,
    origin: np.ndarray,
    self_collision: bool,
    contact_time: float,
    torsion: float,
) -> None:
    """Adds a link's solids, or its capsules if it has none; they share its mass by volume."""
    found = [_solid(solid, origin) for solid in link.solids] or [
        _capsule(x, origin) for x in link.capsules
    ]
    volumes = np.array([volume for _, volume in found])
    for i, ((fields, _), share) in enumerate(zip(found, volumes / volumes.sum(), strict=True)):
        body.add_geom(
            name=f"{link.name}_{i}",
            **fields,
            mass=link.mass * share,
            contype=HAND_CONTYPE,
            conaffinity=HAND_CONTYPE if self_collision else 0,
            condim=4
            if torsion
            else 1,  # the greater of the two decides: 1 between links, 3 against the object
            solref=(contact_time, 1.0),
            solmix=1000.0,  # against 1 of other geoms, so that it decides
            # MuJoCo uses the greater of two: the object's sliding friction decides
            friction=(
                0.1,
                torsion,
                0.0,
            ),
        )


def _capsule(capsule: Capsule, origin: np.ndarray) -> tuple[dict[str, Any], float]:
    """Returns the geom of a capsule in a frame at `origin` (3,), and its volume over pi in m^3."""
    ends = np.concatenate([np.subtract(capsule.start, origin), np.subtract(capsule.end, origin)])
    length = np.linalg.norm(np.subtract(capsule.end, capsule.start)) + 4 / 3 * capsule.radius
    fields = {
        "type": mujoco.mjtGeom.mjGEOM_CAPSULE,
        "fromto": ends,
        "size": (capsule.radius, 0.0, 0.0),
    }
    return fields, float(length * capsule.radius**2)


def _solid(solid: Solid, origin: np.ndarray) -> tuple[dict[str, Any], float]:
    """Returns the geom of a solid in a frame at `origin` (3,), and its volume in m^3."""
    place = {"pos": np.subtract(solid.position, origin), "quat": solid.quaternion}
    fields = {"type": GEOM_TYPES[solid.kind], "size": solid.size}
    if solid.kind == "ellipsoid" and len({*solid.size}) == 1:
        fields = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": (solid.size[0], 0.0, 0.0)}
    return fields | place, shapes.volume(Piece(solid.kind, solid.size))
