"""Arm, hand, table and object as one MuJoCo model in the frame of the arm's base."""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.hands.mjcf import WRIST_JOINTS, add_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.mjcf import add_object
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.physics_library import mujoco
from congrasp.services.arm.description import Arm
from congrasp.services.viz.hand_shapes import upright

_HAND = "hand/"
_TABLE = "grasp_table"
_OBJECT = "grasp_object"
_SCENE = {_TABLE: "the table", _OBJECT: "the object"}
"""Descriptions of the bodies that are neither of the arm nor of the hand."""
_ARM_BIT = 1
_SCENE_BIT = 2
_HAND_BIT = 4
"""Bits of `contype` and `conaffinity`: the arm collides with itself, the scene and the hand."""
_NEIGHBOUR_JOINTS = 3  # bodies that are fewer joints apart may overlap: their housings do
_TABLE_JOINTS = 2  # bodies that are fewer joints from the base may overlap the table under it
_MIN_MASS = 1e-3  # kg
_MIN_INERTIA = 1e-7  # kg m^2


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

    def place(
        self,
        data: mujoco.MjData,
        q: np.ndarray,
        position: np.ndarray,
        quaternion: np.ndarray,
        height: float,
    ) -> None:
        """Moves joints, object and table in `data`, and computes the poses of all bodies.

        Args:
          data: data of the model.
          q: (Q,) positions of all joints.
          position: (3,) position of the object in the frame of the base, m.
          quaternion: (4,) orientation of the object, w x y z.
          height: height of the table, m.
        """
        data.qpos[:] = q
        obj = self.model.body(_OBJECT).mocapid[0]
        data.mocap_pos[obj] = position
        data.mocap_quat[obj] = quaternion
        table = self.model.body(_TABLE).mocapid[0]
        data.mocap_pos[table] = [0.0, 0.0, height]
        data.mocap_quat[table] = [1.0, 0.0, 0.0, 0.0]
        mujoco.mj_kinematics(self.model, data)

    def collision(self, data: mujoco.MjData) -> str:
        """Describes a pair of overlapping bodies, after `place`; empty if there is none."""
        mujoco.mj_collision(self.model, data)
        overlaps = np.flatnonzero(data.contact.dist < 0.0)
        if not len(overlaps):
            return ""
        first, second = data.contact.geom[overlaps[0]]
        pair = [self._description(int(first)), self._description(int(second))]
        pair.sort(key=lambda name: name in _SCENE.values())  # table and object are named last
        return " with ".join(pair)

    def _description(self, geom: int) -> str:
        """Describes the body of a geom."""
        name = self.model.body(self.model.geom_bodyid[geom]).name
        if name in _SCENE:
            return _SCENE[name]
        if name.startswith(_HAND):
            return "the hand"
        if name == "world":
            return "the base"
        return name

    @property
    def links(self) -> list[int]:
        """Bodies of the arm, the base first."""
        links = []
        for body in range(self.model.nbody):
            name = self.model.body(body).name
            if name not in _SCENE and not name.startswith(_HAND):
                links.append(body)
        return links

    @property
    def reach(self) -> float:
        """Upper bound on the distance of a point of arm and hand from the base, m."""
        model = self.model
        extents = np.linalg.norm(model.geom_pos, axis=1) + model.geom_rbound
        of_robot = [model.body(body).name not in _SCENE for body in model.geom_bodyid]
        return float((self._body_reaches()[model.geom_bodyid] + extents)[of_robot].max())

    @property
    def wrist_reach(self) -> float:
        """Upper bound on the distance of the wrist frame from the base, m."""
        return float(self._body_reaches()[self.model.body(self.palm).id])

    def _body_reaches(self) -> np.ndarray:
        """Upper bounds (bodies,) on the distance of each body's frame from the base, m: the offsets
        of the bodies and joints, added up as if all of them were stretched out in one line; 0 for
        the table and the object.
        """
        model = self.model
        lengths = np.linalg.norm(model.body_pos, axis=1)
        for joint in range(model.njnt):
            body = model.jnt_bodyid[joint]
            lengths[body] += 2.0 * np.linalg.norm(model.jnt_pos[joint])
            if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
                limits = model.jnt_range[joint] if model.jnt_limited[joint] else np.inf
                lengths[body] += np.abs(limits).max()
        reaches = np.zeros(model.nbody)
        for body in range(1, model.nbody):
            if model.body(body).name not in _SCENE:
                reaches[body] = reaches[model.body_parentid[body]] + lengths[body]
        return reaches


