"""Checks of the joints in a URDF file: links, limits, frames and mimics."""

import math
import re
import xml.etree.ElementTree as ET

from congrasp.services.assets.hands.reading import FaultyFile
from congrasp.services.assets.hands.urdf_numbers import number_of

_KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar", "spherical")
_DECIMAL = re.compile(r"(?<!\S)[-+]?\d+(?:\.\d*)?(?!\S)")
_MAX_ANGLE = 7.0
"""Largest angle of a joint's frame, rad, except multiples of a right angle."""
_RIGHT_ANGLE = math.pi / 2
_ANGLE_TOLERANCE = 1e-3


def check_joints(robot: ET.Element, notes: list[str]) -> None:
    """Checks the joints of a robot, and removes what MuJoCo would reject or drop.

    These are limits of effort or velocity below zero, and mimics of joints that do not move.

    Args:
      robot: the root element.
      notes: removed mimics are appended.

    Raises:
      FaultyFile: a joint has a frame in degrees, an unknown type, a missing link or exchanged
        limits.
    """
    links = {link.get("name") for link in robot.findall("link")}
    kinds = {joint.get("name"): joint.get("type") for joint in robot.findall("joint")}
    for joint in robot.findall("joint"):
        _check_frame(joint)
        _check_kind(joint)
        _check_links(joint, links)
        _check_limits(joint)
        _check_mimic(joint, kinds, notes)


def _check_frame(joint: ET.Element) -> None:
    """Raises a FaultyFile for a frame in degrees."""
    for origin in joint.findall("origin"):
        for angle in _DECIMAL.findall(origin.get("rpy", "")):
            is_large = abs(float(angle)) > _MAX_ANGLE
            remainder = (float(angle) + _ANGLE_TOLERANCE) % _RIGHT_ANGLE
            if is_large and remainder >= 2 * _ANGLE_TOLERANCE:
                raise FaultyFile(
                    f"rpy of the joint '{joint.get('name', '')}' has {angle}. Write radians, not "
                    f"degrees"
                )


def _check_kind(joint: ET.Element) -> None:
    """Raises a FaultyFile for an unknown type."""
    kind = joint.get("type", "")
    if kind not in _KINDS:
        raise FaultyFile(
            f"the type of the joint '{joint.get('name', '')}' is '{kind[:40]}'. Write one of: "
            f"{', '.join(_KINDS)}"
        )


def _check_links(joint: ET.Element, links: set[str | None]) -> None:
    """Raises a FaultyFile for a joint between links that do not exist."""
    for end in ("parent", "child"):
        element = joint.find(end)
        link = None if element is None else element.get("link")
        if link not in links:
            raise FaultyFile(
                f"the {end} of the joint '{joint.get('name', '')}' is the link '{link}', which "
                f"does not exist. Correct it"
            )


def _check_limits(joint: ET.Element) -> None:
    """Raises a FaultyFile for limits in the wrong order; sets effort and velocity to zero at least.

    MuJoCo rejects negative ones, with which some writers mean none.
    """
    limit = joint.find("limit")
    if limit is None:
        return
    lower = number_of(limit, "lower", joint)
    upper = number_of(limit, "upper", joint)
    if lower > upper:
        raise FaultyFile(
            f"the lower limit {lower:g} of the joint '{joint.get('name', '')}' is above the upper "
            f"{upper:g}. Swap them"
        )
    for bound in ("effort", "velocity"):
        if number_of(limit, bound, joint) < 0:
            limit.set(bound, "0")


def _check_mimic(joint: ET.Element, kinds: dict[str | None, str | None], notes: list[str]) -> None:
    """Removes a mimic of a joint that does not move this one."""
    mimic = joint.find("mimic")
    if mimic is None:
        return
    name = joint.get("name", "")
    leader = mimic.get("joint", "")
    if leader == name:
        reason = "which is itself"
    elif not number_of(mimic, "multiplier", joint, 1.0):
        reason = "with the multiplier 0"
    elif kinds.get(leader) is None:
        reason = "which does not exist"
    elif kinds[leader] == "fixed":
        reason = "which is fixed"
    else:
        return
    joint.remove(mimic)
    notes.append(
        f"'{name}' mimics '{leader}', {reason}: it has a motor of its own ('couplings' in the hand "
        f"file)"
    )
