"""Binary glTF 2.0 with an animation; written by pygltflib, read back by the standard's layout, its meshes by trimesh.

One node a link, nested as hand and arm are, with translation and rotation (glTF forbids matrices on animated nodes).
The hand's are the joints of a skin, by which its surface follows them; the arm's have meshes. glTF is y-up: a root node
turns the world, so that everything below it keeps congrasp's z-up coordinates.
"""

import json
import pathlib
from collections.abc import Sequence

import numpy as np
import pygltflib as gltf
import trimesh
from scipy.spatial.transform import Rotation

from congrasp.common.hands.skin import Skin
from congrasp.common.rotations import continuous
from congrasp.services.export.frames import (
    COLOURS,
    FROM_Y_UP,
    OBJECT,
    SKIN,
    TO_Y_UP,
    Track,
    arm_meshes,
    bodies,
    facts,
    object_mesh,
    pose_matrices,
    skin_of_motion,
)
from congrasp.services.export.motion_file import GraspMotion
from congrasp.services.export.unwrap import unwrapped
from congrasp.services.record.moved_arm import Mesh
from congrasp.services.viz.kernels import GAMMA
from congrasp.services.viz.triangles import smooth_corners

_KINDS = {1: gltf.SCALAR, 2: gltf.VEC2, 3: gltf.VEC3, 4: gltf.VEC4, 16: gltf.MAT4}


def write(path: pathlib.Path, motions: Sequence[GraspMotion]) -> None:
    """Writes one motion."""
    (motion,) = motions
    file, data, grasp = gltf.GLTF2(), bytearray(), gltf.Animation(name="grasp")
    about = facts(motion, frame="this node's frame: z up", unit="m", quaternion="x, y, z, w")
    file.asset.generator = "congrasp"
    file.nodes.append(gltf.Node(name="world", rotation=TO_Y_UP.as_quat().tolist(), extras=about))
    skin, arm = skin_of_motion(motion), arm_meshes(motion)
    for name in (*skin.parts(), OBJECT):
        surface = gltf.PbrMetallicRoughness(baseColorFactor=[*COLOURS[name], 1.0], metallicFactor=0.0)
        file.materials.append(gltf.Material(name=name, pbrMetallicRoughness=surface))
    time = _add(file, data, motion.time, bounds=True)
    for body in bodies(motion):
        number, first = len(file.nodes), body.rotation[0].as_quat()
        node = gltf.Node(name=body.name, translation=body.translation[0].tolist(), rotation=first.tolist())
        file.nodes.append(node)
        file.nodes[body.parent + 1].children.append(number)
        if body.name == OBJECT:
            node.mesh = len(file.meshes)
            file.meshes.append(gltf.Mesh(name=OBJECT, primitives=[_primitive(file, data, *object_mesh(motion))]))
        elif body.name in arm:
            node.mesh = len(file.meshes)
            file.meshes.append(gltf.Mesh(name=body.name, primitives=[_part(file, data, m) for m in arm[body.name]]))
        tracks = {"rotation": continuous(body.rotation.as_quat(scalar_first=False))}
        if len(body.translation) > 1:
            tracks["translation"] = body.translation
        for name, values in tracks.items():
            target = gltf.AnimationChannelTarget(node=number, path=name)
            grasp.channels.append(gltf.AnimationChannel(sampler=len(grasp.samplers), target=target))
            grasp.samplers.append(gltf.AnimationSampler(input=time, output=_add(file, data, values)))
    _add_skin(file, data, skin)
    file.animations = [grasp]
    # A skinned mesh follows its joints alone, so that its node is at the root.
    file.scene, file.scenes = 0, [gltf.Scene(name=motion.object, nodes=[0, len(file.nodes) - 1])]
    file.buffers = [gltf.Buffer(byteLength=len(data))]
    file.set_binary_blob(bytes(data))
    file.save_binary(str(path))


def _add(
    file: gltf.GLTF2, data: bytearray, values: np.ndarray, target: int | None = None, *, bounds: bool = False
) -> int:
    """Appends values (n,), (n, 2), (n, 3), (n, 4) or (n, 4, 4) to the buffer; returns the new accessor's number.

    Integers (n,) are indices, (n, 4) numbers of joints; matrices are given by rows.
    """
    whole = np.issubdtype(values.dtype, np.integer)
    kind = ("<u4", gltf.UNSIGNED_INT) if whole and values.ndim == 1 else ("<u2", gltf.UNSIGNED_SHORT)
    kind = kind if whole else ("<f4", gltf.FLOAT)
    if values.ndim == 3:
        values = values.swapaxes(1, 2).reshape(-1, 16)  # by columns
    values = np.ascontiguousarray(values, kind[0])
    view = gltf.BufferView(buffer=0, byteOffset=len(data), byteLength=values.nbytes, target=target)
    accessor = gltf.Accessor(
        bufferView=len(file.bufferViews),
        componentType=kind[1],
        count=len(values),
        type=_KINDS[1 if values.ndim == 1 else values.shape[1]],
    )
    if bounds:
        accessor.min, accessor.max = (np.atleast_1d(end).tolist() for end in (values.min(0), values.max(0)))
    file.bufferViews.append(view)
    file.accessors.append(accessor)
    data += values.tobytes()
    return len(file.accessors) - 1