def default_mount(hand: Hand) -> Pose:
    """The fingers along the flange's z axis, the palm towards its x axis, and the palm's near end
    at the flange.
    """
    turn = upright(hand)
    palm = hand.capsule_links == 0
    heights = turn.apply(hand.capsules[palm].reshape(-1, 3))[:, 2]
    lower_ends = heights - np.repeat(hand.capsule_radii[palm], 2)
    return Pose(np.array([0.0, 0.0, -float(lower_ends.min())]), turn)


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
    _set_arm_collisions(spec)
    _attach_hand(spec, arm, hand, mount)
    for body in spec.bodies:
        if body.name.startswith(_HAND):
            depths[body.name] = depths[arm.flange]
    _add_scene(spec, obj)
    _exclude_neighbours(spec, depths)
    spec.compiler.boundmass = _MIN_MASS
    spec.compiler.boundinertia = _MIN_INERTIA
    model = spec.compile()
    joints = [model.joint(name).qposadr[0] for name in arm.joints]
    fingers = [model.joint(_HAND + joint.name).qposadr[0] for joint in hand.joints]
    return Robot(
        arm=arm,
        model=model,
        joints=np.array(joints),
        fingers=np.array(fingers),
        palm=_HAND + hand.links[0].name,
    )


def _depths(spec: mujoco.MjSpec, arm: Arm) -> dict[str, int]:
    """Number of the arm's joints between the base and each body."""
    depths = {"world": 0}
    for body in spec.bodies:
        if body.name == "world":
            continue
        joints = [joint for joint in body.joints if joint.name in arm.joints]
        depths[body.name] = depths[body.parent.name] + len(joints)
    return depths


def _set_arm_collisions(spec: mujoco.MjSpec) -> None:
    """Makes the arm's collision geoms collide with everything; if it has none, all of its geoms."""
    has_collision_geoms = any(geom.contype | geom.conaffinity for geom in spec.geoms)
    for geom in spec.geoms:
        if geom.contype | geom.conaffinity or not has_collision_geoms:
            geom.contype = _ARM_BIT
            geom.conaffinity = _ARM_BIT | _SCENE_BIT | _HAND_BIT
        geom.margin = 0.0


def _attach_hand(spec: mujoco.MjSpec, arm: Arm, hand: Hand, mount: Pose) -> None:
    """Attaches the hand's wrist frame to the flange."""
    flange = Rotation.from_quat(arm.quaternion, scalar_first=True)
    position = arm.position + flange.apply(mount.position)
    quaternion = (flange * mount.rotation).as_quat(scalar_first=True)
    frame = spec.body(arm.flange).add_frame(pos=position, quat=quaternion)
    frame.attach_body(_hand_spec(hand).body("hand_base"), _HAND, "")


def _hand_spec(hand: Hand) -> mujoco.MjSpec:
    """Returns the hand's bodies and finger joints, without anything else."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False  # the arm may have another unit of angles
    add_hand(spec, hand)
    for group in (spec.actuators, spec.equalities, spec.tendons, spec.excludes):
        for element in list(group):
            spec.delete(element)
    for name in WRIST_JOINTS:
        spec.delete(spec.joint(name))
    for geom in spec.geoms:
        geom.contype = _HAND_BIT
        geom.conaffinity = 0
    return spec


def _add_scene(spec: mujoco.MjSpec, obj: GraspObject) -> None:
    """Adds the table and the object, which collide with the arm only."""
    table = spec.worldbody.add_body(name=_TABLE, mocap=True)
    table.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(2.0, 2.0, 0.1),
        contype=_SCENE_BIT,
        conaffinity=0,
    )
    body = add_object(spec, obj, _OBJECT, contype=_SCENE_BIT, conaffinity=0)
    for joint in list(body.joints):
        spec.delete(joint)
    body.mocap = True


def _exclude_neighbours(spec: mujoco.MjSpec, depths: dict[str, int]) -> None:
    """Excludes collisions of bodies that are few joints apart, and of the base with the table."""
    names = sorted(depths)
    for i, first in enumerate(names):
        if depths[first] < _TABLE_JOINTS:
            spec.add_exclude(bodyname1=first, bodyname2=_TABLE)
        for second in names[i + 1 :]:
            if abs(depths[first] - depths[second]) < _NEIGHBOUR_JOINTS:
                spec.add_exclude(bodyname1=first, bodyname2=second)
