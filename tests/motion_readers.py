"""Readers of exported motions, independent of the writers, and the distance between a file and its
motion.
"""

import itertools
import json
import pathlib
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from typing import Any, NamedTuple

import bvhio
import mujoco
import numpy as np
import pyarrow.parquet as pq
import trimesh
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from pxr import Usd, UsdGeom
from scipy.spatial.transform import Rotation

from congrasp.common.episode.episode import Episode
from congrasp.services.export.frames import pose_matrices
from congrasp.services.export.surfaces import arm_meshes, object_mesh

FROM_Y_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], float)
"""World frame with the y axis up to one with the z axis up."""
LEVER = 0.1  # m; a point this far from a frame's origin shows its rotation


class Track(NamedTuple):
    """Content of a file for one motion."""

    time: np.ndarray
    """(T,) s, from zero."""
    poses: dict[str, np.ndarray]
    """(T, 4, 4) frame to world of every link and the object; metres, z up."""
    triangles: dict[str, np.ndarray] = {}  # noqa: RUF012  read only
    """(E, 3, 3) corners of the meshes of object and arm links in their frames."""


def read_glb(path: pathlib.Path) -> list[Track]:
    """The animation at its keyframes by the standard's layout, and the meshes as trimesh loads
    them.
    """
    content = path.read_bytes()
    size = int.from_bytes(content[12:16], "little")
    document = json.loads(content[20 : 20 + size])
    blob = content[28 + size :]
    nodes = document["nodes"]
    (animation,) = document["animations"]

    def values(index: int) -> np.ndarray:
        accessor = document["accessors"][index]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
        return np.frombuffer(blob, "<f4", accessor["count"] * width, start).reshape(-1, width)

    time = values(animation["samplers"][0]["input"])[:, 0]
    local = [
        {
            "translation": np.array(node.get("translation", [0, 0, 0])),
            "rotation": np.array(node.get("rotation")),
        }
        for node in nodes
    ]
    for channel in animation["channels"]:
        output = animation["samplers"][channel["sampler"]]["output"]
        local[channel["target"]["node"]][channel["target"]["path"]] = values(output)
    poses: dict[str, np.ndarray] = {}

    def visit(index: int, parent: np.ndarray) -> None:
        place, turn = (np.broadcast_to(v, (len(time), v.shape[-1])) for v in local[index].values())
        pose = poses[nodes[index]["name"]] = parent @ pose_matrices(place, Rotation.from_quat(turn))
        for child in nodes[index].get("children", []):
            visit(child, pose)

    visit(document["scenes"][0]["nodes"][0], FROM_Y_UP)  # the other node is the skin
    del poses["world"]
    meshes = trimesh.load_scene(path, process=False, merge_primitives=True).geometry
    return [
        Track(
            time,
            poses,
            {name: np.asarray(mesh.triangles) for name, mesh in meshes.items() if name != "skin"},
        )
    ]


def read_usd(path: pathlib.Path) -> list[Track]:
    """Transforms and meshes as Pixar's library composes them."""
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    codes = np.arange(stage.GetStartTimeCode(), stage.GetEndTimeCode() + 1)
    caches = [UsdGeom.XformCache(code) for code in codes]
    poses: dict[str, np.ndarray] = {}
    triangles: dict[str, list[np.ndarray]] = {}
    for prim in stage.Traverse():
        if name := prim.GetAttribute("congrasp:name").Get():
            # USD's vectors are rows
            rows = np.array([cache.GetLocalToWorldTransform(prim) for cache in caches])
            poses[name] = rows.swapaxes(1, 2)
        elif prim.IsA(UsdGeom.Mesh) and (
            name := prim.GetParent().GetAttribute("congrasp:name").Get()
        ):
            mesh = UsdGeom.Mesh(prim)
            corners = np.array(mesh.GetPointsAttr().Get())[mesh.GetFaceVertexIndicesAttr().Get()]
            triangles.setdefault(name, []).append(corners.reshape(-1, 3, 3))
    meshes = {name: np.concatenate(parts) for name, parts in triangles.items()}
    return [Track(codes / stage.GetTimeCodesPerSecond(), poses, meshes)]


