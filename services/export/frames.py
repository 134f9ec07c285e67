"""Poses of every link and of the object over time, from which formats are written and checked."""

import contextlib
import re
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand, own_hands
from congrasp.common.hands.flesh import Skeleton
from congrasp.common.hands.skin import Skin, skin_of, skin_on
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.painting import painted
from congrasp.services.export.motion_file import GraspMotion, hand_arrays
from congrasp.services.record import palette
from congrasp.services.record.moved_arm import Mesh

OBJECT = "object"
"""Name of the object's frame; the others have the names of the links."""
SKIN = "skin"
"""Name of the hand's surface."""
NOT_LINKS = (OBJECT, SKIN, "world")
"""Names that links of arms must not have."""
COLOURS = {**palette.MATERIALS, OBJECT: palette.OBJECT}
"""Colours of the materials of hands, and of the object."""
TOLERANCE_MM = 0.1
"""Largest error of the kinematics of a file that is kept, mm."""
_LEVER = 0.1  # m; a point this far from a frame's origin shows its rotation
_SAME_TIME = 1e-6  # s
_KINEMATICS = ("link_names", "link_parent", "joint_link", "joint_axis", "joint_anchor")
_STILL = 1e-6  # m; a link whose origin moves less than this in its parent's frame does not move there


FROM_Y_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], float)
"""(4, 4) transform from a world frame with the y axis up to one with the z axis up: y to z, z to -y."""
TO_Y_UP = Rotation.from_matrix(FROM_Y_UP[:3, :3].T)
"""Rotation of its inverse."""


class Track(NamedTuple):
    """Content of a file for one motion, computed by its reader."""

    time: np.ndarray
    """(T,) s, from zero."""
    poses: dict[str, np.ndarray]
    """(T, 4, 4) frame to world of every link and the object; metres, z up."""
    triangles: dict[str, np.ndarray] | None = None
    """(E, 3, 3) corners of the meshes of object and arm links in their frames; None if the format has no meshes."""


class Body(NamedTuple):
    """A link of hand or arm, or the object, in its parent's frame."""

    name: str
    parent: int
    """Index of the body that carries it, -1 for the world."""
    translation: np.ndarray
    """(T, 3) m, or (1, 3) if it is constant."""
    rotation: Rotation
    """T rotations."""


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


def capsules(motion: GraspMotion, link: int) -> Iterator[Capsule]:
    """The capsules of a link by its index."""
    for k in np.flatnonzero(motion.capsule_link == link):
        start, end = motion.capsule_ends[k].astype(float)
        length = float(np.linalg.norm(end - start))
        turn = Rotation.align_vectors([end - start], [[0, 0, 1]])[0] if length else Rotation.identity()
        yield Capsule(int(k), length, float(motion.capsule_radius[k]), (start + end) / 2, turn)


def object_mesh(motion: GraspMotion) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """The object's mesh (V, 3), (F, 3), and the sRGB (V, 3) in [0, 1] of its points, for which it is refined."""
    if motion.colours is None:
        return motion.object_vertices, motion.object_faces, None
    vertices, faces, colours = painted(motion.object_vertices, motion.object_faces, motion.colours)
    return vertices, faces, colours.astype(np.float32) / 255


def skin_of_motion(motion: GraspMotion) -> Skin:
    """Returns the surface of the motion's hand; that of its file's meshes if it is a custom hand and readable."""
    with contextlib.suppress(CongraspError):  # the motion itself has all the data
        if motion.hand in own_hands() and _same_hand(motion, hand := get_hand(motion.hand)):
            return skin_of(hand)
    origins = np.zeros((len(motion.link_names), 3))
    first = np.unique(motion.joint_link, return_index=True)[1]
    origins[motion.joint_link[first]] = motion.joint_anchor[first]
    skeleton = Skeleton(
        motion.hand,
        tuple(map(str, motion.link_names)),
        motion.link_parent,
        origins,
        motion.capsule_ends + origins[motion.capsule_link][:, None],
        motion.capsule_radius,
        motion.capsule_link,
        motion.joint_anchor,
        motion.joint_axis,
        motion.joint_link,
    )
    return skin_on(skeleton)


def _same_hand(motion: GraspMotion, hand: Hand) -> bool:
    """True if the hand of the motion's name is unchanged."""
    arrays = hand_arrays(hand)
    return all(np.array_equal(arrays[name], getattr(motion, name)) for name in _KINEMATICS)


def bodies(motion: GraspMotion) -> list[Body]:
    """Links of the hand in their order, each after its parent, the object, and the links of the arm."""
    found = _nested(motion.link_names, motion.link_parent, motion.link_position, motion.link_quaternion)
    turn = Rotation.from_quat(motion.object_quaternion, scalar_first=True)
    found.append(Body(OBJECT, -1, motion.object_position.astype(float), turn))
    if arm := motion.arm:
        first = len(found)
        links = _nested(arm.link_names, arm.link_parent, arm.link_position, arm.link_quaternion)
        found += [link._replace(parent=link.parent + first if link.parent >= 0 else -1) for link in links]
    return found


