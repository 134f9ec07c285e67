"""Binary glTF 2.0 with an animation; written here, read back by pygltflib.

One node a link, nested as the hand is, with translation and rotation (glTF forbids matrices on animated nodes). glTF
is y-up: a root node turns the world, so that everything below it keeps congrasp's z-up coordinates.
"""

import json
import pathlib
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from services.export.frames import FROM_Y_UP, OBJECT, TO_Y_UP, Body, Track, bodies, facts, pose_matrices, quaternions
from services.export.motion_file import GraspMotion

_FLOAT, _UNSIGNED = 5126, 5125
_VERTICES, _INDICES = 34962, 34963
_COLOURS = {"hand": (0.70, 0.73, 0.79, 1.0), OBJECT: (0.95, 0.62, 0.24, 1.0)}
_SECTIONS = (12, 12)
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


class _Buffer:
    """The binary chunk under construction, and the JSON that describes it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, values: np.ndarray, kind: int, target: int | None = None, *, bounds: bool = False) -> int:
        """Index of a new accessor for values (n,) or (n, 3) or (n, 4)."""
        values = np.ascontiguousarray(values, "<f4" if kind == _FLOAT else "<u4")
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": values.nbytes}
        self.views.append(view if target is None else {**view, "target": target})
        self.data += values.tobytes()
        width = 1 if values.ndim == 1 else values.shape[1]
        accessor: dict[str, Any] = {
            "bufferView": len(self.views) - 1,
            "componentType": kind,
            "count": len(values),
            "type": _KINDS[width],
        }
        if bounds:
            accessor["min"] = np.atleast_1d(values.min(0)).tolist()
            accessor["max"] = np.atleast_1d(values.max(0)).tolist()
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def write(path: pathlib.Path, motions: Sequence[GraspMotion]) -> None:
    """Writes one motion."""
    (motion,) = motions
    buffer, meshes, found = _Buffer(), [], bodies(motion)
    nodes: list[dict[str, Any]] = [
        {
            "name": "world",
            "rotation": TO_Y_UP.as_quat().tolist(),
            "children": [],
            "extras": facts(motion, frame="this node's frame: z up", unit="m", quaternion="x, y, z, w"),
        }
    ]
    time = buffer.add(motion.time, _FLOAT, bounds=True)
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []
    for i, body in enumerate(found):
        node = _node(body)
        mesh = _object_mesh(motion) if body.name == OBJECT else _link_mesh(motion, i)
        if mesh is not None:
            meshes.append(_mesh(buffer, body.name, mesh))
            node["mesh"] = len(meshes) - 1
        nodes.append(node)
        nodes[body.parent + 1].setdefault("children", []).append(len(nodes) - 1)
        tracks = {"rotation": quaternions(body.rotation, scalar_first=False)}
        if len(body.translation) > 1:
            tracks["translation"] = body.translation
        for target, values in tracks.items():
            samplers.append({"input": time, "output": buffer.add(values, _FLOAT), "interpolation": "LINEAR"})
            channels.append({"sampler": len(samplers) - 1, "target": {"node": len(nodes) - 1, "path": target}})
    document = {
        "asset": {"version": "2.0", "generator": "congrasp"},
        "scene": 0,
        "scenes": [{"name": motion.object, "nodes": [0]}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": [
            {"name": name, "pbrMetallicRoughness": {"baseColorFactor": colour, "metallicFactor": 0.0}}
            for name, colour in _COLOURS.items()
        ],
        "animations": [{"name": "grasp", "samplers": samplers, "channels": channels}],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    chunks = _chunk(b"JSON", text, b" ") + _chunk(b"BIN\0", bytes(buffer.data), b"\0")
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def _chunk(kind: bytes, data: bytes, padding: bytes) -> bytes:
    data += padding * (-len(data) % 4)
    return struct.pack("<I4s", len(data), kind) + data


def _node(body: Body) -> dict[str, Any]:
    first = body.rotation[0].as_quat()
    return {"name": body.name, "translation": body.translation[0].tolist(), "rotation": first.tolist()}


def _link_mesh(motion: GraspMotion, link: int) -> Any:
    """The link's capsules in its frame; None if it has none."""
    parts = []
    for k in np.flatnonzero(motion.capsule_link == link):
        (start, end), radius = motion.capsule_ends[k].astype(float), float(motion.capsule_radius[k])
        length = float(np.linalg.norm(end - start))
        part = trimesh.creation.capsule(length, radius, _SECTIONS)
        part.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], end - start) if length else np.eye(4))
        # trimesh centres a capsule at its middle.
        part.apply_translation((start + end) / 2 - part.bounds.mean(0))
        parts.append(part)
    return trimesh.util.concatenate(parts) if parts else None