def read_bvh(path: pathlib.Path) -> list[Track]:
    """Joints as bvhio reads them, from centimetres."""
    names = json.loads(path.with_name(f"{path.name}.json").read_text())["frames"]
    file = bvhio.readAsBvh(str(path))
    poses: dict[str, np.ndarray] = {}

    def visit(joint: Any, parent: np.ndarray) -> None:
        position = np.array([key.Position.to_tuple() for key in joint.Keyframes]) / 100
        turn = Rotation.from_quat(
            [key.Rotation.to_tuple() for key in joint.Keyframes], scalar_first=True
        )
        pose = parent @ pose_matrices(position, turn)
        if joint.Name in names:
            poses[names[joint.Name]] = pose
        for child in joint.Children:
            visit(child, pose)

    visit(file.Root, FROM_Y_UP)
    return [Track(file.FrameTime * np.arange(file.FrameCount), poses)]


def read_ros2(path: pathlib.Path) -> list[Track]:
    """Messages by mcap-ros2-support: links by joint trajectory and URDF, with which TF must
    agree.
    """
    (file,) = path.glob("*.mcap")
    messages: dict[str, list[Any]] = {}
    with file.open("rb") as stream:
        for _, channel, _, message in make_reader(
            stream, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            messages.setdefault(channel.topic, []).append(message)
    trees = []
    for message in messages["/tf"]:
        trees.append({transform.child_frame_id: transform for transform in message.transforms})
    tf: dict[str, np.ndarray] = {}

    def visit(name: str) -> np.ndarray:
        parent = trees[0][name].header.frame_id
        if name not in tf:
            local = _transforms([tree[name].transform for tree in trees])
            tf[name] = local if parent == "world" else visit(parent) @ local
        return tf[name]

    for name in trees[0]:
        visit(name)
    (trajectory,) = messages["/joint_trajectory"]
    (wrist,) = messages["/wrist_trajectory"]
    angles = dict(
        zip(
            trajectory.joint_names,
            np.array([list(p.positions) for p in trajectory.points]).T,
            strict=True,
        )
    )
    palm = _transforms([p.transforms[0] for p in wrist.points])
    urdf = messages["/robot_description"][0].data
    root = ET.fromstring(urdf)[0].attrib["name"]
    described = forward_kinematics(urdf, angles, palm, wrist.joint_names[0], tf[root])
    poses = {name: described.get(name, tf[name]) for name in tf}
    assert max(float(np.abs(poses[name] - tf[name]).max()) for name in tf) < 1e-4
    since = [
        p.time_from_start.sec - 1 + 1e-9 * p.time_from_start.nanosec for p in trajectory.points
    ]
    triangles: dict[str, list[np.ndarray]] = {}
    of_arm = itertools.chain.from_iterable(array.markers for array in messages.get("/arm", ()))
    for marker in [*messages["/object"], *of_arm]:
        corners = np.array([[p.x, p.y, p.z] for p in marker.points]).reshape(-1, 3, 3)
        triangles.setdefault(marker.header.frame_id, []).append(corners)
    return [
        Track(
            np.array(since),
            poses,
            {name: np.concatenate(parts) for name, parts in triangles.items()},
        )
    ]


def _transforms(transforms: list[Any]) -> np.ndarray:
    """(T, 4, 4) of T transforms."""
    position = np.array([[t.translation.x, t.translation.y, t.translation.z] for t in transforms])
    turns = Rotation.from_quat(
        [[t.rotation.x, t.rotation.y, t.rotation.z, t.rotation.w] for t in transforms]
    )
    return pose_matrices(position, turns)


def _popped_pose(values: dict[str, np.ndarray], name: str) -> np.ndarray:
    """(T, 4, 4) of a body, whose columns are removed from the values."""
    parts = [values.pop(f"{name}_{part}") for part in ("x", "y", "z", "qw", "qx", "qy", "qz")]
    return _poses(np.stack(parts, -1))


def read_lerobot(path: pathlib.Path) -> list[Track]:
    """Every episode by the description in the files: features by name, kinematics by the URDF."""
    info, about = (
        json.loads((path / "meta" / f"{name}.json").read_text()) for name in ("info", "congrasp")
    )
    (urdf,) = (file.read_text() for file in (path / "meta").glob("*.urdf"))
    links = [*about["links"], *about.get("arm_links", ())]
    tracks = []
    for row in pq.read_table(path / "meta" / "episodes").to_pylist():
        place = {name: row[f"data/{name}"] for name in ("chunk_index", "file_index")}
        rows = pq.read_table(path / info["data_path"].format(**place))
        rows = rows.slice(row["dataset_from_index"], row["length"])
        assert set(rows["episode_index"].to_pylist()) == {row["episode_index"]}
        values: dict[str, np.ndarray] = {}
        for feature in ("observation.state", "observation.environment_state"):
            names = info["features"][feature]["names"]
            columns = np.array(rows[feature].to_pylist()).T
            values |= dict(zip(names, columns, strict=True))
        palm = _popped_pose(values, "wrist")
        thing = _popped_pose(values, "object")
        base = (
            _poses(np.array([about["arm_base"][row["episode_index"]]]))
            if "arm_base" in about
            else palm
        )
        poses = forward_kinematics(urdf, values, palm, links[0], base)
        link_poses = {name: pose for name, pose in poses.items() if name in links} | {
            "object": thing
        }
        tracks.append(Track(rows["frame_index"].to_numpy() / info["fps"], link_poses))
    return tracks


READERS = {
    "glb": read_glb,
    "usd": read_usd,
    "bvh": read_bvh,
    "ros2": read_ros2,
    "lerobot": read_lerobot,
}
"""By the name of the format."""


def forward_kinematics(
    urdf: str, angles: Mapping[str, np.ndarray], wrist: np.ndarray, palm: str, base: np.ndarray
) -> dict[str, np.ndarray]:
    """Poses (T, 4, 4) of all links of a URDF as MuJoCo has them at angles (T,) of each joint.

    The palm and the links below it move with `wrist` (T, 4, 4), the others with the root at `base`.
    """
    robot = ET.fromstring(urdf)
    extension = ET.SubElement(robot, "mujoco")  # keeps links without joints, which would be merged
    ET.SubElement(extension, "compiler", fusestatic="false")
    model = mujoco.MjModel.from_xml_string(ET.tostring(robot, "unicode"))
    data = mujoco.MjData(model)
    matrices = np.zeros((len(wrist), model.nbody, 4, 4))
    for t in range(len(wrist)):
        for name, values in angles.items():
            data.qpos[model.joint(name).qposadr[0]] = values[t]
        mujoco.mj_kinematics(model, data)
        matrices[t] = pose_matrices(data.xpos, Rotation.from_matrix(data.xmat.reshape(-1, 3, 3)))
    held = {model.body(palm).id}
    onto = wrist @ np.linalg.inv(matrices[:, model.body(palm).id])
    poses = {}
    for i in range(1, model.nbody):
        if int(model.body_parentid[i]) in held:
            held.add(i)
        poses[model.body(i).name] = (onto if i in held else base) @ matrices[:, i]
    return poses


def _poses(rows: np.ndarray) -> np.ndarray:
    """(T, 4, 4) of positions and quaternions (T, 7)."""
    return pose_matrices(rows[:, :3], Rotation.from_quat(rows[:, 3:], scalar_first=True))


def error_mm(motion: Episode, track: Track) -> float:
    """Largest distance in mm between points of the motion and of the file.

    The points are each frame's origin and three a decimetre away along its axes, at every time, and
    the triangles of object and arm in their frames.
    """
    arm = motion.arm
    expected = {
        "object": _poses(np.concatenate([motion.object_position, motion.object_quaternion], 1))
    }
    for links in (motion, arm) if arm else (motion,):
        rows = np.concatenate([links.link_position, links.link_quaternion], -1)
        expected |= {str(name): _poses(rows[:, i]) for i, name in enumerate(links.link_names)}
    assert expected.keys() == track.poses.keys()
    np.testing.assert_allclose(track.time, motion.time, atol=1e-6)
    points = np.concatenate([LEVER * np.eye(4, 3, -1), np.ones((4, 1))], 1).T
    apart = [
        np.linalg.norm(((pose - track.poses[name]) @ points)[:, :3], axis=1)
        for name, pose in expected.items()
    ]
    if track.triangles:
        vertices, faces, _ = object_mesh(motion)
        meshes = {"object": [vertices[faces]]}
        for name, parts in arm_meshes(motion).items():
            meshes[name] = [part.vertices[part.faces] for part in parts]
        assert meshes.keys() == track.triangles.keys()
        apart += [
            np.linalg.norm(np.concatenate(parts) - track.triangles[name], axis=-1)
            for name, parts in meshes.items()
        ]
    return 1000 * max(float(distance.max()) for distance in apart)
