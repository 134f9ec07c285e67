"""Poses, meshes with their texture coordinates, and facts of a motion, from which every format is
written.
"""

import contextlib
import re
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from congrasp.common.episode.arm import Mesh
from congrasp.common.episode.episode import Episode
from congrasp.common.episode.hand_arrays import hand_arrays
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand, own_hands
from congrasp.common.hands.flesh import Skeleton
from congrasp.common.hands.skin import Skin, skin_of, skin_on
from congrasp.common.hands.spec import Hand
from congrasp.common.rotations import continuous
from congrasp.services.appearance import palette
from congrasp.services.appearance.surface_colours import painted

OBJECT = "object"
"""Name of the object's frame; the others have the names of the links."""
SKIN = "skin"
"""Name of the hand's surface."""
NOT_LINKS = (OBJECT, SKIN, "world")
"""Names that links of arms must not have."""
COLOURS = {**palette.MATERIALS, OBJECT: palette.OBJECT}
"""Colours of the materials of hands, and of the object."""
_KINEMATICS = ("link_names", "link_parent", "joint_link", "joint_axis", "joint_anchor")
_STILL = (
    1e-6  # m; a link whose origin moves less than this in its parent's frame does not move there
)
TO_Y_UP = Rotation.from_matrix([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Rotation from a world frame with the z axis up to one with the y axis up: z to y, y to -z."""
_MARGIN = 0.004  # space between charts, as a share of the root of the surface's area


class Body(NamedTuple):
    """A link of hand or arm, or the object, in its parent's frame."""

    name: str
    parent: int
    """Index of the body that carries it, -1 for the world."""
    translation: np.ndarray
    """(T, 3) m, or (1, 3) if it is constant."""
    rotation: Rotation
    """T rotations."""

    def quaternions(self, *, scalar_first: bool) -> np.ndarray:
        """(T, 4), each on the side of the one before, so that programs may interpolate between
        them.
        """
        return continuous(self.rotation.as_quat(scalar_first=scalar_first))


class Capsule(NamedTuple):
    """A capsule of a link, along the z axis of its own frame."""

    number: int
    """Index among all capsules of the hand."""
    length: float
    """Distance between the centres of its caps, m."""
    radius: float
    """m."""
    middle: np.ndarray
    """(3,) m, in the link's frame."""
    turn: Rotation
    """Rotation from its frame to the link's."""


def capsules(motion: Episode, link: int) -> Iterator[Capsule]:
    """The capsules of a link by its index."""
    for k in np.flatnonzero(motion.capsule_link == link):
        start, end = motion.capsule_ends[k].astype(float)
        length = float(np.linalg.norm(end - start))
        turn = (
            Rotation.align_vectors([end - start], [[0, 0, 1]])[0] if length else Rotation.identity()
        )
        yield Capsule(int(k), length, float(motion.capsule_radius[k]), (start + end) / 2, turn)


def object_mesh(motion: Episode) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """The object's mesh (V, 3), (F, 3), and the sRGB (V, 3) in [0, 1] of its points, for which it
    is refined.
    """
    if motion.colours is None:
        return motion.object_vertices, motion.object_faces, None
    vertices, faces, colours = painted(motion.object_vertices, motion.object_faces, motion.colours)
    return vertices, faces, colours.astype(np.float32) / 255


def skin_of_motion(motion: Episode) -> Skin:
    """Returns the surface of the motion's hand; that of its file's meshes if it is a custom hand
    and readable.
    """
    with contextlib.suppress(CongraspError):  # the motion itself has all the data
        if motion.hand in own_hands() and _same_hand(motion, hand := get_hand(motion.hand)):
            return skin_of(hand)
    origins = link_origins(motion)
    skeleton = Skeleton(
        hand=motion.hand,
        names=tuple(map(str, motion.link_names)),
        parents=motion.link_parent,
        origins=origins,
        capsules=motion.capsule_ends + origins[motion.capsule_link][:, None],
        radii=motion.capsule_radius,
        capsule_link=motion.capsule_link,
        anchors=motion.joint_anchor,
        axes=motion.joint_axis,
        joint_link=motion.joint_link,
    )
    return skin_on(skeleton)


def link_origins(motion: Episode) -> np.ndarray:
    """(L, 3) m, origins of the links in the wrist frame with all joints at zero: the anchors of
    their first joints.
    """
    origins = np.zeros((len(motion.link_names), 3))
    links, first = np.unique(motion.joint_link, return_index=True)
    origins[links] = motion.joint_anchor[first]
    return origins


def _same_hand(motion: Episode, hand: Hand) -> bool:
    """True if the hand of the motion's name is unchanged."""
    arrays = hand_arrays(hand)
    return all(np.array_equal(arrays[name], getattr(motion, name)) for name in _KINEMATICS)


def bodies(motion: Episode) -> list[Body]:
    """Links of the hand in their order, each after its parent, the object, and the links of the
    arm.
    """
    found = _nested(
        motion.link_names, motion.link_parent, motion.link_position, motion.link_quaternion
    )
    turn = Rotation.from_quat(motion.object_quaternion, scalar_first=True)
    found.append(Body(OBJECT, -1, motion.object_position.astype(float), turn))
    if arm := motion.arm:
        first = len(found)
        links = _nested(arm.link_names, arm.link_parent, arm.link_position, arm.link_quaternion)
        found += [
            link._replace(parent=link.parent + first if link.parent >= 0 else -1) for link in links
        ]
    return found


def _nested(
    names: np.ndarray, parents: np.ndarray, position: np.ndarray, quaternion: np.ndarray
) -> list[Body]:
    """Links in their parents' frames, from poses (T, L, 3) and (T, L, 4) in the world."""
    turns = [
        Rotation.from_quat(q, scalar_first=True) for q in quaternion.swapaxes(0, 1).astype(float)
    ]
    places = position.swapaxes(0, 1).astype(float)
    found = []
    for i, (name, parent) in enumerate(zip(names, parents, strict=True)):
        place, turn = places[i], turns[i]
        if parent >= 0:
            inverse = turns[parent].inv()
            place, turn = inverse.apply(place - places[parent]), inverse * turn
            middle = (place.min(0) + place.max(0)) / 2
            place = middle[None] if np.abs(place - middle).max() < _STILL else place
        found.append(Body(str(name), int(parent), place, turn))
    return found


def pose_matrices(position: np.ndarray, rotation: Rotation) -> np.ndarray:
    """(T, 4, 4) of positions (T, 3) and T rotations."""
    matrices = np.tile(np.eye(4), (len(position), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = rotation.as_matrix(), position
    return matrices


def arm_meshes(motion: Episode) -> dict[str, list[Mesh]]:
    """Meshes of each link of the arm that has any; empty without an arm."""
    found: dict[str, list[Mesh]] = {}
    if arm := motion.arm:
        for mesh in arm.meshes:
            found.setdefault(str(arm.link_names[mesh.link]), []).append(mesh)
    return found


def facts(motion: Episode, *, frame: str, unit: str, quaternion: str) -> dict[str, Any]:
    """Metadata of every file: origin of the motion, and meaning of its numbers in this format."""
    about = {
        "generator": "congrasp",
        "hand": motion.hand,
        "object": motion.object,
        "success": motion.success,
        "constraints": list(motion.constraints),
        "control_dt": motion.control_dt,
        "frame": frame,
        "unit": unit,
        "quaternion": quaternion,
        "joints": motion.joint_names.tolist(),
        "links": motion.link_names.tolist(),
    }
    if arm := motion.arm:
        about |= {
            "arm": arm.name,
            "arm_joints": arm.joint_names.tolist(),
            "arm_links": arm.link_names.tolist(),
        }
    return about


def identifiers(names: Sequence[str]) -> list[str]:
    """The names as distinct identifiers, with underscores in place of other characters than letters
    and digits.
    """
    plain: list[str] = []
    for name in names:
        word = re.sub(r"\W", "_", name, flags=re.ASCII)
        word = f"_{word}" if word[:1].isdigit() or not word else word
        while word in plain:
            word += "_"
        plain.append(word)
    return plain


class Unwrapped(NamedTuple):
    """A mesh whose points have texture coordinates; its faces are those of the original, in the
    same order.
    """

    source: np.ndarray
    """(M,) int, index of each point in the original mesh; at a seam each chart has a separate
    point.
    """
    faces: np.ndarray
    """(F, 3) int."""
    uv: np.ndarray
    """(M, 2) in [0, 1], v upwards; lengths have the same scale everywhere, except across slanting
    faces.
    """


def unwrapped(vertices: np.ndarray, faces: np.ndarray) -> Unwrapped:
    """Returns texture coordinates of a mesh (V, 3), (F, 3), projected along the axis closest to
    each face's normal.
    """
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.abs(normals).argmax(1)
    side = 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] < 0)
    a, b = trimesh.graph.face_adjacency(faces).T
    same = side[a] == side[b]
    links = coo_array(
        (np.ones(same.sum(), bool), (a[same], b[same])), shape=(len(faces), len(faces))
    )
    count, chart = connected_components(links, directed=False)
    of_corner = np.repeat(chart, 3)
    pairs = np.stack([faces.ravel(), of_corner], 1)
    points, first, inverse = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
    source, chart_of = points.T
    across = np.array([(1, 2), (2, 0), (0, 1)])[np.repeat(axis, 3)[first]]
    flat = np.take_along_axis(vertices[source], across, 1)
    flat[:, 0] *= np.where(np.repeat(side, 3)[first] % 2, -1, 1)  # seen from outside, not mirrored
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, chart_of, flat)
    np.maximum.at(high, chart_of, flat)
    places, size = _packed(
        high - low, _MARGIN * float(np.sqrt(np.linalg.norm(normals, axis=1).sum() / 2))
    )
    uv = (flat - low[chart_of] + places[chart_of]) / max(size, 1e-12)
    return Unwrapped(source, inverse.reshape(faces.shape), uv)


def _packed(sizes: np.ndarray, margin: float) -> tuple[np.ndarray, float]:
    """Lower corners (n, 2) of rectangles (n, 2) in rows, the tallest first, and the side of the
    square around them.
    """
    sizes = sizes + margin
    width = max(float(sizes[:, 0].max()), float(np.sqrt(sizes.prod(1).sum())))
    places = np.zeros_like(sizes)
    x = y = row = 0.0
    for i in np.argsort(-sizes[:, 1], kind="stable"):
        if x + sizes[i, 0] > width * (1 + 1e-9):
            x, y, row = 0.0, y + row, 0.0
        places[i] = x, y
        x, row = x + sizes[i, 0], max(row, sizes[i, 1])
    return places + margin / 2, max(width, y + row)
