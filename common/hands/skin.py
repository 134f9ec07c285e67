"""Surface of any hand: flesh for human hands; the file's meshes or bevelled housings for robots.

A surface is computed once, with every joint at zero, and moved with the links by linear blend
skinning.
"""

import functools
import itertools
from typing import Any, NamedTuple

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from congrasp.common import mirror
from congrasp.common.hands.flesh import Skeleton, Surface, flesh, skeleton_of, wrist_circles
from congrasp.common.hands.left import right_name
from congrasp.common.hands.meshes import Meshes, own_meshes
from congrasp.common.hands.spec import Hand, Link, link_origin

HUMAN_HANDS = ("human", "mano")
"""Names of hands with flesh."""
MATERIALS = ("flesh", "nail", "sleeve", "link", "joint")
"""Materials of a surface."""
_MAX_SIZE = 0.5
"""Size of a hand with flesh, m."""
_SHORT_NORMAL = 0.5
"""Length below which a mean of unit normals is one of rounding errors."""
_SMALLEST_LENGTH = 1e-12
"""Length of a normal that has a direction."""
_SECTIONS = 20
"""Sides of a housing."""
_BEVEL = 0.45
"""Bevel of a housing's ends, in radii."""
_DRUM_RADIUS = 0.72
"""Radius of a joint's drum, in radii of its link."""
_DRUM_LENGTH = 1.04
"""Half length of a joint's drum, in radii of its link."""
_AROUND = 28
"""Points of a ring."""
_NAIL = (
    (0.2, 0.0005),
    (0.55, 0.0005),
    (0.9, 0.0004),
    (1.0, 0.0001),
    (0.9, -0.0012),
    (0.2, -0.0012),
)
"""Rings of a nail: size as a share of the nail's outline, and height above the skin, m."""
_NAIL_WIDTH = 0.90
"""Half width of a nail, rad about the finger."""
_NAIL_LENGTH = 0.85
"""Half length of a nail, in radii of the fingertip."""
_NAIL_BACK = 0.30
"""Distance of a nail behind the centre of the fingertip, in radii of the fingertip."""
_SQUARE = 0.65
"""Exponent of the nail's outline; 1 is an ellipse."""
_SLEEVE = (
    *((0.026, -0.004), (0.0245, 0.0008), (0.0245, 0.0030), (0.0265, 0.0042), (0.034, 0.0044)),
    *((0.036, 0.0034), (0.060, 0.0042), (0.082, 0.0056), (0.086, 0.0040)),
)
"""Rings of the sleeve: distance behind the start of the wrist, and radius in excess of the wrist's,
m.
"""


def nails(skeleton: Skeleton, skin: Surface) -> list[Surface]:
    """A nail on the back of each fingertip that a joint bends; it moves with the skin below it."""
    surfaces = []
    skin_points = cKDTree(skin.points)
    for chain in skeleton.chains():
        bends = np.flatnonzero(skeleton.joint_link == chain[-1])
        if not len(bends):
            continue
        capsule = np.flatnonzero(skeleton.capsule_link == chain[-1])[0]
        (start, end), radius = skeleton.capsules[capsule], skeleton.radii[capsule]
        along = (end - start) / np.linalg.norm(end - start)
        back = -np.cross(skeleton.axes[bends[-1]], along)
        back = back / np.linalg.norm(back)
        angle = 2 * np.pi * np.arange(_AROUND) / _AROUND
        outline = [
            np.sign(wave) * np.abs(wave) ** _SQUARE for wave in (np.cos(angle), np.sin(angle))
        ]
        rings = []
        for share, height in _NAIL:
            turn = _NAIL_WIDTH * share * outline[0]
            place = radius * (_NAIL_LENGTH * share * outline[1] - _NAIL_BACK)
            radial = np.cos(turn)[:, None] * back + np.sin(turn)[:, None] * np.cross(along, back)
            # Over the ball at the finger's end
            down = np.clip(place / radius, 0, np.pi / 2)[:, None]
            out = np.cos(down) * radial + np.sin(down) * along
            rings.append(end + np.minimum(place, 0)[:, None] * along + (radius + height) * out)
        nail = _shell(np.array(rings), chain[-1], len(skeleton.names))
        nearest = skin_points.query(nail.points)[1]
        weights = skin.weights[nearest].mean(0)
        surfaces.append(nail._replace(weights=np.tile(weights, (len(nail.points), 1))))
    return surfaces


