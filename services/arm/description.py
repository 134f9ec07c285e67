"""File of an arm: its joints, limits and flange, without a gripper."""

import contextlib
import dataclasses
import pathlib
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError, MissingPackageError
from congrasp.common.io.arrays import numbers_in, read_npz
from congrasp.common.runtime.physics_library import mujoco
from congrasp.services.assets.hands.compile import robot_spec
from congrasp.services.assets.hands.reading import confined
from congrasp.services.assets.hands.robot_texts import robot_text
from congrasp.services.assets.hands.urdf import parse_urdf

SPEED = 3.14
"""Default speed limit of joints, rad/s (m/s of slides); MJCF has no speed limits."""
_FLANGE_SITES = ("attachment_site", "flange", "tool0", "ee_site")
"""Usual names of the site of a flange."""
_ARRAYS_FILE = "arm.npz"
_BODIES_FILE = "arm.xml"
_JOINT_TYPES = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
_MAX_LISTED_BODIES = 4  # in a message


@dataclasses.dataclass(frozen=True, eq=False)
class Arm:
    """An arm of N joints from its base to its flange."""

    name: str
    spec: mujoco.MjSpec
    """Bodies and joints without a gripper, in the frame of the base."""
    joints: tuple[str, ...]
    """N names, base first."""
    lower: np.ndarray
    """(N,) rad or m; -inf where a joint has no limits."""
    upper: np.ndarray
    """(N,) rad or m; inf where a joint has no limits."""
    speed: np.ndarray
    """(N,) speed limits, rad/s or m/s."""
    flange: str
    """Name of the body that carries the hand."""
    position: np.ndarray
    """(3,) position of the flange in that body's frame, m."""
    quaternion: np.ndarray
    """(4,) w x y z, orientation of the flange in that body's frame."""
    postures: np.ndarray
    """(P, N) postures of the file's keyframes, rad or m."""


def arm_file(name: str) -> pathlib.Path:
    """Returns the file of an arm: a path is returned unchanged, a robot of MuJoCo Menagerie is
    fetched by `mujoco-menagerie`.

    Raises:
      CongraspError: there is neither such a file nor such a robot, or it cannot be fetched.
    """
    path = pathlib.Path(name)
    if path.suffix or path.exists():
        return path
    try:
        import mujoco_menagerie
    except ImportError:
        raise MissingPackageError(
            f"There is no file {name}. A robot's name", "mujoco_menagerie"
        ) from None
    names = mujoco_menagerie.names()
    matches = [name]
    if name not in names:
        matches = [other for other in names if name in other.split("_")]
    if len(matches) != 1:
        remedy = f"Name one of {', '.join(matches)}." if matches else "Pass an MJCF or URDF file."
        raise CongraspError(f"MuJoCo Menagerie has {len(matches)} robots called '{name}'.", remedy)
    robot = mujoco_menagerie.get(matches[0])
    try:
        return pathlib.Path(robot.xml(_bare_entry(robot.entry_names)))
    except (mujoco_menagerie.MenagerieError, OSError):
        raise CongraspError(
            f"'{matches[0]}' of MuJoCo Menagerie could not be downloaded.",
            "Connect to the internet, or pass an MJCF or URDF file.",
        ) from None


def _bare_entry(names: tuple[str, ...]) -> str:
    """The entry of a robot without scene, hand and MJX variant, or else the most similar one."""
    return min(
        names, key=lambda name: ("scene" in name, "mjx" in name, "nohand" not in name, len(name))
    )


def load_arm(path: pathlib.Path, flange: str = "", speed: str = "") -> Arm:
    """Reads an arm, in a confined process.

    Args:
      path: MJCF or URDF.
      flange: site or body that carries the hand; detected if empty.
      speed: speed limits of the joints, one or N numbers; those of a URDF, or `SPEED`, if empty.

    Raises:
      CongraspError: the file cannot be read, has no such flange, or joints that are neither hinges
        nor slides, or the speed limits are invalid.
    """
    with confined(write_arm, path, {"flange": flange, "speed": speed}) as (result, folder):
        arrays = read_npz(folder / _ARRAYS_FILE, "")
        spec = mujoco.MjSpec.from_string((folder / _BODIES_FILE).read_text(encoding="utf-8"))
    name = path.parent.name if path.stem in ("robot", "scene") else path.stem
    return Arm(
        name=name,
        spec=spec,
        joints=tuple(result["joints"]),
        flange=result["flange"],
        **arrays,
    )