def _primitive(
    file: gltf.GLTF2, data: bytearray, vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray | None
) -> gltf.Primitive:
    """The object's mesh with normals and its material, which is white if the points have colours."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    normals = mesh.vertex_normals
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(lengths > 0.5, normals / np.maximum(lengths, 1e-9), [0.0, 0.0, 1.0])  # of unused vertices
    flat = unwrapped(vertices, faces)
    attributes = gltf.Attributes(
        POSITION=_add(file, data, vertices[flat.source], gltf.ARRAY_BUFFER, bounds=True),
        NORMAL=_add(file, data, normals[flat.source], gltf.ARRAY_BUFFER),
        TEXCOORD_0=_add(file, data, flat.uv * [1, -1] + [0, 1], gltf.ARRAY_BUFFER),  # v downwards, as glTF has it
    )
    if colours is not None:
        linear = colours[flat.source] ** 2.2  # as glTF has them
        attributes.COLOR_0 = _add(file, data, linear, gltf.ARRAY_BUFFER)
        file.materials[-1].pbrMetallicRoughness.baseColorFactor = [1.0, 1.0, 1.0, 1.0]
    indices = _add(file, data, flat.faces.ravel(), gltf.ELEMENT_ARRAY_BUFFER)
    return gltf.Primitive(attributes=attributes, indices=indices, material=len(file.materials) - 1)


def _part(file: gltf.GLTF2, data: bytearray, mesh: Mesh) -> gltf.Primitive:
    """A mesh of an arm's link, with sharp edges and a separate material."""
    corners, (_, normals) = mesh.faces.ravel(), smooth_corners(mesh.vertices, mesh.faces)
    normals = normals.reshape(-1, 3)
    keys = np.column_stack([corners, normals.round(3)])
    _, first, faces = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    linear = [*(np.array(mesh.colour) ** GAMMA).tolist(), 1.0]
    surface = gltf.PbrMetallicRoughness(baseColorFactor=linear, metallicFactor=0.0, roughnessFactor=0.5)
    file.materials.append(gltf.Material(name="arm", pbrMetallicRoughness=surface))
    attributes = gltf.Attributes(
        POSITION=_add(file, data, mesh.vertices[corners[first]], gltf.ARRAY_BUFFER, bounds=True),
        NORMAL=_add(file, data, normals[first], gltf.ARRAY_BUFFER),
    )
    indices = _add(file, data, faces.ravel(), gltf.ELEMENT_ARRAY_BUFFER)
    return gltf.Primitive(attributes=attributes, indices=indices, material=len(file.materials) - 1)


def _add_skin(file: gltf.GLTF2, data: bytearray, skin: Skin) -> None:
    """Adds the hand's surface as a separate node, whose skin has the links' nodes (from 1 on) as joints."""
    flat = unwrapped(skin.points, skin.faces)
    own = {name: getattr(skin, name)[flat.source] for name in ("points", "normals", "weights", "material")}
    skin = skin._replace(faces=flat.faces, **own)
    links, weights = skin.influences()
    attributes = gltf.Attributes(
        POSITION=_add(file, data, skin.points, gltf.ARRAY_BUFFER, bounds=True),
        NORMAL=_add(file, data, skin.normals, gltf.ARRAY_BUFFER),
        TEXCOORD_0=_add(file, data, flat.uv * [1, -1] + [0, 1], gltf.ARRAY_BUFFER),
        JOINTS_0=_add(file, data, links, gltf.ARRAY_BUFFER),
        WEIGHTS_0=_add(file, data, weights, gltf.ARRAY_BUFFER),
    )
    primitives = []
    for material, part in enumerate(skin.parts().values()):
        indices = _add(file, data, part.ravel(), gltf.ELEMENT_ARRAY_BUFFER)
        primitives.append(gltf.Primitive(attributes=attributes, indices=indices, material=material))
    inverse = np.tile(np.eye(4), (len(skin.origins), 1, 1))
    inverse[:, :3, 3] = -skin.origins
    joints = [1 + link for link in range(len(skin.origins))]
    file.skins = [gltf.Skin(name=SKIN, joints=joints, inverseBindMatrices=_add(file, data, inverse))]
    file.nodes.append(gltf.Node(name=SKIN, mesh=len(file.meshes), skin=0))
    file.meshes.append(gltf.Mesh(name=SKIN, primitives=primitives))


def read(path: pathlib.Path) -> list[Track]:
    """The first animation at its keyframes, by the standard's layout, and the meshes as trimesh loads them."""
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
        {
            "translation": np.array([node.get("translation", [0, 0, 0])]),
            "rotation": np.array([node.get("rotation", [0, 0, 0, 1])]),
        }
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
        if "skin" not in nodes[root]:
            visit(root, FROM_Y_UP)
    del poses["world"]
    meshes = trimesh.load_scene(path, process=False, merge_primitives=True).geometry
    return [Track(time, poses, {name: np.asarray(mesh.triangles) for name, mesh in meshes.items() if name != SKIN})]
