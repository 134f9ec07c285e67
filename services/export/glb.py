"""Binary glTF 2.0 with an animation; written by pygltflib, read back as the standard says and, its meshes, by trimesh.

One node a link, nested as the hand is, with translation and rotation (glTF forbids matrices on animated nodes). glTF
is y-up: a root node turns the world, so that everything below it keeps congrasp's z-up coordinates.
"""

import json
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import pygltflib as gltf
import trimesh
from scipy.spatial.transform import Rotation

from services.export.frames import (
    COLOURS,
    FROM_Y_UP,
    OBJECT,
    TO_Y_UP,
    Track,
    bodies,
    capsules,
    continuous_quaternions,
    facts,
    pose_matrices,
)
from services.export.motion_file import GraspMotion

_SECTIONS = (12, 12)
_KINDS = {1: gltf.SCALAR, 3: gltf.VEC3, 4: gltf.VEC4}


def write(path: pathlib.Path, motions: Sequence[GraspMotion]) -> None:
    """Writes one motion."""
    (motion,) = motions
    file, data, grasp = gltf.GLTF2(), bytearray(), gltf.Animation(name="grasp")
    about = facts(motion, frame="this node's frame: z up", unit="m", quaternion="x, y, z, w")
    file.asset.generator = "congrasp"
    file.nodes.append(gltf.Node(name="world", rotation=TO_Y_UP.as_quat().tolist(), extras=about))
    file.materials = [
        gltf.Material(
            name=name,
            pbrMetallicRoughness=gltf.PbrMetallicRoughness(baseColorFactor=[*colour, 1.0], metallicFactor=0.0),
        )
        for name, colour in COLOURS.items()
    ]
    time = _add(file, data, motion.time, bounds=True)
    for i, body in enumerate(bodies(motion)):
        number, first = len(file.nodes), body.rotation[0].as_quat()
        node = gltf.Node(name=body.name, translation=body.translation[0].tolist(), rotation=first.tolist())
        file.nodes.append(node)
        file.nodes[body.parent + 1].children.append(number)
        shape = _object_mesh(motion) if body.name == OBJECT else _link_mesh(motion, i)
        if shape is not None:
            node.mesh = len(file.meshes)
            file.meshes.append(gltf.Mesh(name=body.name, primitives=[_primitive(file, data, body.name, shape)]))
        tracks = {"rotation": continuous_quaternions(body.rotation, scalar_first=False)}
        if len(body.translation) > 1:
            tracks["translation"] = body.translation
        for name, values in tracks.items():
            target = gltf.AnimationChannelTarget(node=number, path=name)
            grasp.channels.append(gltf.AnimationChannel(sampler=len(grasp.samplers), target=target))
            grasp.samplers.append(gltf.AnimationSampler(input=time, output=_add(file, data, values)))
    file.animations = [grasp]
    file.scene, file.scenes = 0, [gltf.Scene(name=motion.object, nodes=[0])]
    file.buffers = [gltf.Buffer(byteLength=len(data))]
    file.set_binary_blob(bytes(data))
    file.save_binary(str(path))


def _add(
    file: gltf.GLTF2, data: bytearray, values: np.ndarray, target: int | None = None, *, bounds: bool = False
) -> int:
    """Appends values (n,), (n, 3) or (n, 4) to the buffer; integers are indices. Returns the new accessor's number."""
    whole = np.issubdtype(values.dtype, np.integer)
    values = np.ascontiguousarray(values, "<u4" if whole else "<f4")
    view = gltf.BufferView(buffer=0, byteOffset=len(data), byteLength=values.nbytes, target=target)
    accessor = gltf.Accessor(
        bufferView=len(file.bufferViews),
        componentType=gltf.UNSIGNED_INT if whole else gltf.FLOAT,
        count=len(values),
        type=_KINDS[1 if values.ndim == 1 else values.shape[1]],
    )
    if bounds:
        accessor.min, accessor.max = (np.atleast_1d(end).tolist() for end in (values.min(0), values.max(0)))
    file.bufferViews.append(view)
    file.accessors.append(accessor)
    data += values.tobytes()
    return len(file.accessors) - 1


def _primitive(file: gltf.GLTF2, data: bytearray, name: str, mesh: trimesh.Trimesh) -> gltf.Primitive:
    """A body's mesh with normals and its material."""
    normals = mesh.vertex_normals
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(lengths > 0.5, normals / np.maximum(lengths, 1e-9), [0.0, 0.0, 1.0])  # of unused vertices
    attributes = gltf.Attributes(
        POSITION=_add(file, data, mesh.vertices, gltf.ARRAY_BUFFER, bounds=True),
        NORMAL=_add(file, data, normals, gltf.ARRAY_BUFFER),
    )
    indices = _add(file, data, mesh.faces.ravel(), gltf.ELEMENT_ARRAY_BUFFER)
    material = list(COLOURS).index(OBJECT if name == OBJECT else "hand")
    return gltf.Primitive(attributes=attributes, indices=indices, material=material)


def _link_mesh(motion: GraspMotion, link: int) -> Any:
    """The link's capsules in its frame; None if it has none."""
    parts = []
    for _, length, radius, middle, turn in capsules(motion, link):
        part = trimesh.creation.capsule(length, radius, _SECTIONS)
        part.apply_translation(-part.bounds.mean(0))
        parts.append(part.apply_transform(pose_matrices(middle[None], turn)[0]))
    return trimesh.util.concatenate(parts) if parts else None


def _object_mesh(motion: GraspMotion) -> trimesh.Trimesh:
    """The object's mesh in its frame."""
    return trimesh.Trimesh(motion.object_vertices, motion.object_faces, process=False)


def read(path: pathlib.Path) -> list[Track]:
    """The first animation at its keyframes, by the standard's layout, and the object's mesh as trimesh loads it."""
    content = path.read_bytes()
    size = int.from_bytes(content[12:16], "little")
    document, blob = json.loads(content[20 : 20 + size]), content[28 + size :]
    nodes, (animation, *_) = document["nodes"], document["animations"]

    def values(index: int) -> np.ndarray:
        """(n, width) float32 of an accessor."""
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        width = {kind: width for width, kind in _KINDS.items()}[accessor["type"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        return np.frombuffer(blob, "<f4", accessor["count"] * width, start).reshape(-1, width)

    time = values(animation["samplers"][0]["input"])[:, 0]
    local = [
        {"translation": np.array([node.get("translation", [0, 0, 0])]), "rotation": np.array([node["rotation"]])}
        for node in nodes
    ]
    for channel in animation["channels"]:
        target = channel["target"]
        local[target["node"]][target["path"]] = values(animation["samplers"][channel["sampler"]]["output"])
    poses: dict[str, np.ndarray] = {}

    def visit(index: int, parent: np.ndarray) -> None:
        """World poses of a node and those below it."""
        place, turn = (np.broadcast_to(v, (len(time), v.shape[1])) for v in local[index].values())
        name = nodes[index]["name"]
        poses[name] = parent @ pose_matrices(place, Rotation.from_quat(turn))
        for child in nodes[index].get("children", []):
            visit(child, poses[name])

    for root in document["scenes"][document["scene"]]["nodes"]:
        visit(root, FROM_Y_UP)
    del poses["world"]
    mesh = trimesh.load_scene(path, process=False).geometry[OBJECT]
    return [Track(time, poses, np.asarray(mesh.triangles))]
