"""File of an arm: its joints, limits and flange, without a gripper."""

import contextlib
import dataclasses
import pathlib
import xml.etree.ElementTree as ET
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError, MissingPackageError
from congrasp.common.io.arrays import numbers_in, read_npz
from congrasp.common.runtime.physics_library import mujoco
from congrasp.services.assets.hands.compile import robot_spec
from congrasp.services.assets.hands.reading import confined
from congrasp.services.assets.hands.robot_texts import robot_text

SPEED = 3.14
"""Default speed limit of joints, rad/s (m/s of slides); MJCF files never have one."""
_SITES = ("attachment_site", "flange", "tool0", "ee_site")
_ARRAYS, _BODIES = "arm.npz", "arm.xml"
_KINDS = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


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
    """(N,) rad or m."""
    speed: np.ndarray
    """(N,) rad/s or m/s."""
    flange: str
    """Name of the body that carries the hand."""
    position: np.ndarray
    """(3,) position of the flange in that body's frame, m."""
    quaternion: np.ndarray
    """(4,) w x y z, orientation of the flange in that body's frame."""
    postures: np.ndarray
    """(P, N) postures in the file's keyframes."""


def arm_file(name: str) -> pathlib.Path:
    """Returns the path itself, or the file of a robot fetched by `mujoco-menagerie`.

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
    found = [name] if name in names else [other for other in names if name in other.split("_")]
    if len(found) != 1:
        remedy = f"Name one of {', '.join(found)}." if found else "Pass an MJCF or URDF file."
        raise CongraspError(f"MuJoCo Menagerie has {len(found)} robots called '{name}'.", remedy)
    robot = mujoco_menagerie.get(found[0])
    try:
        return pathlib.Path(robot.xml(_bare_entry(robot.entry_names)))
    except (mujoco_menagerie.MenagerieError, OSError):
        raise CongraspError(
            f"'{found[0]}' of MuJoCo Menagerie could not be downloaded.",
            "Connect to the internet, or pass an MJCF or URDF file.",
        ) from None


def _bare_entry(names: tuple[str, ...]) -> str:
    """Entry of a robot without scene, hand and MJX variant, if there is one."""
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
    with confined(write_arm, path, {"flange": flange, "speed": speed}) as (answer, folder):
        arrays = read_npz(folder / _ARRAYS, "")
        spec = mujoco.MjSpec.from_string((folder / _BODIES).read_text())
    name = path.parent.name if path.stem in ("robot", "scene") else path.stem
    return Arm(name, spec, tuple(answer["joints"]), flange=answer["flange"], **arrays)


def write_arm(folder: pathlib.Path, path: str, flange: str, speed: str) -> dict[str, Any]:
    """Does the work of `load_arm` in the confined process: writes the bodies as MJCF, and
    arrays.
    """
    file = pathlib.Path(path)
    spec, _ = robot_spec(file, [])
    for i, body in enumerate(spec.bodies):
        body.name = body.name or f"body_{i}"
    for i, joint in enumerate(spec.joints):
        joint.name = joint.name or f"joint_{i}"
    with contextlib.chdir(file.parent):
        model = spec.compile()
    body, position, quaternion = _flange(model, file, flange)
    carried = [i for i in _above(model, body) if model.body_jntnum[i]]
    joints = [int(model.body_jntadr[i]) + k for i in carried for k in range(model.body_jntnum[i])]
    if not joints or any(model.jnt_type[j] not in _KINDS for j in joints):
        raise CongraspError(
            f"{path} has no chain of hinges and slides from its base to '{model.body(body).name}'.",
            "Pass the arm's last body or site with --flange.",
        )
    names = tuple(model.joint(j).name for j in joints)
    limited = model.jnt_limited[joints].astype(bool)
    lower, upper = (
        np.where(limited, model.jnt_range[joints, k], end) for k, end in ((0, -np.inf), (1, np.inf))
    )
    postures = model.key_qpos[:, model.jnt_qposadr[joints]]
    _strip(spec, model, body)
    np.savez(
        folder / _ARRAYS,
        lower=lower,
        upper=upper,
        speed=_speeds(file, names, speed),
        position=position,
        quaternion=quaternion,
        postures=postures,
    )
    (folder / _BODIES).write_text(spec.to_xml())
    return {"joints": names, "flange": model.body(body).name}


def _above(model: mujoco.MjModel, body: int) -> list[int]:
    """Bodies from the base to this one."""
    chain: list[int] = []
    while body:
        chain.insert(0, body)
        body = int(model.body_parentid[body])
    return chain


def _flange(
    model: mujoco.MjModel, path: pathlib.Path, name: str
) -> tuple[int, np.ndarray, np.ndarray]:
    """The body that carries the hand, and position (3,) and quaternion (4,) of the flange in its
    frame.
    """
    sites = [model.site(i).name for i in range(model.nsite)]
    bodies = [model.body(i).name for i in range(model.nbody)]
    chosen = name or next((site for site in _SITES if site in sites), "")
    if chosen in sites:
        site = sites.index(chosen)
        return int(model.site_bodyid[site]), model.site_pos[site], model.site_quat[site]
    if chosen in bodies:
        return bodies.index(chosen), np.zeros(3), np.array([1.0, 0, 0, 0])
    if chosen:
        raise CongraspError(
            f"{path} has no site or body '{chosen}'.", f"It ends with {', '.join(bodies[-4:])}."
        )
    return _last_body(model)


def _last_body(model: mujoco.MjModel) -> tuple[int, np.ndarray, np.ndarray]:
    """The end of the chain of joints, before a gripper: see `_flange`.

    A gripper is a body without a joint whose children move apart; where it begins with a joint, it
    stays.
    """
    children: list[list[int]] = [[] for _ in range(model.nbody)]
    for child in range(1, model.nbody):
        children[int(model.body_parentid[child])].append(child)
    moving = np.zeros(model.nbody, bool)
    for body in reversed(range(1, model.nbody)):
        moving[body] |= model.body_jntnum[body] > 0
        moving[int(model.body_parentid[body])] |= moving[body]
    body = 0
    while branches := [child for child in children[body] if moving[child]]:
        if len(branches) > 1:
            if body and not model.body_jntnum[body]:
                return int(model.body_parentid[body]), model.body_pos[body], model.body_quat[body]
            break
        body = branches[0]
    while len(children[body]) == 1 and not moving[children[body][0]]:
        body = children[body][0]
    return body, np.zeros(3), np.array([1.0, 0, 0, 0])


def _strip(spec: mujoco.MjSpec, model: mujoco.MjModel, flange: int) -> None:
    """Removes all movable parts beyond the flange and everything but kinematics; no file is needed
    afterwards.
    """
    groups = (spec.keys, spec.actuators, spec.equalities, spec.tendons, spec.excludes, spec.pairs)
    for group in (*groups, spec.skins, spec.flexes, spec.textures, spec.plugins):
        for element in list(group):
            spec.delete(element)
    for material in spec.materials:
        for i in range(len(material.textures)):
            material.textures[i] = ""
    for m, mesh in enumerate(spec.meshes):
        turn = Rotation.from_quat(model.mesh_quat[m], scalar_first=True)
        start, end = model.mesh_vertadr[m], model.mesh_vertadr[m] + model.mesh_vertnum[m]
        first, last = model.mesh_faceadr[m], model.mesh_faceadr[m] + model.mesh_facenum[m]
        mesh.uservert = (turn.apply(model.mesh_vert[start:end]) + model.mesh_pos[m]).ravel()
        mesh.userface = model.mesh_face[first:last].ravel()
        mesh.name, mesh.file, mesh.content_type, mesh.scale = model.mesh(m).name, "", "", np.ones(3)
        mesh.refpos, mesh.refquat = np.zeros(3), [1.0, 0.0, 0.0, 0.0]
    below = {flange}
    for body in range(flange + 1, model.nbody):
        if int(model.body_parentid[body]) in below:
            below.add(body)
    moving = {
        b
        for b in below - {flange}
        if any(model.body_jntnum[x] for x in below if b in _above(model, x))
    }
    for body in moving:
        if int(model.body_parentid[body]) == flange:
            spec.delete(spec.body(model.body(body).name))
    for geom in [geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_PLANE]:
        spec.delete(geom)


def _speeds(path: pathlib.Path, joints: tuple[str, ...], text: str) -> np.ndarray:
    """(N,) speed limits: the given ones, those of a URDF, or `SPEED`."""
    if text:
        given = numbers_in(text)
        if len(given) not in (1, len(joints)) or not (given > 0).all():
            raise CongraspError(
                f"--arm-speed is '{text}'.", f"Write one positive number, or {len(joints)}."
            )
        return np.broadcast_to(given, len(joints))
    stated = {}
    text = robot_text(path)
    if text.startswith("<robot"):
        for joint in ET.fromstring(text).iter("joint"):
            limit = joint.find("limit")
            stated[joint.get("name")] = 0.0 if limit is None else float(limit.get("velocity", 0.0))
    return np.array([speed if (speed := stated.get(name, 0.0)) > 0 else SPEED for name in joints])
