"""A hand as MuJoCo bodies: virtual wrist, links with capsules or solids, and position actuators."""

import functools
from typing import Any, NamedTuple

import numpy as np

from congrasp.common.hands.spec import CONTACT_TIME_S, Capsule, Hand, Link, Solid, link_origin
from congrasp.common.objects import shapes
from congrasp.common.objects.mjcf import GEOM_TYPES
from congrasp.common.objects.spec import Piece
from congrasp.common.runtime.physics_library import mujoco

HAND_CONTYPE = 1
"""Collision bit of the hand: geoms that collide with it have this bit in their conaffinity."""
_COUPLING_TIME_S = 0.005
"""Time constant of joint couplings, s."""
_SLIDING_FRICTION = 0.1
"""Of the hand; MuJoCo uses the greater of two, so that the object's decides."""
_SOLVER_WEIGHT = 1000.0
"""Weight of the hand's solver parameters, against 1 of other geoms, so that they decide."""
_NO_FRICTION = 1
_TORSIONAL_FRICTION = 4
WRIST_JOINTS = ("wrist_x", "wrist_y", "wrist_z", "wrist_rx", "wrist_ry", "wrist_rz")


class _Contacts(NamedTuple):
    """Contacts of a link."""

    with_hand: bool
    """True if it collides with other links."""
    time: float
    """Time constant, s."""
    torsional_friction: float
    """m; 0 is a link without."""


def add_hand(
    spec: mujoco.MjSpec,
    hand: Hand,
    *,
    self_collision: bool = False,
    contact_time: float = CONTACT_TIME_S,
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
    bodies = {"": base}
    origins = {"": np.zeros(3)}
    for link in hand.links:
        origin = np.array(link_origin(link))
        offset = origin - origins[link.parent]
        body = bodies[link.parent].add_body(name=link.name, pos=offset, gravcomp=1.0)
        bodies[link.name] = body
        origins[link.name] = origin
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
        contacts = _Contacts(
            with_hand=self_collision,
            time=contact_time,
            torsional_friction=torsional_friction if link.tip else 0.0,
        )
        _add_shapes(body, link, origin, contacts)
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
    contacts = _Contacts(with_hand=True, time=CONTACT_TIME_S, torsional_friction=0.0)
    for link in hand.links:
        parent = bodies[link.parent] if link.parent else spec.worldbody
        body = parent.add_body(name=link.name)
        bodies[link.name] = body
        if not link.parent:
            body.add_freejoint()
        for joint in link.joints:
            body.add_joint(name=joint.name, axis=joint.axis, pos=joint.anchor)
        _add_shapes(body, link, np.zeros(3), contacts)
    model = spec.compile()
    data = mujoco.MjData(model)
    pairs: set[tuple[int, int]] = set()
    for q in (hand.q_open, np.clip(0.0, hand.lower, hand.upper)):
        data.qpos[7:] = q
        mujoco.mj_forward(model, data)
        touching_geoms = data.contact.geom[data.contact.dist < 0]
        touching_bodies = np.sort(model.geom_bodyid[touching_geoms], axis=-1)
        pairs |= {(first, second) for first, second in touching_bodies.tolist()}
    return tuple(
        (model.body(first).name, model.body(second).name) for first, second in sorted(pairs)
    )


def _add_wrist(spec: mujoco.MjSpec, body: mujoco.MjsBody, hand: Hand) -> None:
    """Adds the six joints of the virtual wrist with their actuators."""
    gains = hand.wrist
    joint = mujoco.mjtTrn.mjTRN_JOINT
    slide = _Servo(joint, gains.slide_kp, gains.slide_kv, gains.slide_limit)
    hinge = _Servo(joint, gains.hinge_kp, gains.hinge_kv, gains.hinge_limit)
    slides = WRIST_JOINTS[:3]
    hinges = WRIST_JOINTS[3:]
    for axis, name in zip(np.eye(3), slides, strict=True):
        kind = mujoco.mjtJoint.mjJNT_SLIDE
        body.add_joint(name=name, type=kind, axis=axis, armature=gains.slide_armature)
        _add_servo(spec, name, slide)
    for axis, name in zip(np.eye(3), hinges, strict=True):
        kind = mujoco.mjtJoint.mjJNT_HINGE
        body.add_joint(name=name, type=kind, axis=axis, armature=gains.hinge_armature)
        _add_servo(spec, name, hinge)


def _add_transmission(spec: mujoco.MjSpec, hand: Hand) -> None:
    """Adds motors, tendons that pull several joints, and couplings of joints."""
    for motor in hand.motors:
        moves_one_joint = motor.joints == {motor.name: 1.0}
        if not moves_one_joint:
            tendon = spec.add_tendon(name=motor.name)
            for joint, coefficient in motor.joints.items():
                tendon.wrap_joint(joint, coefficient)
        kind = mujoco.mjtTrn.mjTRN_JOINT if moves_one_joint else mujoco.mjtTrn.mjTRN_TENDON
        _add_servo(spec, motor.name, _Servo(kind, motor.kp, motor.kv, motor.torque_limit))
    for coupling in hand.couplings:
        spec.add_equality(
            name=coupling.joint,
            type=mujoco.mjtEq.mjEQ_JOINT,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            name1=coupling.joint,
            name2=coupling.leader,
            data=[coupling.offset, coupling.ratio, *[0.0] * 10],
            solref=(_COUPLING_TIME_S, 1.0),
            solimp=(0.99, 0.99, 0.001, 0.5, 2.0),
        )


class _Servo(NamedTuple):
    """A position servo, with gains in SI units of its joint or tendon."""

    kind: mujoco.mjtTrn
    """Type of the transmission: a joint or a tendon."""
    kp: float
    kv: float
    limit: float
    """Greatest force or torque."""


def _add_servo(spec: mujoco.MjSpec, name: str, servo: _Servo) -> None:
    """Adds a position servo for the joint or tendon of this name."""
    actuator = spec.add_actuator(
        name=name,
        target=name,
        trntype=servo.kind,
        forcerange=(-servo.limit, servo.limit),
        forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
    )
    actuator.set_to_position(servo.kp, kv=servo.kv)


def _add_shapes(body: mujoco.MjsBody, link: Link, origin: np.ndarray, contacts: _Contacts) -> None:
    """Adds a link's solids, or its capsules if it has none; they share its mass by volume.

    Args:
      body: body of the link.
      link: the link.
      origin: (3,) of the body's frame.
      contacts: contacts of the link.
    """
    if link.solids:
        shapes_of_link = [_solid(solid, origin) for solid in link.solids]
    else:
        shapes_of_link = [_capsule(capsule, origin) for capsule in link.capsules]
    volumes = np.array([volume for _, volume in shapes_of_link])
    shares = volumes / volumes.sum()
    # The greater condim of two geoms decides: 1 between links, 3 or more with the object
    condim = _TORSIONAL_FRICTION if contacts.torsional_friction else _NO_FRICTION
    for i, (fields, _) in enumerate(shapes_of_link):
        body.add_geom(
            name=f"{link.name}_{i}",
            **fields,
            mass=link.mass * shares[i],
            contype=HAND_CONTYPE,
            conaffinity=HAND_CONTYPE if contacts.with_hand else 0,
            condim=condim,
            solref=(contacts.time, 1.0),
            solmix=_SOLVER_WEIGHT,
            friction=(_SLIDING_FRICTION, contacts.torsional_friction, 0.0),
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
