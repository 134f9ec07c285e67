"""Binary glTF 2.0 with an animation.

Each link is a node with translation and rotation (glTF forbids matrices on animated nodes), nested
as in hand and arm. The hand's links are the joints of a skin, so that its surface follows them; the
arm's links have meshes. glTF is y-up: a root node turns the world, so that everything below it
keeps congrasp's z-up coordinates.
"""

import pathlib
from collections.abc import Sequence

import numpy as np
import pygltflib as gltf
import trimesh

from congrasp.common.episode.arm import Mesh
from congrasp.common.episode.episode import Episode
from congrasp.common.hands.skin import Skin
from congrasp.services.export.facts import facts
from congrasp.services.export.frames import OBJECT, SKIN, TO_Y_UP, bodies
from congrasp.services.export.surfaces import COLOURS, arm_meshes, object_mesh, skin_of_motion
from congrasp.services.export.texture_coordinates import unwrapped
from congrasp.services.viz.kernels import GAMMA
from congrasp.services.viz.triangles import smooth_corners

_KINDS = {1: gltf.SCALAR, 2: gltf.VEC2, 3: gltf.VEC3, 4: gltf.VEC4, 16: gltf.MAT4}
"""Kinds of accessors by the number of components of an item."""
_FLOAT = "<f4"
_INDEX = "<u4"
_JOINT = "<u2"
_COMPONENT_TYPES = {_FLOAT: gltf.FLOAT, _INDEX: gltf.UNSIGNED_INT, _JOINT: gltf.UNSIGNED_SHORT}
"""Types of components by NumPy's dtype."""


def write(path: pathlib.Path, motions: Sequence[Episode]) -> None:
    """Writes one motion."""
    (motion,) = motions
    scene = _Scene()
    file = scene.file
    about = facts(motion, frame="this node's frame: z up", unit="m", quaternion="x, y, z, w")
    file.asset.generator = "congrasp"
    file.nodes.append(gltf.Node(name="world", rotation=TO_Y_UP.as_quat().tolist(), extras=about))
    skin = skin_of_motion(motion)
    for name in skin.parts():
        scene.add_material(name, COLOURS[name])
    scene.object_material = scene.add_material(OBJECT, COLOURS[OBJECT])
    file.animations = [_add_bodies(scene, motion)]
    _add_skin(scene, skin)
    # A skinned mesh follows its joints alone, so that its node is at the root.
    file.scene = 0
    file.scenes = [gltf.Scene(name=motion.object, nodes=[0, len(file.nodes) - 1])]
    file.buffers = [gltf.Buffer(byteLength=len(scene.data))]
    file.set_binary_blob(bytes(scene.data))
    file.save_binary(str(path))


