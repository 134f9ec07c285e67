"""The links of an arm along a motion, with their meshes, for recordings and motion files."""

from collections.abc import Collection
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from congrasp.common.episode.arm import UNLIMITED, MovedArm
from congrasp.common.runtime.physics_library import mujoco
from congrasp.services.arm.robot import Pose, Robot
from congrasp.services.assets.hands.link_geometry import geom_mesh

_MIN_DOUBLE_AREA = 1e-12  # twice the area of a triangle, m^2; smaller ones are left out
_BALL_RADIUS_M = 0.02  # of the balls that stand for the links of an arm without geometry
_BALL_COLOUR = (0.5, 0.5, 0.5)


def moved_arm(
    robot: Robot, q: np.ndarray, base: Pose, mount: Pose, reserved: Collection[str]
) -> MovedArm:
    """Returns the arm's links along a motion.

    Args:
      robot: the robot.
      q: (T, N) joints of the arm, rad or m.
      base: pose of its base in the world.
      mount: pose of the wrist frame in the flange's.
      reserved: names that links must not have.
    """
    model = robot.model
    arm = robot.arm
    links = robot.links
    position, rotation = _link_poses(robot, q)
    world_position = base.rotation.apply(position.reshape(-1, 3)) + base.position
    world_quaternion = (base.rotation * rotation).as_quat(scalar_first=True)
    joints = [model.joint(name).id for name in arm.joints]
    flange = Rotation.from_quat(arm.quaternion, scalar_first=True)
    limits = np.stack([arm.lower, arm.upper], 1)
    joint_links = [links.index(body) for body in model.jnt_bodyid[joints]]
    parents = [links.index(body) for body in model.body_parentid[links[1:]]]
    return MovedArm(
        name=arm.name,
        joint_names=np.array(arm.joints),
        joint_position=q,
        joint_slides=model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_SLIDE,
        joint_link=np.array(joint_links, np.int32),
        joint_axis=model.jnt_axis[joints],
        joint_anchor=model.jnt_pos[joints],
        joint_limits=np.clip(limits, -UNLIMITED, UNLIMITED),
        joint_speed=np.array(arm.speed),
        link_names=np.array(_link_names(robot, reserved)),
        link_parent=np.array([-1, *parents], np.int32),
        link_position=world_position.reshape(len(q), len(links), 3),
        link_quaternion=world_quaternion.reshape(len(q), len(links), 4),
        hand_link=np.array(links.index(model.body(arm.flange).id), np.int32),
        hand_position=arm.position + flange.apply(mount.position),
        hand_quaternion=(flange * mount.rotation).as_quat(scalar_first=True),
        **_mesh_arrays(model, links),
    )


def _link_poses(robot: Robot, q: np.ndarray) -> tuple[np.ndarray, Rotation]:
    """Positions (T, L, 3) and T * L orientations of the links in the frame of the base."""
    data = mujoco.MjData(robot.model)
    links = robot.links
    position = np.zeros((len(q), len(links), 3))
    quaternion = np.zeros((len(q), len(links), 4))
    for t, row in enumerate(q):
        data.qpos[robot.joints] = row
        mujoco.mj_kinematics(robot.model, data)
        position[t] = data.xpos[links]
        quaternion[t] = data.xquat[links]
    return position, Rotation.from_quat(quaternion.reshape(-1, 4), scalar_first=True)


def _link_names(robot: Robot, reserved: Collection[str]) -> list[str]:
    """Names of the links in a recording; a reserved name gets the prefix `arm_`."""
    names = [f"{robot.arm.name}_base"]
    for body in robot.links[1:]:
        names.append(robot.model.body(body).name)
    return [f"arm_{name}" if name in reserved else name for name in names]


def _mesh_arrays(model: mujoco.MjModel, links: list[int]) -> dict[str, np.ndarray]:
    """Meshes of the links, one for each colour of a link, by their names in `MovedArm`."""
    meshes = _coloured_meshes(model, links)
    vertices = []
    faces = []
    face_mesh = []
    first_vertex = 0
    for index, mesh in enumerate(meshes.values()):
        vertices.append(mesh.vertices)
        faces.append(mesh.faces + first_vertex)
        face_mesh.append(np.full(len(mesh.faces), index, np.int32))
        first_vertex += len(mesh.vertices)
    all_vertices = np.concatenate(vertices).astype(np.float32)
    all_faces = np.concatenate(faces).astype(np.int32)
    a, b, c = all_vertices[all_faces].astype(float).swapaxes(0, 1)
    is_flat = np.linalg.norm(np.cross(b - a, c - a), axis=1) < _MIN_DOUBLE_AREA
    return {
        "mesh_link": np.array([link for link, _ in meshes], np.int32),
        "mesh_colour": np.array([colour for _, colour in meshes]),
        "mesh_vertices": all_vertices,
        "mesh_faces": all_faces[~is_flat],
        "face_mesh": np.concatenate(face_mesh)[~is_flat],
    }


def _coloured_meshes(
    model: mujoco.MjModel, links: list[int]
) -> dict[tuple[int, tuple[float, ...]], Any]:
    """Returns one mesh in the link's frame for each link and colour, by the link's index and the
    colour; balls for an arm without geometry.
    """
    meshes_of_key: dict[tuple[int, tuple[float, ...]], list[trimesh.Trimesh]] = {}
    for geom in _visible_geoms(model, links):
        mesh = geom_mesh(model, geom)
        if mesh is None:
            continue
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        mesh.apply_transform(_geom_pose(model, geom))
        link = links.index(model.geom_bodyid[geom])
        meshes_of_key.setdefault((link, _geom_colour(model, geom)), []).append(mesh)
    if not meshes_of_key:
        for link in range(len(links)):
            meshes_of_key[link, _BALL_COLOUR] = [trimesh.creation.icosphere(1, _BALL_RADIUS_M)]
    return {key: trimesh.util.concatenate(meshes) for key, meshes in meshes_of_key.items()}


def _visible_geoms(model: mujoco.MjModel, links: list[int]) -> list[int]:
    """Geoms of the links for pictures: visual ones, or collision geoms of a link without any."""
    geoms = np.flatnonzero(np.isin(model.geom_bodyid, links)).tolist()
    visual = [geom for geom in geoms if not model.geom_contype[geom]]
    bodies = {model.geom_bodyid[geom] for geom in visual}
    return [g for g in geoms if not model.geom_contype[g] or model.geom_bodyid[g] not in bodies]


def _geom_colour(model: mujoco.MjModel, geom: int) -> tuple[float, ...]:
    """(3,) colour of a geom: its material's, if it has one."""
    material = model.geom_matid[geom]
    rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
    return tuple(rgba[:3].tolist())


def _geom_pose(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """(4, 4) pose of a geom in its body's frame."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(model.geom_quat[geom], scalar_first=True).as_matrix()
    pose[:3, 3] = model.geom_pos[geom]
    return pose
