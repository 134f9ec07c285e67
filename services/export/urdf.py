"""The hand as URDF, for formats that carry joint angles, and the kinematics that MuJoCo makes of it."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.services.export.frames import capsules, pose_matrices
from congrasp.services.export.motion_file import GraspMotion

_MASS, _INERTIA = "0.01", "1e-6"
"""Of every link: only the kinematics is meant, but some readers refuse a link without."""


def hand_urdf(motion: GraspMotion) -> str:
    """The hand as URDF; the palm is the root, and links and joints keep their names and frames.

    URDF has one joint between two links: a link that several move hangs on links of its name and a number.
    """
    robot = ET.Element("robot", name=motion.hand)
    origins = np.zeros((len(motion.link_names), 3))  # of the links' frames in the wrist frame, all joints at zero
    for i, name in enumerate(map(str, motion.link_names)):
        joints = np.flatnonzero(motion.joint_link == i)
        parent = int(motion.link_parent[i])
        if len(joints):
            origins[i] = motion.joint_anchor[joints[0]]
        if parent >= 0:
            carrier, place = str(motion.link_names[parent]), origins[parent]
            for number, j in enumerate(joints):
                anchor = motion.joint_anchor[j]
                ends = number == len(joints) - 1 and np.allclose(anchor, origins[i], atol=1e-9)
                child = name if ends else f"{name}_{number}"
                joint = _joint(robot, str(motion.joint_names[j]), "revolute", carrier, child, anchor - place)
                ET.SubElement(joint, "axis", xyz=_numbers(motion.joint_axis[j]))
                lower, upper = map(_number, motion.joint_limits[j])
                ET.SubElement(joint, "limit", lower=lower, upper=upper, effort="10", velocity="20")
                if not ends:
                    _link(robot, child)
                carrier, place = child, anchor
            if carrier != name:
                _joint(robot, f"{name}_fixed", "fixed", carrier, name, origins[i] - place)
        _add_capsules(_link(robot, name), motion, i)
    ET.indent(robot)
    return ET.tostring(robot, "unicode")


def _link(robot: ET.Element, name: str) -> ET.Element:
    """Adds a link with a mass."""
    link = ET.SubElement(robot, "link", name=name)
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "mass", value=_MASS)
    ET.SubElement(inertial, "inertia", ixx=_INERTIA, iyy=_INERTIA, izz=_INERTIA, ixy="0", ixz="0", iyz="0")
    return link


def _joint(robot: ET.Element, name: str, kind: str, parent: str, child: str, offset: np.ndarray) -> ET.Element:
    """Adds a joint at an offset (3,) in its parent's frame."""
    joint = ET.SubElement(robot, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", xyz=_numbers(offset), rpy="0 0 0")
    return joint


def _add_capsules(link: ET.Element, motion: GraspMotion, index: int) -> None:
    """Each capsule as a cylinder and two spheres, which is what URDF has."""
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
    """Nine digits."""
    return f"{value:.9g}"


def _numbers(values: np.ndarray) -> str:
    """Numbers of a vector."""
    return " ".join(map(_number, values))


def forward_kinematics(urdf: str, angles: Mapping[str, np.ndarray], wrist: np.ndarray) -> dict[str, np.ndarray]:
    """Poses (T, 4, 4) of all links, worked out by MuJoCo from the file's text.

    Args:
      urdf: the text.
      angles: (T,) of each joint by name, rad.
      wrist: (T, 4, 4) poses of the root.
    """
    robot = ET.fromstring(urdf)
    extension = ET.SubElement(robot, "mujoco")  # else links without joints are merged, and pictures thrown away
    ET.SubElement(extension, "compiler", fusestatic="false")
    model = mujoco.MjModel.from_xml_string(ET.tostring(robot, "unicode"))
    data = mujoco.MjData(model)
    bodies = [model.body(i) for i in range(1, model.nbody)]
    poses = {body.name: np.zeros_like(wrist) for body in bodies}
    for t in range(len(wrist)):
        for name, values in angles.items():
            data.qpos[model.joint(name).qposadr[0]] = values[t]
        mujoco.mj_kinematics(model, data)
        turns = Rotation.from_matrix(data.xmat[1:].reshape(-1, 3, 3))
        for body, pose in zip(bodies, pose_matrices(data.xpos[1:], turns), strict=True):
            poses[body.name][t] = wrist[t] @ pose
    return poses
