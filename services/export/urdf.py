"""Hand and arm as URDF, for formats that carry joint angles."""

import warnings
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.episode.arm import UNLIMITED, MovedArm
from congrasp.common.episode.episode import Episode
from congrasp.services.export.frames import capsules, link_origins, pose_matrices
from congrasp.services.export.joint_trajectory import robot_joints

_MASS = "0.01"
"""Placeholder for every link: only the kinematics is exported, but some readers need a mass."""
_INERTIA = "1e-6"
"""Placeholder for every link, like the mass."""
_EFFORT = "10"
"""Placeholder for every joint, like the mass."""
_SPEED_RAD_S = 20.0
"""Speed limit of the hand's joints, rad/s."""


class _Joint(NamedTuple):
    """A joint that moves a link."""

    name: str
    kind: str
    """One of the kinds of URDF."""
    axis: np.ndarray
    """(3,) unit, link frame."""
    anchor: np.ndarray
    """(3,) m, link frame."""
    limits: np.ndarray
    """(2,) rad or m."""
    speed: float
    """Largest speed, rad/s or m/s."""


def robot_urdf(motion: Episode) -> str:
    """Returns the hand as URDF, whose root is the palm; with an arm the whole robot, whose root is
    the arm's base.

    Links and joints keep their names and frames. URDF has one joint between two links, so that a
    link with several joints gets intermediate links of its name and a number. Masses and efforts
    are placeholders.
    """
    arm = motion.arm
    name = f"{arm.name}_{motion.hand}" if arm else motion.hand
    robot = ET.Element("robot", name=name)
    if arm:
        _add_arm(robot, arm)
        turn = Rotation.from_quat(arm.hand_quaternion, scalar_first=True)
        ends = _Ends(str(arm.link_names[arm.hand_link]), str(motion.link_names[0]))
        _add_joint(robot, "mount", "fixed", ends, arm.hand_position, turn)
    _add_hand(robot, motion)
    ET.indent(robot)
    return ET.tostring(robot, "unicode")


def _add_hand(robot: ET.Element, motion: Episode) -> None:
    """Adds the hand's links, which have the palm's orientation with all joints at zero."""
    joint_names = robot_joints(motion)[-len(motion.joint_names) :]
    link_names = [str(name) for name in motion.link_names]
    origins = link_origins(motion)
    for i, parent in enumerate(motion.link_parent):
        joints = []
        for j in np.flatnonzero(motion.joint_link == i):
            joint = _Joint(
                joint_names[j],
                kind="revolute",
                axis=motion.joint_axis[j],
                anchor=motion.joint_anchor[j] - origins[i],
                limits=motion.joint_limits[j],
                speed=_SPEED_RAD_S,
            )
            joints.append(joint)
        if parent >= 0:
            ends = _Ends(link_names[parent], link_names[i])
            place = origins[i] - origins[parent]
            _add_joints(robot, joints, ends, place, Rotation.identity())
        _add_capsules(_add_link(robot, link_names[i]), motion, i)


def _add_arm(robot: ET.Element, arm: MovedArm) -> None:
    """Adds the arm's links, without meshes."""
    names = arm.link_names.tolist()
    places = arm.link_position[0]
    turns = Rotation.from_quat(arm.link_quaternion[0], scalar_first=True)
    _add_link(robot, names[0])
    for i, parent in enumerate(arm.link_parent.tolist()[1:], 1):
        inverse = turns[parent].inv()
        offset = inverse.apply(places[i] - places[parent])
        pose = pose_matrices(offset[None], inverse * turns[i])[0]
        joints = [_joint_of_arm(arm, int(j)) for j in np.flatnonzero(arm.joint_link == i)]
        pose_at_zero = pose @ _frame_at_zero(arm, i)
        turn = Rotation.from_matrix(pose_at_zero[:3, :3])
        _add_joints(robot, joints, _Ends(names[parent], names[i]), pose_at_zero[:3, 3], turn)
        _add_link(robot, names[i])


def _joint_of_arm(arm: MovedArm, j: int) -> _Joint:
    """Returns the arm's joint of an index."""
    kind = "revolute"
    if arm.joint_slides[j]:
        kind = "prismatic"
    elif np.abs(arm.joint_limits[j]).max() >= UNLIMITED:
        kind = "continuous"
    return _Joint(
        str(arm.joint_names[j]),
        kind=kind,
        axis=arm.joint_axis[j],
        anchor=arm.joint_anchor[j],
        limits=arm.joint_limits[j],
        speed=arm.joint_speed[j],
    )


