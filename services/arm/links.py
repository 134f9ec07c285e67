"""Links of an arm along a motion: their frames in the world, and their meshes with colours."""

from collections.abc import Collection
from typing import Any

import mujoco
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from congrasp.services.arm.robot import Pose, Robot
from congrasp.services.assets.hands.geometry import geom_mesh
from congrasp.services.record.moved_arm import UNLIMITED, MovedArm

_FLAT = 1e-12  # twice the area of triangles that are left out, m^2
_BARE = 0.02  # radius of the balls that stand for the links of an arm without geometry, m


def moved_arm(robot: Robot, q: np.ndarray, base: Pose, mount: Pose, taken: Collection[str]) -> MovedArm:
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
        link_parent=np.array([-1, *(index[body] for body in model.body_parentid[links[1:]].tolist())], np.int32),
        link_position=base.rotation.apply(position.reshape(-1, 3)).reshape(position.shape) + base.position,
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
            found.setdefault((links.index(model.geom_bodyid[g]), tuple(colour.tolist())), []).append(mesh)
    if not found:
        found = {(i, (0.5, 0.5, 0.5)): [trimesh.creation.icosphere(1, _BARE)] for i in range(len(links))}
    parts: list[Any] = [trimesh.util.concatenate(meshes) for meshes in found.values()]
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts]).astype(np.float32)
    faces = np.concatenate([part.faces + at for part, at in zip(parts, first, strict=False)]).astype(np.int32)
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