def write_arm(folder: pathlib.Path, path: str, flange: str, speed: str) -> dict[str, Any]:
    """Does the work of `load_arm` in the confined process.

    Args:
      folder: gets the bodies as MJCF, and the arrays of `Arm`.
      path: see `load_arm`.
      flange: see `load_arm`.
      speed: see `load_arm`.

    Returns:
      Names of the `joints` and of the body with the `flange`.
    """
    file = pathlib.Path(path)
    spec, _ = robot_spec(file, [])
    _name_elements(spec)
    with contextlib.chdir(file.parent):
        model = spec.compile()
    mount = _flange(model, file, flange)
    flange_name = model.body(mount.body).name
    joints = _joints_to(model, mount.body)
    if not joints or any(model.jnt_type[joint] not in _JOINT_TYPES for joint in joints):
        raise CongraspError(
            f"{path} has no chain of hinge and slide joints from its base to '{flange_name}'.",
            "Pass the arm's last body or site with --flange.",
        )
    names = tuple(model.joint(joint).name for joint in joints)
    is_limited = model.jnt_limited[joints].astype(bool)
    lower, upper = model.jnt_range[joints].T
    _strip(spec, model, mount.body)
    np.savez(
        folder / _ARRAYS_FILE,
        lower=np.where(is_limited, lower, -np.inf),
        upper=np.where(is_limited, upper, np.inf),
        speed=_speeds(file, names, speed),
        position=mount.position,
        quaternion=mount.quaternion,
        postures=model.key_qpos[:, model.jnt_qposadr[joints]],
    )
    (folder / _BODIES_FILE).write_text(spec.to_xml(), encoding="utf-8")
    return {"joints": names, "flange": flange_name}


def _name_elements(spec: mujoco.MjSpec) -> None:
    """Names the bodies and joints that have no name."""
    for i, body in enumerate(spec.bodies):
        body.name = body.name or f"body_{i}"
    for i, joint in enumerate(spec.joints):
        joint.name = joint.name or f"joint_{i}"


def _joints_to(model: mujoco.MjModel, body: int) -> list[int]:
    """Joints between the base and a body, the base's first."""
    joints: list[int] = []
    for link in _chain_to(model, body):
        first = int(model.body_jntadr[link])
        joints.extend(range(first, first + int(model.body_jntnum[link])))
    return joints


def _chain_to(model: mujoco.MjModel, body: int) -> list[int]:
    """Bodies from the base to this one, without the world."""
    chain: list[int] = []
    while body:
        chain.insert(0, body)
        body = int(model.body_parentid[body])
    return chain


class _Flange(NamedTuple):
    """Frame to which the hand is attached."""

    body: int
    """The body that carries the hand."""
    position: np.ndarray
    """(3,) in the frame of the body, m."""
    quaternion: np.ndarray
    """(4,) w x y z, in the frame of the body."""


def _frame_of(body: int) -> _Flange:
    """A flange that is the frame of a body."""
    return _Flange(body, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))


def _flange(model: mujoco.MjModel, path: pathlib.Path, name: str) -> _Flange:
    """Returns the flange of a name; if that is empty, of a usual site, or the end of the chain.

    Raises:
      CongraspError: there is neither a site nor a body of that name.
    """
    sites = [model.site(i).name for i in range(model.nsite)]
    bodies = [model.body(i).name for i in range(model.nbody)]
    if not name:
        usual_sites = [site for site in _FLANGE_SITES if site in sites]
        if not usual_sites:
            return _last_body(model)
        name = usual_sites[0]
    if name in sites:
        site = sites.index(name)
        return _Flange(int(model.site_bodyid[site]), model.site_pos[site], model.site_quat[site])
    if name in bodies:
        return _frame_of(bodies.index(name))
    raise CongraspError(
        f"{path} has no site or body '{name}'.",
        f"Its last bodies are {', '.join(bodies[-_MAX_LISTED_BODIES:])}.",
    )


