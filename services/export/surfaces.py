"""Coloured surfaces of a motion: the skin of the hand, the object, the links of the arm."""

import contextlib

import numpy as np

from congrasp.common.episode.arm import Mesh
from congrasp.common.episode.episode import Episode
from congrasp.common.episode.hand_arrays import hand_arrays
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand, own_hands
from congrasp.common.hands.flesh import Skeleton
from congrasp.common.hands.skin import Skin, skin_of, skin_on
from congrasp.common.hands.spec import Hand
from congrasp.services.appearance import palette
from congrasp.services.appearance.surface_colours import paint_surface
from congrasp.services.export.frames import OBJECT, link_origins

COLOURS = {**palette.MATERIAL_COLOURS, OBJECT: palette.OBJECT}
"""Colours of the materials of hands, and of the object."""
_KINEMATICS = ("link_names", "link_parent", "joint_link", "joint_axis", "joint_anchor")


def object_mesh(motion: Episode) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """The object's mesh (V, 3), (F, 3), and the sRGB (V, 3) in [0, 1] of its points, for which it
    is refined.
    """
    if motion.colours is None:
        return motion.object_vertices, motion.object_faces, None
    vertices, faces, colours = paint_surface(
        motion.object_vertices, motion.object_faces, motion.colours
    )
    return vertices, faces, colours.astype(np.float32) / 255


def arm_meshes(motion: Episode) -> dict[str, list[Mesh]]:
    """Meshes of each link of the arm that has any; empty without an arm."""
    meshes: dict[str, list[Mesh]] = {}
    if motion.arm is None:
        return meshes
    for mesh in motion.arm.meshes:
        link = str(motion.arm.link_names[mesh.link])
        meshes.setdefault(link, []).append(mesh)
    return meshes


def skin_of_motion(motion: Episode) -> Skin:
    """Returns the surface of the motion's hand; that of its file's meshes if it is a custom hand
    and readable.
    """
    with contextlib.suppress(CongraspError):  # the motion itself has all the data
        hand = _custom_hand(motion)
        if hand is not None:
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


def _custom_hand(motion: Episode) -> Hand | None:
    """Returns the custom hand of the motion's name; None if there is none or its kinematics has
    changed.

    Raises:
      CongraspError: its file cannot be read.
    """
    if motion.hand not in own_hands():
        return None
    hand = get_hand(motion.hand)
    arrays = hand_arrays(hand)
    for name in _KINEMATICS:
        if not np.array_equal(arrays[name], getattr(motion, name)):
            return None
    return hand
