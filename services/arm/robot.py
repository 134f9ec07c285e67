"""Arm, hand, table and object as one MuJoCo model in the frame of the arm's base."""

import dataclasses
from collections.abc import Collection
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from congrasp.common.hands.mjcf import WRIST_JOINTS, add_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.mjcf import add_object
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.physics_library import mujoco
from congrasp.services.arm.description import Arm
from congrasp.services.assets.hands.link_geometry import geom_mesh
from congrasp.services.record.episode import UNLIMITED, MovedArm
from congrasp.services.viz.hand_shapes import upright

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

    def place(
        self,
        data: mujoco.MjData,
        q: np.ndarray,
        position: np.ndarray,
        quaternion: np.ndarray,
        height: float,
    ):
        """Moves everything in `data`: joints (Q,), the object's pose in the base's frame, the
        table's height (m).
        """
        data.qpos[:] = q
        for name, at, turn in (
            (_OBJECT, position, quaternion),
            (_TABLE, [0.0, 0.0, height], [1.0, 0, 0, 0]),
        ):
            mocap = self.model.body(name).mocapid[0]
            data.mocap_pos[mocap], data.mocap_quat[mocap] = at, turn
        mujoco.mj_kinematics(self.model, data)

    def collision(self, data: mujoco.MjData) -> str:
        """Describes the pair of overlapping bodies; empty if there is none."""
        mujoco.mj_collision(self.model, data)
        deep = np.flatnonzero(data.contact.dist < 0.0)
        if not len(deep):
            return ""
        scene = ("the table", "the object")  # named last
        return " with ".join(
            sorted(
                (self._called(int(g)) for g in data.contact.geom[deep[0]]), key=scene.__contains__
            )
        )

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
        return [
            i
            for i, name in enumerate(names)
            if name not in (_TABLE, _OBJECT) and not name.startswith(_HAND)
        ]


def default_mount(hand: Hand) -> Pose:
    """The fingers along the flange's z axis, the palm towards its x axis, and the palm's near end
    at the flange.
    """
    turn = upright(hand)
    palm = hand.capsule_links == 0
    ends = turn.apply(hand.capsules[palm].reshape(-1, 3))[:, 2] - np.repeat(
        hand.capsule_radii[palm], 2
    )
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
    table.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=(2.0, 2.0, 0.1), contype=_SCENE_BIT, conaffinity=0
    )
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
            found[body.name] = found[body.parent.name] + sum(
                joint.name in arm.joints for joint in body.joints
            )
    return found


_FLAT = 1e-12  # twice the area of triangles that are left out, m^2
_BARE = 0.02  # radius of the balls that stand for the links of an arm without geometry, m


def moved_arm(
    robot: Robot, q: np.ndarray, base: Pose, mount: Pose, taken: Collection[str]
) -> MovedArm:
    """Returns the arm's links along a motion.

    Args:
      robot: the robot.
      q: (T, N) joints of the arm.
      base: pose of its base in the world.
      mount: pose of the wrist frame in the flange's.
      taken: names that links must not have.
    """
    model, arm = robot.model, robot.arm
    data = mujoco.MjData(model)
    links = robot.links
    position, quaternion = np.zeros((len(q), len(links), 3)), np.zeros((len(q), len(links), 4))
    for t, row in enumerate(q):
        data.qpos[robot.joints] = row
        mujoco.mj_kinematics(model, data)
        position[t], quaternion[t] = data.xpos[links], data.xquat[links]
    turns = base.rotation * Rotation.from_quat(quaternion.reshape(-1, 4), scalar_first=True)
    names = [f"{arm.name}_base", *(model.body(body).name for body in links[1:])]
    index = {body: i for i, body in enumerate(links)}
    joints = [model.joint(name).id for name in arm.joints]
    flange = Rotation.from_quat(arm.quaternion, scalar_first=True)
    return MovedArm(
        name=arm.name,
        joint_names=np.array(arm.joints),
        joint_position=q,
        joint_slides=model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_SLIDE,
        joint_link=np.array([index[body] for body in model.jnt_bodyid[joints].tolist()], np.int32),
        joint_axis=model.jnt_axis[joints],
        joint_anchor=model.jnt_pos[joints],
        joint_limits=np.clip(np.stack([arm.lower, arm.upper], 1), -UNLIMITED, UNLIMITED),
        joint_speed=np.array(arm.speed),
        link_names=np.array([f"arm_{name}" if name in taken else name for name in names]),
        link_parent=np.array(
            [-1, *(index[body] for body in model.body_parentid[links[1:]].tolist())], np.int32
        ),
        link_position=base.rotation.apply(position.reshape(-1, 3)).reshape(position.shape)
        + base.position,
        link_quaternion=turns.as_quat(scalar_first=True).reshape(quaternion.shape),
        hand_link=np.array(index[model.body(arm.flange).id], np.int32),
        hand_position=arm.position + flange.apply(mount.position),
        hand_quaternion=(flange * mount.rotation).as_quat(scalar_first=True),
        **_mesh_arrays(model, links),
    )


def _mesh_arrays(model: mujoco.MjModel, links: list[int]) -> dict[str, np.ndarray]:
    """Meshes of the links, one for each colour of a link, by their names in `MovedArm`."""
    found: dict[tuple[int, tuple[float, ...]], list[trimesh.Trimesh]] = {}
    for g in _drawn(model, links):
        if (mesh := geom_mesh(model, g)) is not None:
            material = model.geom_matid[g]
            colour = (model.mat_rgba[material] if material >= 0 else model.geom_rgba[g])[:3]
            mesh.merge_vertices(merge_tex=True, merge_norm=True)
            mesh.apply_transform(_geom_pose(model, g))
            found.setdefault(
                (links.index(model.geom_bodyid[g]), tuple(colour.tolist())), []
            ).append(mesh)
    if not found:
        found = {
            (i, (0.5, 0.5, 0.5)): [trimesh.creation.icosphere(1, _BARE)] for i in range(len(links))
        }
    parts: list[Any] = [trimesh.util.concatenate(meshes) for meshes in found.values()]
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts]).astype(np.float32)
    faces = np.concatenate(
        [part.faces + at for part, at in zip(parts, first, strict=False)]
    ).astype(np.int32)
    of_mesh = np.repeat(np.arange(len(parts), dtype=np.int32), [len(part.faces) for part in parts])
    a, b, c = vertices[faces].astype(float).swapaxes(0, 1)
    flat = np.linalg.norm(np.cross(b - a, c - a), axis=1) < _FLAT
    return {
        "mesh_link": np.array([link for link, _ in found], np.int32),
        "mesh_colour": np.array([colour for _, colour in found]),
        "mesh_vertices": vertices,
        "mesh_faces": faces[~flat],
        "face_mesh": of_mesh[~flat],
    }


def _drawn(model: mujoco.MjModel, links: list[int]) -> list[int]:
    """Geoms of the links for pictures: visual ones, or collision geoms of a link without any."""
    geoms = np.flatnonzero(np.isin(model.geom_bodyid, links)).tolist()
    visual = {model.geom_bodyid[g] for g in geoms if not model.geom_contype[g]}
    return [g for g in geoms if not model.geom_contype[g] or model.geom_bodyid[g] not in visual]


def _geom_pose(model: mujoco.MjModel, g: int) -> np.ndarray:
    """(4, 4) pose of a geom in its body's frame."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(model.geom_quat[g], scalar_first=True).as_matrix()
    pose[:3, 3] = model.geom_pos[g]
    return pose