def _object_mesh(motion: GraspMotion) -> trimesh.Trimesh:
    return trimesh.Trimesh(motion.object_vertices, motion.object_faces, process=False)


def _mesh(buffer: _Buffer, name: str, mesh: trimesh.Trimesh) -> dict[str, Any]:
    normals = mesh.vertex_normals
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(lengths > 0.5, normals / np.maximum(lengths, 1e-9), [0.0, 0.0, 1.0])  # of unused vertices
    attributes = {
        "POSITION": buffer.add(mesh.vertices, _FLOAT, _VERTICES, bounds=True),
        "NORMAL": buffer.add(normals, _FLOAT, _VERTICES),
    }
    material = list(_COLOURS).index(OBJECT if name == OBJECT else "hand")
    indices = buffer.add(mesh.faces.ravel(), _UNSIGNED, _INDICES)
    return {"name": name, "primitives": [{"attributes": attributes, "indices": indices, "material": material}]}


def read(path: pathlib.Path) -> list[Track]:
    """What pygltflib finds in a file: its first animation, played at its keyframes."""
    from pygltflib import GLTF2

    file = GLTF2().load_binary(str(path))
    assert file is not None
    blob = file.binary_blob()

    def values(index: int) -> np.ndarray:
        accessor = file.accessors[index]
        view = file.bufferViews[accessor.bufferView]
        width = {kind: n for n, kind in _KINDS.items()}[accessor.type]
        start = view.byteOffset + (accessor.byteOffset or 0)
        kind = {_FLOAT: "<f4", _UNSIGNED: "<u4"}[accessor.componentType]
        flat = np.frombuffer(blob, kind, accessor.count * width, start)
        return flat.reshape(accessor.count, width) if width > 1 else flat

    animation = file.animations[0]
    time = values(animation.samplers[0].input)
    local: dict[int, dict[str, np.ndarray]] = {
        i: {"translation": np.array([node.translation or [0, 0, 0]]), "rotation": np.array([node.rotation])}
        for i, node in enumerate(file.nodes)
    }
    for channel in animation.channels:
        sampler = animation.samplers[channel.sampler]
        local[channel.target.node][channel.target.path] = values(sampler.output)
    poses: dict[str, np.ndarray] = {}

    def visit(index: int, parent: np.ndarray) -> None:
        track = {name: np.broadcast_to(v, (len(time), v.shape[1])) for name, v in local[index].items()}
        poses[file.nodes[index].name] = parent @ pose_matrices(
            track["translation"], Rotation.from_quat(track["rotation"])
        )
        for child in file.nodes[index].children or []:
            visit(child, poses[file.nodes[index].name])

    for root in file.scenes[file.scene].nodes:
        visit(root, FROM_Y_UP)
    del poses["world"]
    mesh = next(file.meshes[node.mesh] for node in file.nodes if node.name == OBJECT)
    corners = values(mesh.primitives[0].attributes.POSITION)[values(mesh.primitives[0].indices)]
    return [Track(time, poses, corners.reshape(-1, 3, 3))]