def sleeve(skeleton: Skeleton) -> Surface:
    """A cuff around the wrist, which follows the palm."""
    centres, radii, back = wrist_circles(skeleton)
    side = np.cross(back, centres[-1] - centres[0])
    axes = np.stack([np.cross(side, back), side])
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    angle = 2 * np.pi * np.arange(_AROUND) / _AROUND
    out = np.stack([np.cos(angle), np.sin(angle)], -1) @ axes
    # The circle that the outline touches in each direction
    farthest = (centres @ out.T + radii[:, None]).argmax(0)
    rings = [
        centres[farthest] + (radii[farthest] + wider)[:, None] * out + behind * back
        for behind, wider in _SLEEVE
    ]
    return _shell(np.array(rings), 0, len(skeleton.names))


def _shell(rings: np.ndarray, link: int, links: int) -> Surface:
    """The closed surface through rings (R, S, 3), flat at both ends, which follows one link."""
    count, around = rings.shape[:2]
    points = np.concatenate([rings.reshape(-1, 3), rings[[0, -1]].mean(1)])
    here = np.arange(around)
    after = np.roll(here, -1)
    faces = [np.stack([after, here, np.full(around, count * around)], -1)]
    for first in around * np.arange(count - 1):
        a, b, c, d = first + here, first + after, first + around + here, first + around + after
        faces += [np.stack([a, b, c], -1), np.stack([b, d, c], -1)]
    last = (count - 1) * around
    faces.append(np.stack([last + here, last + after, np.full(around, count * around + 1)], -1))
    mesh = trimesh.Trimesh(points, np.concatenate(faces), process=False)
    if mesh.volume < 0:
        mesh.invert()
    weights = np.zeros((len(points), links))
    weights[:, link] = 1.0
    return Surface(points, np.array(mesh.vertex_normals), np.array(mesh.faces), weights)


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
        of_face = self.material[self.faces[:, 0]]
        return {
            name: self.faces[of_face == i]
            for i, name in enumerate(MATERIALS)
            if (of_face == i).any()
        }

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
        lengths = np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), _SMALLEST_LENGTH)
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
    right, left = right_name(skeleton.hand)
    if left:
        own: dict[str, Any] = _mirrored(skeleton, ("origins", "capsules", "anchors"))
        skin = skin_on(skeleton._replace(hand=right, axes=mirror.axial(skeleton.axes), **own))
        return skin._replace(
            faces=skin.faces[:, ::-1].copy(), **_mirrored(skin, ("points", "normals", "origins"))
        )
    if skeleton.hand in HUMAN_HANDS and _anatomical(skeleton):
        soft = flesh(skeleton)
        kinds = (
            ("flesh", soft),
            ("sleeve", sleeve(skeleton)),
            *(("nail", nail) for nail in nails(skeleton, soft)),
        )
        material = np.concatenate(
            [np.full(len(part.points), MATERIALS.index(kind)) for kind, part in kinds]
        )
        firsts = np.cumsum([0, *(len(part.points) for _, part in kinds)])
        faces = [part.faces + first for (_, part), first in zip(kinds, firsts, strict=False)]
        points, normals, weights = (
            np.concatenate([part[k] for _, part in kinds]) for k in (0, 1, 3)
        )
        surface = Surface(points, normals, np.concatenate(faces), weights)
    else:
        surface, joint = _housings(skeleton)
        material = np.where(joint, MATERIALS.index("joint"), MATERIALS.index("link"))
    return Skin(
        surface.points.astype(np.float32),
        surface.normals.astype(np.float32),
        surface.faces.astype(np.int32),
        surface.weights.astype(np.float32),
        skeleton.origins,
        material,
    )