def _last_body(model: mujoco.MjModel) -> _Flange:
    """Returns the end of the chain of joints, before a gripper.

    A gripper is a body without a joint that has several children with joints. A gripper that begins
    with a joint is taken for a part of the arm.
    """
    children: list[list[int]] = [[] for _ in range(model.nbody)]
    for child in range(1, model.nbody):
        children[int(model.body_parentid[child])].append(child)
    has_joints = np.zeros(model.nbody, bool)  # the body itself, or one below it
    for body in reversed(range(1, model.nbody)):
        has_joints[body] |= model.body_jntnum[body] > 0
        has_joints[int(model.body_parentid[body])] |= has_joints[body]
    body = 0
    branches = [child for child in children[body] if has_joints[child]]
    while len(branches) == 1:
        body = branches[0]
        branches = [child for child in children[body] if has_joints[child]]
    if len(branches) > 1 and body and not model.body_jntnum[body]:  # a gripper
        parent = int(model.body_parentid[body])
        return _Flange(parent, model.body_pos[body], model.body_quat[body])
    # Plates that are fixed to the last link one after the other belong to the arm.
    while len(children[body]) == 1 and not has_joints[children[body][0]]:
        body = children[body][0]
    return _frame_of(body)


def _strip(spec: mujoco.MjSpec, model: mujoco.MjModel, flange: int) -> None:
    """Removes all movable parts beyond the flange, and everything but bodies, joints and shapes;
    meshes are embedded, so that the arm's files are not needed afterwards.
    """
    groups = (spec.keys, spec.actuators, spec.equalities, spec.tendons, spec.excludes, spec.pairs)
    for group in (*groups, spec.skins, spec.flexes, spec.textures, spec.plugins):
        for element in list(group):
            spec.delete(element)
    for material in spec.materials:
        for i in range(len(material.textures)):
            material.textures[i] = ""
    for index, mesh in enumerate(spec.meshes):
        _embed(mesh, model, index)
    _delete_moving_bodies(spec, model, flange)
    planes = [geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_PLANE]
    for geom in planes:
        spec.delete(geom)


def _embed(mesh: mujoco.MjsMesh, model: mujoco.MjModel, index: int) -> None:
    """Replaces a mesh's file by its vertices and faces. In the model they are in the mesh's frame
    of inertia, from which they are moved back.
    """
    turn = Rotation.from_quat(model.mesh_quat[index], scalar_first=True)
    first_vertex = model.mesh_vertadr[index]
    end_vertex = first_vertex + model.mesh_vertnum[index]
    vertices = turn.apply(model.mesh_vert[first_vertex:end_vertex]) + model.mesh_pos[index]
    first_face = model.mesh_faceadr[index]
    end_face = first_face + model.mesh_facenum[index]
    mesh.uservert = vertices.ravel()
    mesh.userface = model.mesh_face[first_face:end_face].ravel()
    mesh.name = model.mesh(index).name
    mesh.file = ""
    mesh.content_type = ""
    mesh.scale = np.ones(3)
    mesh.refpos = np.zeros(3)
    mesh.refquat = [1.0, 0.0, 0.0, 0.0]


def _delete_moving_bodies(spec: mujoco.MjSpec, model: mujoco.MjModel, flange: int) -> None:
    """Deletes the children of the flange that move or carry a moving body."""
    with_joints: set[int] = set()
    for body in range(flange + 1, model.nbody):
        if model.body_jntnum[body]:
            with_joints.update(_chain_to(model, body))
    for body in sorted(with_joints):
        if int(model.body_parentid[body]) == flange:
            spec.delete(spec.body(model.body(body).name))


def _speeds(path: pathlib.Path, joints: tuple[str, ...], text: str) -> np.ndarray:
    """Returns the speed limits (N,) of joints, rad/s or m/s.

    Args:
      path: the arm's file.
      joints: N names.
      text: the option --arm-speed; if it is empty, the limits are those of a URDF, or `SPEED`.

    Raises:
      CongraspError: the option is not valid.
    """
    if text:
        limits = numbers_in(text)
        if len(limits) not in (1, len(joints)) or not (limits > 0).all():
            raise CongraspError(
                f"--arm-speed is '{text}'.",
                f"Write one positive number, or {len(joints)} positive numbers.",
            )
        return np.broadcast_to(limits, len(joints))
    urdf_limits = _urdf_speeds(robot_text(path))
    speeds = []
    for name in joints:
        limit = urdf_limits.get(name, 0.0)
        speeds.append(limit if limit > 0 else SPEED)
    return np.array(speeds)


def _urdf_speeds(text: str) -> dict[str | None, float]:
    """Speed limits of a URDF's joints by their names, 0 where there is none; empty for an MJCF."""
    speeds: dict[str | None, float] = {}
    if not text.startswith("<robot"):
        return speeds
    for joint in parse_urdf(text).findall("joint"):
        limit = joint.find("limit")
        speeds[joint.get("name")] = 0.0 if limit is None else float(limit.get("velocity", 0.0))
    return speeds
