"""Binary glTF 2.0 with an animation.

One node a link, nested as hand and arm are, with translation and rotation (glTF forbids matrices on
animated nodes). The hand's are the joints of a skin, by which its surface follows them; the arm's
have meshes. glTF is y-up: a root node turns the world, so that everything below it keeps congrasp's
z-up coordinates.
"""

import pathlib
from collections.abc import Sequence

import numpy as np
import pygltflib as gltf
import trimesh

from congrasp.common.episode.arm import Mesh
from congrasp.common.episode.episode import Episode
from congrasp.common.hands.skin import Skin
from congrasp.services.export.frames import (
    COLOURS,
    OBJECT,
    SKIN,
    TO_Y_UP,
    arm_meshes,
    bodies,
    facts,
    object_mesh,
    skin_of_motion,
    unwrapped,
)
from congrasp.services.viz.kernels import GAMMA
from congrasp.services.viz.triangles import smooth_corners

_KINDS = {1: gltf.SCALAR, 2: gltf.VEC2, 3: gltf.VEC3, 4: gltf.VEC4, 16: gltf.MAT4}
_NUMBERS = {"<f4": gltf.FLOAT, "<u4": gltf.UNSIGNED_INT, "<u2": gltf.UNSIGNED_SHORT}


def write(path: pathlib.Path, motions: Sequence[Episode]) -> None:
    """Writes one motion."""
    (motion,) = motions
    scene = _Scene()
    file, grasp = scene.file, gltf.Animation(name="grasp")
    about = facts(motion, frame="this node's frame: z up", unit="m", quaternion="x, y, z, w")
    file.asset.generator = "congrasp"
    file.nodes.append(gltf.Node(name="world", rotation=TO_Y_UP.as_quat().tolist(), extras=about))
    skin, arm = skin_of_motion(motion), arm_meshes(motion)
    for name in (*skin.parts(), OBJECT):
        scene.add_material(name, COLOURS[name])
    time = scene.add_values(motion.time, bounds=True)
    for body in bodies(motion):
        number, turns = len(file.nodes), body.quaternions(scalar_first=False)
        node = gltf.Node(
            name=body.name, translation=body.translation[0].tolist(), rotation=turns[0].tolist()
        )
        file.nodes.append(node)
        file.nodes[body.parent + 1].children.append(number)
        if body.name == OBJECT:
            node.mesh = scene.add_mesh(OBJECT, [_object(scene, motion)])
        elif body.name in arm:
            node.mesh = scene.add_mesh(body.name, [_part(scene, mesh) for mesh in arm[body.name]])
        tracks = {"rotation": turns}
        if len(body.translation) > 1:
            tracks["translation"] = body.translation
        for name, values in tracks.items():
            target = gltf.AnimationChannelTarget(node=number, path=name)
            grasp.channels.append(gltf.AnimationChannel(sampler=len(grasp.samplers), target=target))
            grasp.samplers.append(
                gltf.AnimationSampler(input=time, output=scene.add_values(values))
            )
    _add_skin(scene, skin)
    file.animations = [grasp]
    # A skinned mesh follows its joints alone, so that its node is at the root.
    file.scene, file.scenes = 0, [gltf.Scene(name=motion.object, nodes=[0, len(file.nodes) - 1])]
    file.buffers = [gltf.Buffer(byteLength=len(scene.data))]
    file.set_binary_blob(bytes(scene.data))
    file.save_binary(str(path))


