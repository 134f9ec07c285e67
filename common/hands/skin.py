"""Surface of any hand: flesh for human hands; the file's meshes or bevelled housings for robots.

A surface is computed once, with every joint at zero, and moved with the links by linear blend
skinning.
"""

import functools
from typing import NamedTuple

import numpy as np

from congrasp.common import mirror
from congrasp.common.hands import right_name
from congrasp.common.hands.flesh import Skeleton, Surface, flesh, skeleton_of
from congrasp.common.hands.housings import housings
from congrasp.common.hands.meshes import Meshes, own_meshes
from congrasp.common.hands.nails import nails
from congrasp.common.hands.sleeve import sleeve
from congrasp.common.hands.spec import Hand, Link, link_origin
from congrasp.common.runtime.lazy_trimesh import trimesh

HUMAN_HANDS = ("human", "mano")
"""Names of hands with flesh."""
MATERIALS = ("flesh", "nail", "sleeve", "link", "joint")
"""Materials of a surface."""
_MAX_SIZE_M = 0.5
"""Size of a hand with flesh, m."""
_MIN_MEAN_NORMAL = 0.5
"""Length below which a mean of unit normals is one of rounding errors."""
_MIN_NORMAL = 1e-12
"""Length of a normal that has a direction."""


class Skin(NamedTuple):
    """V points and F triangles around L links, in the wrist frame with every joint at zero,
    metres.
    """

    points: np.ndarray
    """(V, 3) float32."""
    normals: np.ndarray
    """(V, 3) float32 unit."""
    faces: np.ndarray
    """(F, 3) int32, with outward normals."""
    weights: np.ndarray
    """(V, L) float32, at most four nonzero for each point; rows sum to one."""
    origins: np.ndarray
    """(L, 3) origins of the links' frames, whose axes are parallel to the wrist's."""
    material: np.ndarray
    """(V,) int, of each point: its index in `MATERIALS`. The points of a triangle have the same."""

    def parts(self) -> dict[str, np.ndarray]:
        """Faces (n, 3) of each material that there is."""
        material_of_face = self.material[self.faces[:, 0]]
        faces = {}
        for i, name in enumerate(MATERIALS):
            is_of_material = material_of_face == i
            if is_of_material.any():
                faces[name] = self.faces[is_of_material]
        return faces

    def influences(self) -> tuple[np.ndarray, np.ndarray]:
        """Links (V, 4) int with the greatest weights of each point, and the weights (V, 4); link 0
        if unused.
        """
        links = np.argsort(-self.weights, 1, kind="stable")[:, :4]
        if links.shape[1] < 4:
            links = np.pad(links, ((0, 0), (0, 4 - links.shape[1])))
        weights = np.take_along_axis(self.weights, links, 1)
        weights[:, self.weights.shape[1] :] = 0.0
        return np.where(weights > 0, links, 0), weights

    def posed(self, position: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (V, 3) and unit normals (V, 3) for link frames at (L, 3) with rotations (L, 3,
        3).
        """
        translation = position - np.einsum("lij,lj->li", rotation, self.origins)
        matrices = np.concatenate([rotation, translation[..., None]], -1)
        rows = matrices.reshape(len(matrices), 12).astype(np.float32)
        mixed = (self.weights @ rows).reshape(-1, 3, 4)
        mixed_rotation = mixed[..., :3]
        points = np.einsum("vij,vj->vi", mixed_rotation, self.points) + mixed[..., 3]
        normals = np.einsum("vij,vj->vi", mixed_rotation, self.normals)
        # The normals of a vertex between two links may cancel out
        lengths = np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), _MIN_NORMAL)
        return points, normals / lengths


@functools.lru_cache(maxsize=16)
def skin_of(hand: Hand) -> Skin:
    """Returns the surface of a hand, from its file's meshes if it is a custom one; they are loaded
    once per process.
    """
    meshes = own_meshes(hand)
    return skin_of_meshes(hand, meshes) if meshes else skin_on(skeleton_of(hand))


def skin_on(skeleton: Skeleton) -> Skin:
    """Returns the surface of the hand with this skeleton; a left hand's is the mirror image of the
    right hand's.
    """
    right, is_left = right_name(skeleton.hand)
    if is_left:
        mirrored = skeleton._replace(
            hand=right,
            origins=mirror.vector(skeleton.origins),
            capsules=mirror.vector(skeleton.capsules),
            anchors=mirror.vector(skeleton.anchors),
            axes=mirror.axial(skeleton.axes),
        )
        return _mirror_skin(skin_on(mirrored))
    if skeleton.hand in HUMAN_HANDS and _is_anatomical(skeleton):
        surface, material = _human_surface(skeleton)
    else:
        surface, is_joint = housings(skeleton)
        material = np.where(is_joint, MATERIALS.index("joint"), MATERIALS.index("link"))
    return Skin(
        surface.points.astype(np.float32),
        surface.normals.astype(np.float32),
        surface.faces.astype(np.int32),
        surface.weights.astype(np.float32),
        skeleton.origins,
        material,
    )


def _mirror_skin(skin: Skin) -> Skin:
    """Returns the mirror image of a surface."""
    return skin._replace(
        points=mirror.vector(skin.points),
        normals=mirror.vector(skin.normals),
        origins=mirror.vector(skin.origins),
        faces=skin.faces[:, ::-1].copy(),
    )


def _human_surface(skeleton: Skeleton) -> tuple[Surface, np.ndarray]:
    """Returns flesh, sleeve and nails as one surface, and the material (V,) of its points."""
    soft = flesh(skeleton)
    surfaces = [soft, sleeve(skeleton)]
    materials = ["flesh", "sleeve"]
    for nail in nails(skeleton, soft):
        surfaces.append(nail)
        materials.append("nail")
    counts = [len(surface.points) for surface in surfaces]
    firsts = np.cumsum([0, *counts[:-1]])
    faces = [surface.faces + first for surface, first in zip(surfaces, firsts, strict=True)]
    surface = Surface(
        points=np.concatenate([surface.points for surface in surfaces]),
        normals=np.concatenate([surface.normals for surface in surfaces]),
        faces=np.concatenate(faces),
        weights=np.concatenate([surface.weights for surface in surfaces]),
    )
    material_numbers = [MATERIALS.index(material) for material in materials]
    return surface, np.repeat(material_numbers, counts)


def skin_of_meshes(hand: Hand, meshes: Meshes) -> Skin:
    """Returns a surface of the links' meshes, each rigid, and the capsules of links without a
    mesh.
    """
    parts = []
    for link in hand.links:
        if link.name in meshes:
            vertices, faces = meshes[link.name]
            parts.append(trimesh.Trimesh(vertices, faces, process=False))
        else:
            parts.append(_capsule_mesh(link))
    counts = [len(part.vertices) for part in parts]
    starts = np.cumsum([0, *counts[:-1]])
    link_of_point = np.repeat(np.arange(len(parts)), counts)
    shifted_faces = [part.faces + start for part, start in zip(parts, starts, strict=True)]
    return Skin(
        points=np.concatenate([part.vertices for part in parts]).astype(np.float32),
        normals=np.concatenate([_unit_normals(part) for part in parts]).astype(np.float32),
        faces=np.concatenate(shifted_faces).astype(np.int32),
        weights=np.eye(len(parts), dtype=np.float32)[link_of_point],
        origins=np.array([link_origin(link) for link in hand.links]),
        material=np.full(sum(counts), MATERIALS.index("link")),
    )


def _unit_normals(mesh: "trimesh.Trimesh") -> np.ndarray:
    """Returns normals (V, 3) of a mesh's points.

    Where the faces around a point are back to back and cancel, it is the normal of one of them; of
    a point without a face that has an area, +z.
    """
    normals = np.array(mesh.vertex_normals)
    is_degenerate = np.linalg.norm(normals, axis=-1) < _MIN_MEAN_NORMAL
    substitutes = np.tile([0.0, 0.0, 1.0], (len(normals), 1))
    has_area = np.linalg.norm(mesh.face_normals, axis=-1) > _MIN_MEAN_NORMAL
    for corner in range(3):
        substitutes[mesh.faces[has_area, corner]] = mesh.face_normals[has_area]
    normals[is_degenerate] = substitutes[is_degenerate]
    return normals


def _capsule_mesh(link: Link) -> "trimesh.Trimesh":
    """Returns a mesh of a link's capsules, in the wrist frame at zero."""
    parts = []
    for capsule in link.capsules:
        way = np.subtract(capsule.end, capsule.start)
        part = trimesh.creation.capsule(float(np.linalg.norm(way)), capsule.radius, count=(12, 12))
        if way.any():
            part.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], way))
        parts.append(part.apply_translation(np.add(capsule.start, capsule.end) / 2))
    mesh = trimesh.util.concatenate(parts)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


def _is_anatomical(skeleton: Skeleton) -> bool:
    """True for a palm with a thumb and other fingers, with a capsule on each link, of a hand's
    size.
    """
    chains = skeleton.chains()
    if len(chains) < 3 or any(len(chain) < 2 for chain in chains):
        return False
    if not skeleton.names[chains[0][0]].startswith("thumb"):
        return False
    if {*skeleton.capsule_link.tolist()} != {*range(len(skeleton.names))}:
        return False
    extent = np.ptp(skeleton.capsules.reshape(-1, 3), axis=0).max()
    return float(extent + skeleton.radii.max()) < _MAX_SIZE_M