def _mirrored(shape: Skeleton | Skin, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Mirrored points of a shape, by their names."""
    return {name: mirror.vector(getattr(shape, name)) for name in names}


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
            parts.append(_rounded(link))
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


def _unit_normals(mesh: trimesh.Trimesh) -> np.ndarray:
    """Returns normals (V, 3) of a mesh's points.

    Where the faces around a point are back to back and cancel, it is the normal of one of them; of
    a point without a face that has an area, +z.
    """
    normals = np.array(mesh.vertex_normals)
    is_degenerate = np.linalg.norm(normals, axis=-1) < _SHORT_NORMAL
    substitutes = np.tile([0.0, 0.0, 1.0], (len(normals), 1))
    has_area = np.linalg.norm(mesh.face_normals, axis=-1) > _SHORT_NORMAL
    for corner in range(3):
        substitutes[mesh.faces[has_area, corner]] = mesh.face_normals[has_area]
    normals[is_degenerate] = substitutes[is_degenerate]
    return normals


def _rounded(link: Link) -> trimesh.Trimesh:
    """Returns a mesh of a link's capsules, in the wrist frame at zero."""
    parts = []
    for capsule in link.capsules:
        way = np.subtract(capsule.end, capsule.start)
        part = trimesh.creation.capsule(float(np.linalg.norm(way)), capsule.radius, count=(12, 12))
        if way.any():
            part.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], way))
        parts.append(part.apply_translation(np.add(capsule.start, capsule.end) / 2))
    whole = trimesh.util.concatenate(parts)
    assert isinstance(whole, trimesh.Trimesh)
    return whole


def _anatomical(skeleton: Skeleton) -> bool:
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
    return float(extent + skeleton.radii.max()) < _MAX_SIZE


def _housings(skeleton: Skeleton) -> tuple[Surface, np.ndarray]:
    """Returns a bevelled housing around every capsule, a drum at every joint, and a mask (V,) of
    the joints' points.
    """
    parts, links, joints = [], [], []
    for (start, end), radius, link in zip(
        skeleton.capsules, skeleton.radii, skeleton.capsule_link, strict=True
    ):
        parts.append(_bevelled(start, end, radius, radius))
        links.append(link)
        joints.append(False)
    for anchor, axis, link in zip(
        skeleton.anchors, skeleton.axes, skeleton.joint_link, strict=True
    ):
        mine = skeleton.radii[skeleton.capsule_link == link]
        if len(mine):
            half = _DRUM_LENGTH * mine[0] * axis - 0.2 * mine[0] * axis
            parts.append(
                _bevelled(anchor - half, anchor + half, _DRUM_RADIUS * mine[0], 0.2 * mine[0])
            )
            links.append(skeleton.parents[link])
            joints.append(True)
    counts = [len(points) for points, _, _ in parts]
    firsts = np.cumsum([0, *counts[:-1]])
    weights = np.eye(len(skeleton.names))[np.repeat(links, counts)]
    faces = np.concatenate([part[2] + first for part, first in zip(parts, firsts, strict=True)])
    points, normals = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    return Surface(points, normals, faces, weights), np.repeat(joints, counts)


def _bevelled(
    start: np.ndarray, end: np.ndarray, radius: float, reach: float
) -> tuple[np.ndarray, ...]:
    """Points, normals and faces of a cylinder with bevelled ends that extends beyond both points
    (3,).
    """
    length, bevel = float(np.linalg.norm(end - start)), _BEVEL * min(radius, reach)
    outline = [
        (0.0, -reach),
        (radius - bevel, -reach),
        (radius, bevel - reach),
        (radius, length + reach - bevel),
        (radius - bevel, length + reach),
        (0.0, length + reach),
    ]
    points: list[np.ndarray] = []
    normals: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    turn = np.eye(3)
    if length > 1e-9:
        turn = trimesh.geometry.align_vectors([0, 0, 1], (end - start) / length)[:3, :3]
    angles = 2 * np.pi * np.arange(_SECTIONS) / _SECTIONS
    around = np.stack([np.cos(angles), np.sin(angles)], -1)
    for (r0, z0), (r1, z1) in itertools.pairwise(
        outline
    ):  # separate points for each strip give sharp edges
        out = np.array([z1 - z0, r0 - r1]) / np.hypot(z1 - z0, r0 - r1)
        first = _SECTIONS * len(points)
        for r, z in ((r0, z0), (r1, z1)):
            points.append(np.column_stack([r * around, np.full(_SECTIONS, z)]))
            normals.append(np.column_stack([out[0] * around, np.full(_SECTIONS, out[1])]))
        here = first + np.arange(_SECTIONS)
        after = first + (np.arange(_SECTIONS) + 1) % _SECTIONS
        if r0 > 0:
            faces.append(np.column_stack([here, after, after + _SECTIONS]))
        if r1 > 0:
            faces.append(np.column_stack([here, after + _SECTIONS, here + _SECTIONS]))
    return (
        start + np.concatenate(points) @ turn.T,
        np.concatenate(normals) @ turn.T,
        np.concatenate(faces),
    )
