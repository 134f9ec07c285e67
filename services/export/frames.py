"""Frames of a motion's bodies: links of the hand, the object, and links of the arm."""

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.episode.episode import Episode
from congrasp.common.rotations import continuous

OBJECT = "object"
"""Name of the object's frame; the others have the names of the links."""
SKIN = "skin"
"""Name of the hand's surface."""
NOT_LINKS = (OBJECT, SKIN, "world")
"""Names that links of arms must not have."""
TO_Y_UP = Rotation.from_matrix([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Rotation from a world frame with the z axis up to one with the y axis up: z to y, y to -z."""
_STILL_M = 1e-6
"""Distance from the middle of its positions in the parent's frame up to which the origin of a link
counts as not moving."""


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


def bodies(motion: Episode) -> list[Body]:
    """Links of the hand in their order, each after its parent, the object, and the links of the
    arm.
    """
    chain = _nested(
        motion.link_names, motion.link_parent, motion.link_position, motion.link_quaternion
    )
    turn = Rotation.from_quat(motion.object_quaternion, scalar_first=True)
    chain.append(Body(OBJECT, -1, motion.object_position.astype(float), turn))
    arm = motion.arm
    if arm is None:
        return chain
    first = len(chain)
    for link in _nested(arm.link_names, arm.link_parent, arm.link_position, arm.link_quaternion):
        parent = link.parent + first if link.parent >= 0 else -1
        chain.append(link._replace(parent=parent))
    return chain


def _nested(
    names: np.ndarray, parents: np.ndarray, position: np.ndarray, quaternion: np.ndarray
) -> list[Body]:
    """Links in their parents' frames, from poses (T, L, 3) and (T, L, 4) in the world."""
    turns = []  # by link, T rotations each
    for link_quaternion in quaternion.swapaxes(0, 1).astype(float):
        turns.append(Rotation.from_quat(link_quaternion, scalar_first=True))
    places = position.swapaxes(0, 1).astype(float)
    links = []
    for i, (name, parent) in enumerate(zip(names, parents, strict=True)):
        place = places[i]
        turn = turns[i]
        if parent >= 0:
            inverse = turns[parent].inv()
            place = _without_noise(inverse.apply(place - places[parent]))
            turn = inverse * turn
        links.append(Body(str(name), int(parent), place, turn))
    return links


def _without_noise(translation: np.ndarray) -> np.ndarray:
    """Returns a translation (T, 3), or its middle (1, 3) if it does not move."""
    middle = (translation.min(0) + translation.max(0)) / 2
    if np.abs(translation - middle).max() < _STILL_M:
        return middle[None]
    return translation


def link_origins(motion: Episode) -> np.ndarray:
    """(L, 3) m, origins of the links in the wrist frame with all joints at zero: the anchors of
    their first joints.
    """
    origins = np.zeros((len(motion.link_names), 3))
    links, first = np.unique(motion.joint_link, return_index=True)
    origins[links] = motion.joint_anchor[first]
    return origins


class Capsule(NamedTuple):
    """A capsule of a link, along the z axis of a frame in its middle."""

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
    """Yields the capsules of the hand's link with an index."""
    for number in np.flatnonzero(motion.capsule_link == link):
        start, end = motion.capsule_ends[number].astype(float)
        length = float(np.linalg.norm(end - start))
        turn = Rotation.identity()
        if length:
            turn, _ = Rotation.align_vectors([end - start], [[0, 0, 1]])
        yield Capsule(
            int(number),
            length=length,
            radius=float(motion.capsule_radius[number]),
            middle=(start + end) / 2,
            turn=turn,
        )


def pose_matrices(position: np.ndarray, rotation: Rotation) -> np.ndarray:
    """(T, 4, 4) of positions (T, 3) and T rotations."""
    matrices = np.tile(np.eye(4), (len(position), 1, 1))
    matrices[:, :3, :3] = rotation.as_matrix()
    matrices[:, :3, 3] = position
    return matrices


def identifiers(names: Sequence[str]) -> list[str]:
    """Returns the names as distinct ASCII identifiers: other characters than letters and digits
    become underscores.
    """
    unique: list[str] = []
    for name in names:
        word = re.sub(r"\W", "_", name, flags=re.ASCII)
        if not word or word[0].isdigit():
            word = f"_{word}"
        while word in unique:
            word += "_"
        unique.append(word)
    return unique