class _Scene:
    """A file under construction; every method returns the index of what it adds."""

    def __init__(self) -> None:
        self.file, self.data = gltf.GLTF2(), bytearray()

    def add_values(
        self, values: np.ndarray, target: int | None = None, *, bounds: bool = False
    ) -> int:
        """Adds values (n,), (n, 2), (n, 3), (n, 4) or (n, 4, 4); integers (n,) are indices, (n, 4)
        those of joints.
        """
        whole = np.issubdtype(values.dtype, np.integer)
        number = ("<u4" if values.ndim == 1 else "<u2") if whole else "<f4"
        if values.ndim == 3:
            values = values.swapaxes(1, 2).reshape(-1, 16)  # by columns
        values = np.ascontiguousarray(values, number)
        kind = _KINDS[1 if values.ndim == 1 else values.shape[1]]
        view = gltf.BufferView(
            buffer=0, byteOffset=len(self.data), byteLength=values.nbytes, target=target
        )
        accessor = gltf.Accessor(
            bufferView=len(self.file.bufferViews),
            componentType=_NUMBERS[number],
            count=len(values),
            type=kind,
        )
        if bounds:
            accessor.min, accessor.max = (
                np.atleast_1d(end).tolist() for end in (values.min(0), values.max(0))
            )
        self.file.bufferViews.append(view)
        self.file.accessors.append(accessor)
        self.data += values.tobytes()
        return len(self.file.accessors) - 1

    def add_material(
        self, name: str, colour: Sequence[float], roughness: float | None = None
    ) -> int:
        """Adds a material of an sRGB colour, red, green, blue from 0 to 1; glTF takes linear
        factors.
        """
        linear = (np.array(colour) ** GAMMA).tolist()
        surface = gltf.PbrMetallicRoughness(baseColorFactor=[*linear, 1.0], metallicFactor=0.0)
        if roughness is not None:
            surface.roughnessFactor = roughness
        self.file.materials.append(gltf.Material(name=name, pbrMetallicRoughness=surface))
        return len(self.file.materials) - 1

    def add_mesh(self, name: str, primitives: list[gltf.Primitive]) -> int:
        """Adds a mesh."""
        self.file.meshes.append(gltf.Mesh(name=name, primitives=primitives))
        return len(self.file.meshes) - 1

    def attributes(self, **values: np.ndarray) -> gltf.Attributes:
        """Attributes of vertices by their names in the standard."""
        return gltf.Attributes(
            **{
                name: self.add_values(v, gltf.ARRAY_BUFFER, bounds=name == "POSITION")
                for name, v in values.items()
            }
        )

    def primitive(
        self, attributes: gltf.Attributes, faces: np.ndarray, material: int
    ) -> gltf.Primitive:
        """Triangles (F, 3) between vertices."""
        indices = self.add_values(faces.ravel(), gltf.ELEMENT_ARRAY_BUFFER)
        return gltf.Primitive(attributes=attributes, indices=indices, material=material)


def _object(scene: _Scene, motion: Episode) -> gltf.Primitive:
    """The object's mesh with normals and the last material, which becomes white if the points have
    colours.
    """
    vertices, faces, colours = object_mesh(motion)
    normals = trimesh.Trimesh(vertices, faces, process=False).vertex_normals
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    # Of degenerate faces
    normals = np.where(lengths > 0.5, normals / np.maximum(lengths, 1e-9), [0.0, 0.0, 1.0])
    flat = unwrapped(vertices, faces)
    paint = {} if colours is None else {"COLOR_0": colours[flat.source] ** GAMMA}  # linear
    attributes = scene.attributes(
        POSITION=vertices[flat.source],
        NORMAL=normals[flat.source],
        TEXCOORD_0=_downwards(flat.uv),
        **paint,
    )
    if paint:
        scene.file.materials[-1].pbrMetallicRoughness.baseColorFactor = [1.0, 1.0, 1.0, 1.0]
    return scene.primitive(attributes, flat.faces, len(scene.file.materials) - 1)


def _downwards(uv: np.ndarray) -> np.ndarray:
    """Texture coordinates (n, 2) with v downwards, as glTF has it."""
    return uv * [1, -1] + [0, 1]


def _part(scene: _Scene, mesh: Mesh) -> gltf.Primitive:
    """A mesh of an arm's link, with sharp edges and a separate material."""
    corners, (_, normals) = mesh.faces.ravel(), smooth_corners(mesh.vertices, mesh.faces)
    normals = normals.reshape(-1, 3)
    keys = np.column_stack([corners, normals.round(3)])
    _, first, faces = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    material = scene.add_material("arm", mesh.colour, roughness=0.5)
    attributes = scene.attributes(POSITION=mesh.vertices[corners[first]], NORMAL=normals[first])
    return scene.primitive(attributes, faces, material)


def _add_skin(scene: _Scene, skin: Skin) -> None:
    """Adds the hand's surface as a separate node, whose skin has the links' nodes (from 1 on) as
    joints.
    """
    flat = unwrapped(skin.points, skin.faces)
    own = {
        name: getattr(skin, name)[flat.source]
        for name in ("points", "normals", "weights", "material")
    }
    skin = skin._replace(faces=flat.faces, **own)
    links, weights = skin.influences()
    attributes = scene.attributes(
        POSITION=skin.points,
        NORMAL=skin.normals,
        TEXCOORD_0=_downwards(flat.uv),
        JOINTS_0=links,
        WEIGHTS_0=weights,
    )
    primitives = [
        scene.primitive(attributes, part, number)
        for number, part in enumerate(skin.parts().values())
    ]
    inverse = np.tile(np.eye(4), (len(skin.origins), 1, 1))
    inverse[:, :3, 3] = -skin.origins
    joints = [1 + link for link in range(len(skin.origins))]
    scene.file.skins = [
        gltf.Skin(name=SKIN, joints=joints, inverseBindMatrices=scene.add_values(inverse))
    ]
    scene.file.nodes.append(gltf.Node(name=SKIN, mesh=scene.add_mesh(SKIN, primitives), skin=0))
