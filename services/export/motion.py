"""A grasp motion: the arrays of hand, object and arm from which every format is written.

Metres, radians, seconds, newtons; quaternions are (w, x, y, z) and turn a body's frame into the
world. The world's z axis points up and the table's top is at z = 0. T frames, F finger joints, L
links, C capsules, K waypoints.
"""

import dataclasses
from typing import Annotated, Any, get_type_hints

import numpy as np

from congrasp.common.hands.spec import Hand, capsule_ends
from congrasp.common.objects.spec import Colours
from congrasp.services.record.episode import MovedArm


@dataclasses.dataclass(frozen=True, eq=False)
class GraspMotion:
    """A hand that approaches an object, closes, and holds it after table removal.

    Other values are stored as JSON under the name `meta`, with the meaning of every array.
    """

    hand: str
    """Name of the hand."""
    object: str
    """Name of the object."""
    success: bool
    """True if the object was held a quarter of a second after table removal; `metrics["held"]`: to
    the end.
    """
    control_dt: float
    """Seconds between two frames."""
    constraints: tuple[str, ...]
    """Names of the active constraints, weakest first."""
    metrics: dict[str, float]
    """Errors, forces and reward of the episode, by the names in `common.task.metrics`."""
    about: dict[str, Any]
    """Origin: version of the policy, file of the object, command."""
    time: Annotated[np.ndarray, "(T,) s"]
    table: Annotated[np.ndarray, "(T,) bool, whether the table stands"]
    wrist_position: Annotated[np.ndarray, "(T, 3) m, world"]
    wrist_quaternion: Annotated[np.ndarray, "(T, 4) w x y z, wrist frame to world"]
    joint_position: Annotated[np.ndarray, "(T, F) rad, finger joints in the order of joint_names"]
    joint_target: Annotated[np.ndarray, "(T, F) rad, what the joints' position servos aimed at"]
    link_position: Annotated[
        np.ndarray, "(T, L, 3) m, world, origins of the links in the order of link_names"
    ]
    link_quaternion: Annotated[
        np.ndarray, "(T, L, 4) w x y z, link frame to world; link 0, the palm, is the wrist"
    ]
    link_force: Annotated[
        np.ndarray, "(T, L, 3) N, world, net contact force of the object on each link"
    ]
    object_position: Annotated[np.ndarray, "(T, 3) m, world, the object's centre of mass"]
    object_quaternion: Annotated[np.ndarray, "(T, 4) w x y z, object frame to world"]
    object_vertices: Annotated[
        np.ndarray, "(V, 3) m, object frame: axes of its file, origin at its centre of mass"
    ]
    object_faces: Annotated[np.ndarray, "(E, 3) indices of object_vertices"]
    object_file_origin: Annotated[
        np.ndarray, "(3,) m: object frame = object_file_scale * file - object_file_origin"
    ]
    object_file_scale: Annotated[np.ndarray, "() m per unit of the object's file"]
    joint_names: Annotated[np.ndarray, "(F,) text"]
    joint_link: Annotated[
        np.ndarray, "(F,) the link that a joint moves; joints of one link act in this order"
    ]
    joint_axis: Annotated[
        np.ndarray, "(F, 3) unit, link frame; with all joints at zero links are turned as the wrist"
    ]
    joint_anchor: Annotated[np.ndarray, "(F, 3) m, wrist frame with all joints at zero"]
    joint_limits: Annotated[np.ndarray, "(F, 2) rad, lower and upper"]
    link_names: Annotated[np.ndarray, "(L,) text"]
    link_parent: Annotated[np.ndarray, "(L,) index of the link that carries it, -1 for the palm"]
    capsule_link: Annotated[np.ndarray, "(C,) link of each capsule of the hand's shape"]
    capsule_ends: Annotated[np.ndarray, "(C, 2, 3) m, link frame"]
    capsule_radius: Annotated[np.ndarray, "(C,) m"]
    surface_points: Annotated[np.ndarray, "(N, 3) m, object frame, points of the surface"]
    surface_avoid: Annotated[
        np.ndarray, "(N,) bool, must not be touched (where affordance is among the constraints)"
    ]
    colours: Colours | None
    """Colours of the object, in its frame, if it has any."""
    goal: dict[str, np.ndarray]
    """Goal arrays of the policy's constraints, by constraint and field: `heading_direction`,
    `pose_q`.
    """
    arm: MovedArm | None = None
    """The arm that carries the hand, if there is one. Its wrist deviates from the hand's by its
    tracking error.
    """


_HINTS = get_type_hints(GraspMotion, include_extras=True)
ARRAYS = {
    name: hint.__metadata__[0] for name, hint in _HINTS.items() if hasattr(hint, "__metadata__")
}
"""Meaning of the arrays that every motion has; each begins with the shape."""


def hand_arrays(hand: Hand) -> dict[str, np.ndarray]:
    """Joints, links and capsules of a hand, by the names of a motion's arrays."""
    index = {link.name: i for i, link in enumerate(hand.links)}
    limits = [(joint.lower, joint.upper) for joint in hand.joints]
    capsule_links = []
    capsule_radii = []
    for i, link in enumerate(hand.links):
        for capsule in link.capsules:
            capsule_links.append(i)
            capsule_radii.append(capsule.radius)
    return {
        "joint_names": np.array([joint.name for joint in hand.joints]),
        "joint_link": hand.joint_links.astype(np.int32),
        "joint_axis": np.array([joint.axis for joint in hand.joints]),
        "joint_anchor": np.array([joint.anchor for joint in hand.joints]),
        "joint_limits": np.array(limits),
        "link_names": np.array([link.name for link in hand.links]),
        "link_parent": np.array([index.get(link.parent, -1) for link in hand.links], np.int32),
        "capsule_link": np.array(capsule_links, np.int32),
        "capsule_ends": np.concatenate([capsule_ends(link) for link in hand.links]),
        "capsule_radius": np.array(capsule_radii),
    }