def _nested(names: np.ndarray, parents: np.ndarray, position: np.ndarray, quaternion: np.ndarray) -> list[Body]:
    """Links in their parents' frames, from poses (T, L, 3) and (T, L, 4) in the world."""
    turns = [Rotation.from_quat(q, scalar_first=True) for q in quaternion.swapaxes(0, 1).astype(float)]
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


def error_mm(motion: GraspMotion, track: Track) -> float:
    """Largest distance in mm between points of the motion and of the file.

    The points are each frame's origin and three a decimetre away along its axes, at every time, and the triangles of
    object and arm in their frames.

    Raises:
      CongraspError: the file has other bodies or times than the motion.
    """
    expected = _world_poses(motion.link_names, motion.link_position, motion.link_quaternion)
    turns = Rotation.from_quat(motion.object_quaternion, scalar_first=True)
    expected[OBJECT] = pose_matrices(motion.object_position, turns)
    if arm := motion.arm:
        expected |= _world_poses(arm.link_names, arm.link_position, arm.link_quaternion)
    if odd := sorted(expected.keys() ^ track.poses.keys()):
        raise CongraspError(f"The file lacks or should not have the frame '{odd[0]}'.")
    if track.time.shape != motion.time.shape or np.abs(track.time - motion.time).max() > _SAME_TIME:
        raise CongraspError("The file has other times than the motion.")
    points = np.concatenate([np.zeros((1, 3)), _LEVER * np.eye(3)])
    points = np.concatenate([points, np.ones((4, 1))], 1).T
    distances = [np.linalg.norm(((expected[name] - track.poses[name]) @ points)[:, :3], axis=1) for name in expected]
    worst = max(float(distance.max()) for distance in distances)
    if track.triangles is not None:
        meshes = _triangles(motion, track.triangles[OBJECT].shape)
        if {name: mesh.shape for name, mesh in meshes.items()} != {n: m.shape for n, m in track.triangles.items()}:
            raise CongraspError("The file's meshes have other triangles than the motion's.")
        apart = (np.linalg.norm(track.triangles[name] - mesh, axis=-1).max() for name, mesh in meshes.items())
        worst = max(worst, *map(float, apart))
    return 1000 * worst


def _world_poses(names: np.ndarray, position: np.ndarray, quaternion: np.ndarray) -> dict[str, np.ndarray]:
    """(T, 4, 4) of each link, from (T, L, 3) and (T, L, 4)."""
    turns = Rotation.from_quat(quaternion.reshape(-1, 4), scalar_first=True)
    poses = pose_matrices(position.reshape(-1, 3), turns).reshape(*position.shape[:2], 4, 4)
    return dict(zip(map(str, names), poses.swapaxes(0, 1), strict=True))


def _triangles(motion: GraspMotion, shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    """(E, 3, 3) corners of the meshes of object and arm links in their frames.

    The object's mesh is the one cut for its colours, if that has the shape.
    """
    corners = motion.object_vertices[motion.object_faces]
    if motion.colours and corners.shape != shape:
        vertices, faces, _ = object_mesh(motion)
        corners = vertices[faces]
    found = {OBJECT: corners}
    for name, parts in arm_meshes(motion).items():
        found[name] = np.concatenate([part.vertices[part.faces] for part in parts])
    return found


def arm_meshes(motion: GraspMotion) -> dict[str, list[Mesh]]:
    """Meshes of each link of the arm that has any; empty without an arm."""
    found: dict[str, list[Mesh]] = {}
    if arm := motion.arm:
        for mesh in arm.meshes:
            found.setdefault(str(arm.link_names[mesh.link]), []).append(mesh)
    return found


def facts(motion: GraspMotion, *, frame: str, unit: str, quaternion: str) -> dict[str, Any]:
    """Metadata of every file: origin of the motion, and meaning of its numbers in this format."""
    arm = motion.arm
    return {
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
        **(
            {"arm": arm.name, "arm_joints": arm.joint_names.tolist(), "arm_links": arm.link_names.tolist()}
            if arm
            else {}
        ),
    }


def identifiers(names: Sequence[str]) -> list[str]:
    """The names as distinct identifiers, with underscores in place of other characters than letters and digits."""
    plain: list[str] = []
    for name in names:
        word = re.sub(r"\W", "_", name, flags=re.ASCII)
        word = f"_{word}" if word[:1].isdigit() or not word else word
        while word in plain:
            word += "_"
        plain.append(word)
    return plain