class _Scene:
    """A file under construction. Each `add` method returns the index of what it adds, in the list
    of its kind.

    Attributes:
      file: nodes, meshes, materials and accessors.
      data: values of all accessors.
      object_material: index of the object's material.
    """

    def __init__(self) -> None:
        self.file = gltf.GLTF2()
        self.data = bytearray()
        self.object_material = 0

    def add_values(
        self, values: np.ndarray, target: int | None = None, *, bounds: bool = False
    ) -> int:
        """Adds an accessor.

        Args:
          values: (n,), (n, 2), (n, 3), (n, 4) or (n, 4, 4); integers (n,) are indices of vertices,
            integers (n, 4) those of joints.
          target: use of the values on a GPU, as glTF names it.
          bounds: also stores the smallest and the largest values.
        """
        dtype = _FLOAT
        if np.issubdtype(values.dtype, np.integer):
            dtype = _INDEX if values.ndim == 1 else _JOINT
        if values.ndim == 3:
            values = values.swapaxes(1, 2).reshape(-1, 16)  # by columns
        values = np.ascontiguousarray(values, dtype)
        width = 1 if values.ndim == 1 else values.shape[1]
        view = gltf.BufferView(
            buffer=0, byteOffset=len(self.data), byteLength=values.nbytes, target=target
        )
        accessor = gltf.Accessor(
            bufferView=len(self.file.bufferViews),
            componentType=_COMPONENT_TYPES[dtype],
            count=len(values),
            type=_KINDS[width],
        )
        if bounds:
            accessor.min = np.atleast_1d(values.min(0)).tolist()
            accessor.max = np.atleast_1d(values.max(0)).tolist()
        self.file.bufferViews.append(view)
        self.file.accessors.append(accessor)
        self.data += values.tobytes()
        return len(self.file.accessors) - 1

    def add_node(self, node: gltf.Node, parent: int) -> int:
        """Adds a node below another."""
        self.file.nodes.append(node)
        number = len(self.file.nodes) - 1
        self.file.nodes[parent].children.append(number)
        return number

    def add_material(
        self, name: str, colour: Sequence[float], roughness: float | None = None
    ) -> int:
        """Adds a material of an sRGB colour: red, green, blue from 0 to 1. glTF has linear
        colours.
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
        """Returns the attributes of vertices, by their names in the standard."""
        accessors = {}
        for name, array in values.items():
            has_bounds = name == "POSITION"
            accessors[name] = self.add_values(array, gltf.ARRAY_BUFFER, bounds=has_bounds)
        return gltf.Attributes(**accessors)

    def primitive(
        self, attributes: gltf.Attributes, faces: np.ndarray, material: int
    ) -> gltf.Primitive:
        """Returns triangles (F, 3) between the vertices with these attributes.

        Args:
          attributes: see `attributes`.
          faces: indices of the vertices.
          material: index of the material.
        """
        indices = self.add_values(faces.ravel(), gltf.ELEMENT_ARRAY_BUFFER)
        return gltf.Primitive(attributes=attributes, indices=indices, material=material)


def _add_bodies(scene: _Scene, motion: Episode) -> gltf.Animation:
    """Adds a node for each body, nested as the bodies are; returns their animation."""
    animation = gltf.Animation(name="grasp")
    meshes_of_link = arm_meshes(motion)
    time = scene.add_values(motion.time, bounds=True)
    for body in bodies(motion):
        quaternions = body.quaternions(scalar_first=False)
        node = gltf.Node(
            name=body.name,
            translation=body.translation[0].tolist(),
            rotation=quaternions[0].tolist(),
        )
        number = scene.add_node(node, body.parent + 1)
        if body.name == OBJECT:
            node.mesh = scene.add_mesh(OBJECT, [_object(scene, motion)])
        elif body.name in meshes_of_link:
            primitives = [_arm_part(scene, mesh) for mesh in meshes_of_link[body.name]]
            node.mesh = scene.add_mesh(body.name, primitives)
        tracks = {"rotation": quaternions}
        if len(body.translation) > 1:
            tracks["translation"] = body.translation
        for name, values in tracks.items():
            target = gltf.AnimationChannelTarget(node=number, path=name)
            sampler = len(animation.samplers)
            animation.channels.append(gltf.AnimationChannel(sampler=sampler, target=target))
            output = scene.add_values(values)
            animation.samplers.append(gltf.AnimationSampler(input=time, output=output))
    return animation


def _object(scene: _Scene, motion: Episode) -> gltf.Primitive:
    """Returns the object's mesh with normals. If its points have colours, its material becomes
    white, since glTF multiplies both.
    """
    vertices, faces, colours = object_mesh(motion)
    flat = unwrapped(vertices, faces)
    arrays = {
        "POSITION": vertices[flat.source],
        "NORMAL": _normals(vertices, faces)[flat.source],
        "TEXCOORD_0": _downwards(flat.uv),
    }
    if colours is not None:
        arrays["COLOR_0"] = colours[flat.source] ** GAMMA  # linear
    attributes = scene.attributes(**arrays)
    if colours is not None:
        surface = scene.file.materials[scene.object_material].pbrMetallicRoughness
        surface.baseColorFactor = [1.0, 1.0, 1.0, 1.0]
    return scene.primitive(attributes, flat.faces, scene.object_material)


def _normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals (V, 3) of a mesh's points; +z at points between degenerate faces."""
    normals = trimesh.Trimesh(vertices, faces, process=False).vertex_normals
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(lengths > 0.5, normals / np.maximum(lengths, 1e-9), [0.0, 0.0, 1.0])


def _downwards(uv: np.ndarray) -> np.ndarray:
    """Texture coordinates (n, 2) with v downwards, as glTF has it."""
    return uv * [1, -1] + [0, 1]


def _arm_part(scene: _Scene, mesh: Mesh) -> gltf.Primitive:
    """Returns a mesh of an arm's link, with sharp edges and a material of its colour."""
    corners, corner_normals = smooth_corners(mesh.vertices, mesh.faces)  # without flat triangles
    positions = corners.reshape(-1, 3)
    normals = corner_normals.reshape(-1, 3)
    # Corners at one position become one vertex if they have the same normal.
    keys = np.column_stack([positions, normals.round(3)])
    _, first, faces = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    material = scene.add_material("arm", mesh.colour, roughness=0.5)
    attributes = scene.attributes(POSITION=positions[first], NORMAL=normals[first])
    return scene.primitive(attributes, faces, material)


def _add_skin(scene: _Scene, skin: Skin) -> None:
    """Adds the hand's surface as a separate node, whose skin has the links' nodes as joints.

    The materials of the skin's parts are the first ones of the file, in this order.
    """
    flat = unwrapped(skin.points, skin.faces)
    skin = skin._replace(
        points=skin.points[flat.source],
        normals=skin.normals[flat.source],
        weights=skin.weights[flat.source],
        material=skin.material[flat.source],
        faces=flat.faces,
    )
    links, weights = skin.influences()
    attributes = scene.attributes(
        POSITION=skin.points,
        NORMAL=skin.normals,
        TEXCOORD_0=_downwards(flat.uv),
        JOINTS_0=links,
        WEIGHTS_0=weights,
    )
    primitives = []
    for material, faces in enumerate(skin.parts().values()):
        primitives.append(scene.primitive(attributes, faces, material))
    inverse = np.tile(np.eye(4), (len(skin.origins), 1, 1))
    inverse[:, :3, 3] = -skin.origins
    joints = [1 + link for link in range(len(skin.origins))]  # node 0 is the world
    scene.file.skins = [
        gltf.Skin(name=SKIN, joints=joints, inverseBindMatrices=scene.add_values(inverse))
    ]
    scene.file.nodes.append(gltf.Node(name=SKIN, mesh=scene.add_mesh(SKIN, primitives), skin=0))
