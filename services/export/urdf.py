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

_MASS, _INERTIA = "0.01", "1e-6"
"""Placeholders for every link: only the kinematics is exported, but some readers need them."""
_SPEED = 20.0
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
    """The hand as URDF, whose palm is the root; with an arm the whole robot, whose root is the
    arm's base.

    Links and joints keep their names and frames. URDF has one joint between two links, so that a
    link with several joints gets intermediate links of its name and a number. Efforts are not those
    of the robot.
    """
    arm = motion.arm
    robot = ET.Element("robot", name=f"{arm.name}_{motion.hand}" if arm else motion.hand)
    if arm:
        _add_arm(robot, arm)
        turn = Rotation.from_quat(arm.hand_quaternion, scalar_first=True)
        carrier, palm = str(arm.link_names[arm.hand_link]), str(motion.link_names[0])
        _joint(robot, "mount", "fixed", carrier, palm, arm.hand_position, turn)
    _add_hand(robot, motion)
    ET.indent(robot)
    return ET.tostring(robot, "unicode")


def _add_hand(robot: ET.Element, motion: Episode) -> None:
    """Adds the hand's links, which have the palm's orientation with all joints at zero."""
    names = robot_joints(motion)[-len(motion.joint_names) :]
    origins = link_origins(motion)
    for i, (name, parent) in enumerate(
        zip(map(str, motion.link_names), motion.link_parent, strict=True)
    ):
        moved = np.flatnonzero(motion.joint_link == i)
        joints = [
            _Joint(
                names[j],
                "revolute",
                motion.joint_axis[j],
                motion.joint_anchor[j] - origins[i],
                limits,
                _SPEED,
            )
            for j, limits in zip(moved, motion.joint_limits[moved], strict=True)
        ]
        if parent >= 0:
            place = origins[i] - origins[parent]
            _add_link(
                robot, name, str(motion.link_names[parent]), place, Rotation.identity(), joints
            )
        _add_capsules(_link(robot, name), motion, i)


def _add_arm(robot: ET.Element, arm: MovedArm) -> None:
    """Adds the arm's links, without meshes."""
    names, places = arm.link_names.tolist(), arm.link_position[0]
    turns = Rotation.from_quat(arm.link_quaternion[0], scalar_first=True)
    _link(robot, names[0])
    for i, parent in enumerate(arm.link_parent.tolist()[1:], 1):
        joints: list[_Joint] = []
        back = np.eye(4)  # from the link's frame at the first frame's angles to its frame at zero
        for j in np.flatnonzero(arm.joint_link == i)[::-1]:
            slides, axis, anchor = bool(arm.joint_slides[j]), arm.joint_axis[j], arm.joint_anchor[j]
            limited = np.abs(arm.joint_limits[j]).max() < UNLIMITED
            kind = "prismatic" if slides else "revolute" if limited else "continuous"
            joints.insert(
                0,
                _Joint(
                    str(arm.joint_names[j]),
                    kind,
                    axis,
                    anchor,
                    arm.joint_limits[j],
                    arm.joint_speed[j],
                ),
            )
            way = -arm.joint_position[0, j] * axis
            turn = Rotation.identity() if slides else Rotation.from_rotvec(way)
            shift = way if slides else anchor - turn.apply(anchor)
            back = back @ pose_matrices(shift[None], turn)[0]
        inverse = turns[parent].inv()
        local = (
            pose_matrices(inverse.apply(places[i] - places[parent])[None], inverse * turns[i])[0]
            @ back
        )
        _add_link(
            robot,
            names[i],
            names[parent],
            local[:3, 3],
            Rotation.from_matrix(local[:3, :3]),
            joints,
        )
        _link(robot, names[i])


def _add_link(
    robot: ET.Element,
    name: str,
    carrier: str,
    place: np.ndarray,
    turn: Rotation,
    joints: Sequence[_Joint],
) -> None:
    """Adds the joints between a link and its carrier; `place` and `turn` are its pose there with
    all joints at zero.
    """
    for number, (joint, kind, axis, anchor, limits, speed) in enumerate(joints):
        ends = number == len(joints) - 1 and np.allclose(anchor, 0, atol=1e-9)
        child = name if ends else f"{name}_{number}"
        element = _joint(robot, joint, kind, carrier, child, place + turn.apply(anchor), turn)
        ET.SubElement(element, "axis", xyz=_numbers(axis))
        lower, upper = map(_number, limits)
        ET.SubElement(
            element, "limit", lower=lower, upper=upper, effort="10", velocity=_number(speed)
        )
        if not ends:
            _link(robot, child)
        carrier, place, turn = child, -anchor, Rotation.identity()
    if carrier != name:
        _joint(robot, f"{name}_fixed", "fixed", carrier, name, place, turn)


def _link(robot: ET.Element, name: str) -> ET.Element:
    """Adds a link with a mass."""
    link = ET.SubElement(robot, "link", name=name)
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "mass", value=_MASS)
    ET.SubElement(
        inertial, "inertia", ixx=_INERTIA, iyy=_INERTIA, izz=_INERTIA, ixy="0", ixz="0", iyz="0"
    )
    return link


def _joint(
    robot: ET.Element,
    name: str,
    kind: str,
    parent: str,
    child: str,
    offset: np.ndarray,
    turn: Rotation,
) -> ET.Element:
    """Adds a joint at an offset (3,) and a rotation in its parent's frame."""
    joint = ET.SubElement(robot, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    with warnings.catch_warnings(
        action="ignore"
    ):  # of a pitch of 90 degrees, where any roll will do
        angles = turn.as_euler("xyz")
    ET.SubElement(joint, "origin", xyz=_numbers(offset), rpy=_numbers(angles))
    return joint


def _add_capsules(link: ET.Element, motion: Episode, index: int) -> None:
    """Adds each capsule as a cylinder and two spheres, because URDF has no capsules."""
    for number, length, radius, middle, turn in capsules(motion, index):
        for end in motion.capsule_ends[number]:
            ET.SubElement(_visual(link, end, np.zeros(3)), "sphere", radius=_number(radius))
        if length:
            visual = _visual(link, middle, turn.as_euler("xyz"))
            ET.SubElement(visual, "cylinder", radius=_number(radius), length=_number(length))


def _visual(link: ET.Element, position: np.ndarray, angles: np.ndarray) -> ET.Element:
    """Adds a shape at a position (3,) with angles (3,); returns its geometry."""
    visual = ET.SubElement(link, "visual")
    ET.SubElement(visual, "origin", xyz=_numbers(position), rpy=_numbers(angles))
    return ET.SubElement(visual, "geometry")


def _number(value: float) -> str:
    """Formats a number with nine digits."""
    return f"{value:.9g}"


def _numbers(values: np.ndarray) -> str:
    """Numbers of a vector."""
    return " ".join(map(_number, values))
