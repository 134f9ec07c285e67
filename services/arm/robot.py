"""Arm, hand, table and object as one MuJoCo model in the frame of the arm's base."""

import dataclasses

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.hands.mjcf import WRIST_JOINTS, add_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.mjcf import add_object
from congrasp.common.objects.spec import GraspObject
from congrasp.services.arm.description import Arm
from congrasp.services.viz.shapes import upright

_HAND = "hand/"
_TABLE, _OBJECT = "grasp_table", "grasp_object"
_ARM_BIT, _SCENE_BIT, _HAND_BIT = 1, 2, 4
_NEIGHBOURS = 3  # joints between two bodies, below which their housings may overlap


class Infeasible(Exception):
    """The arm cannot follow a path; the message names the violated limit."""


@dataclasses.dataclass(frozen=True)
class Pose:
    """A rigid transform."""

    position: np.ndarray
    """(3,) m."""
    rotation: Rotation


@dataclasses.dataclass(frozen=True, eq=False)
class Robot:
    """A compiled robot of N arm joints and F finger joints."""

    arm: Arm
    model: mujoco.MjModel
    joints: np.ndarray
    """(N,) addresses of the arm's joints in `qpos`; they have the same ones in `qvel`."""
    fingers: np.ndarray
    """(F,) addresses of the hand's joints."""
    palm: str
    """Name of the body with the wrist frame."""

    def place(self, data: mujoco.MjData, q: np.ndarray, position: np.ndarray, quaternion: np.ndarray, height: float):
        """Moves everything in `data`: joints (Q,), the object's pose in the base's frame, the table's height (m)."""
        data.qpos[:] = q
        for name, at, turn in ((_OBJECT, position, quaternion), (_TABLE, [0.0, 0.0, height], [1.0, 0, 0, 0])):
            mocap = self.model.body(name).mocapid[0]
            data.mocap_pos[mocap], data.mocap_quat[mocap] = at, turn
        mujoco.mj_kinematics(self.model, data)

    def collision(self, data: mujoco.MjData) -> str:
        """Describes the pair of overlapping bodies; empty if there is none."""
        mujoco.mj_collision(self.model, data)
        deep = np.flatnonzero(data.contact.dist < 0.0)
        if not len(deep):
            return ""
        return " with ".join(sorted((self._called(int(g)) for g in data.contact.geom[deep[0]]), key=_scene_last))

    def _called(self, geom: int) -> str:
        """Describes the body of a geom."""
        name = self.model.body(self.model.geom_bodyid[geom]).name
        if name in (_TABLE, _OBJECT):
            return {_TABLE: "the table", _OBJECT: "the object"}[name]
        return "the hand" if name.startswith(_HAND) else "the base" if name == "world" else name

    @property
    def links(self) -> list[int]:
        """Bodies of the arm, the base first."""
        names = [self.model.body(i).name for i in range(self.model.nbody)]
        return [i for i, name in enumerate(names) if name not in (_TABLE, _OBJECT) and not name.startswith(_HAND)]


def _scene_last(name: str) -> bool:
    """True for table and object."""
    return name in ("the table", "the object")


def default_mount(hand: Hand) -> Pose:
    """The fingers along the flange's z axis, the palm towards its x axis, and the palm's near end at the flange."""
    turn = upright(hand)
    palm = hand.capsule_links == 0
    ends = turn.apply(hand.capsules[palm].reshape(-1, 3))[:, 2] - np.repeat(hand.capsule_radii[palm], 2)
    return Pose(np.array([0.0, 0.0, -float(ends.min())]), turn)


def build_robot(arm: Arm, hand: Hand, mount: Pose, obj: GraspObject) -> Robot:
    """Compiles arm, hand, table and object.

    Args:
      arm: the arm.
      hand: the hand.
      mount: pose of the wrist frame in the flange's.
      obj: the object; the model's is moved like the table, by mocap.
    """
    spec = arm.spec.copy()
    depths = _depths(spec, arm)
    solid = any(geom.contype | geom.conaffinity for geom in spec.geoms)
    for geom in spec.geoms:
        collides = geom.contype | geom.conaffinity if solid else True
        geom.contype, geom.conaffinity = (_ARM_BIT, 7) if collides else (0, 0)
        geom.margin = 0.0
    carrier = spec.body(arm.flange)
    turn = Rotation.from_quat(arm.quaternion, scalar_first=True)
    quaternion = (turn * mount.rotation).as_quat(scalar_first=True)
    frame = carrier.add_frame(pos=arm.position + turn.apply(mount.position), quat=quaternion)
    frame.attach_body(_hand_spec(hand).body("hand_base"), _HAND, "")
    depths |= {body.name: depths[arm.flange] for body in spec.bodies if body.name.startswith(_HAND)}
    table = spec.worldbody.add_body(name=_TABLE, mocap=True)
    table.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(2.0, 2.0, 0.1), contype=_SCENE_BIT, conaffinity=0)
    body = add_object(spec, obj, _OBJECT, contype=_SCENE_BIT, conaffinity=0)
    for joint in list(body.joints):
        spec.delete(joint)
    body.mocap = True
    names = sorted(depths)
    for i, first in enumerate(names):
        if depths[first] < 2:  # the base stands on the table
            spec.add_exclude(bodyname1=first, bodyname2=_TABLE)
        for second in names[i + 1 :]:
            if abs(depths[first] - depths[second]) < _NEIGHBOURS:
                spec.add_exclude(bodyname1=first, bodyname2=second)
    spec.compiler.boundmass, spec.compiler.boundinertia = 1e-3, 1e-7
    model = spec.compile()
    joints = np.array([model.joint(name).qposadr[0] for name in arm.joints])
    fingers = np.array([model.joint(_HAND + joint.name).qposadr[0] for joint in hand.joints])
    return Robot(arm, model, joints, fingers, _HAND + hand.links[0].name)


def _hand_spec(hand: Hand) -> mujoco.MjSpec:
    """Returns only the hand's bodies and finger joints."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False  # of its own, whatever the arm's is
    add_hand(spec, hand)
    for group in (spec.actuators, spec.equalities, spec.tendons, spec.excludes):
        for element in list(group):
            spec.delete(element)
    for name in WRIST_JOINTS:
        spec.delete(spec.joint(name))
    for geom in spec.geoms:
        geom.contype, geom.conaffinity = _HAND_BIT, 0
    return spec


def _depths(spec: mujoco.MjSpec, arm: Arm) -> dict[str, int]:
    """Number of joints between the base and each body."""
    found = {"world": 0}
    for body in spec.bodies:
        if body.name != "world":
            found[body.name] = found[body.parent.name] + sum(joint.name in arm.joints for joint in body.joints)
    return found