def _frame_at_zero(arm: MovedArm, link: int) -> np.ndarray:
    """(4, 4) pose of a link with its joints at zero, in the link's frame at the motion's start.

    The joints are undone in reverse order.
    """
    pose = np.eye(4)
    for j in np.flatnonzero(arm.joint_link == link)[::-1]:
        undone = -arm.joint_position[0, j] * arm.joint_axis[j]  # (3,) m or rad
        if arm.joint_slides[j]:
            turn = Rotation.identity()
            shift = undone
        else:
            anchor = arm.joint_anchor[j]
            turn = Rotation.from_rotvec(undone)
            shift = anchor - turn.apply(anchor)
        pose = pose @ pose_matrices(shift[None], turn)[0]
    return pose


class _Ends(NamedTuple):
    """Links that a joint connects."""

    parent: str
    child: str


def _add_joints(
    robot: ET.Element, joints: Sequence[_Joint], ends: _Ends, place: np.ndarray, turn: Rotation
) -> None:
    """Adds the joints between a link and its carrier, with the links between them.

    Args:
      robot: the element `robot`, to which they are added.
      joints: joints of the link, in their order from its carrier; a fixed joint follows if the
        anchor of the last one is not the link's origin, or if there are none.
      ends: carrier and link.
      place: (3,) position of the link in its carrier with all joints at zero, m.
      turn: rotation from the link's frame to its carrier's with all joints at zero.
    """
    carrier, link = ends
    for number, joint in enumerate(joints):
        # In URDF a joint is at the origin of its child.
        is_last = number == len(joints) - 1 and np.allclose(joint.anchor, 0, atol=1e-9)
        child = link if is_last else f"{link}_{number}"
        origin = place + turn.apply(joint.anchor)
        element = _add_joint(robot, joint.name, joint.kind, _Ends(carrier, child), origin, turn)
        ET.SubElement(element, "axis", xyz=_numbers(joint.axis))
        lower, upper = joint.limits
        ET.SubElement(
            element,
            "limit",
            lower=_number(lower),
            upper=_number(upper),
            effort=_EFFORT,
            velocity=_number(joint.speed),
        )
        if not is_last:
            _add_link(robot, child)
        carrier = child
        place = -joint.anchor
        turn = Rotation.identity()
    if carrier != link:
        _add_joint(robot, f"{link}_fixed", "fixed", _Ends(carrier, link), place, turn)


def _add_link(robot: ET.Element, name: str) -> ET.Element:
    """Adds a link with a mass."""
    link = ET.SubElement(robot, "link", name=name)
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "mass", value=_MASS)
    ET.SubElement(
        inertial, "inertia", ixx=_INERTIA, iyy=_INERTIA, izz=_INERTIA, ixy="0", ixz="0", iyz="0"
    )
    return link


def _add_joint(
    robot: ET.Element, name: str, kind: str, ends: _Ends, offset: np.ndarray, turn: Rotation
) -> ET.Element:
    """Adds a joint at an offset (3,), m, and a rotation in its parent's frame."""
    joint = ET.SubElement(robot, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link=ends.parent)
    ET.SubElement(joint, "child", link=ends.child)
    # At a pitch of 90 degrees, SciPy warns that roll and yaw are not unique.
    with warnings.catch_warnings(action="ignore"):
        angles = turn.as_euler("xyz")
    ET.SubElement(joint, "origin", xyz=_numbers(offset), rpy=_numbers(angles))
    return joint


def _add_capsules(link: ET.Element, motion: Episode, index: int) -> None:
    """Adds each capsule as a cylinder and two spheres, because URDF has no capsules."""
    for capsule in capsules(motion, index):
        radius = _number(capsule.radius)
        for end in motion.capsule_ends[capsule.number]:
            sphere = _add_visual(link, end, np.zeros(3))
            ET.SubElement(sphere, "sphere", radius=radius)
        if capsule.length:
            cylinder = _add_visual(link, capsule.middle, capsule.turn.as_euler("xyz"))
            ET.SubElement(cylinder, "cylinder", radius=radius, length=_number(capsule.length))


def _add_visual(link: ET.Element, position: np.ndarray, angles: np.ndarray) -> ET.Element:
    """Adds a shape at a position (3,), m, with roll, pitch and yaw (3,), rad; returns its element
    `geometry`, which is empty.
    """
    visual = ET.SubElement(link, "visual")
    ET.SubElement(visual, "origin", xyz=_numbers(position), rpy=_numbers(angles))
    return ET.SubElement(visual, "geometry")


def _number(value: float) -> str:
    """Formats a number with nine digits."""
    return f"{value:.9g}"


def _numbers(values: np.ndarray) -> str:
    """Numbers of a vector."""
    return " ".join(map(_number, values))
