"""Inertias of the links in a URDF file, completed as MuJoCo requires.

MuJoCo rejects a moving body whose mass or principal inertia is not positive, or whose principal
moments violate the triangle inequality: each is at most the sum of the other two. It also rejects a
link with several inertials, and an inertia that lacks one of its six numbers.
"""

import math
import xml.etree.ElementTree as ET

from congrasp.services.assets.hands.reading import FaultyFile, listed
from congrasp.services.assets.hands.urdf_numbers import number_of

LEAST_MASS = 1e-3
"""Mass that `compile` gives to moving links without any, kg."""
LEAST_INERTIA = 1e-7
"""Principal moment that `compile` gives to moving links without any, kg.m^2."""
_FINGER_RADIUS = 0.02  # m
_BALL_INERTIA_PER_KG = 0.4 * _FINGER_RADIUS**2
"""Moment of inertia of a ball with the radius of a finger link, for each kg of its mass, m^2."""
_MOMENTS = ("ixx", "iyy", "izz")
_PRODUCTS = ("ixy", "ixz", "iyz")
_PRODUCT_OF_OTHER_AXES = {"ixx": "iyz", "iyy": "ixz", "izz": "ixy"}


class _CompletedLinks:
    """Names of links whose inertia was completed, for the notes."""

    def __init__(self) -> None:
        self.got_ball: list[str] = []
        self.got_third_moment: list[str] = []
        self.lost_inertial: list[str] = []

    def notes(self) -> list[str]:
        """Returns notes on the completed links."""
        notes = listed(
            "links with one axis of inertia or without '<inertia>' get that of a ball of their "
            "mass, 4 cm wide",
            self.got_ball,
        )
        notes += listed(
            "links with inertia about two axes get the least possible about the third",
            self.got_third_moment,
        )
        notes += listed(
            "'<inertial>' without mass, which follows from the link's shapes", self.lost_inertial
        )
        return notes


def complete_inertias(robot: ET.Element, notes: list[str]) -> None:
    """Completes the inertials of a robot's links.

    Of several inertials of a link, the first is kept. An inertial without mass is removed, so that
    MuJoCo computes it from the link's shapes.

    Args:
      robot: the root element.
      notes: notes on completed links are appended.

    Raises:
      FaultyFile: a mass is negative, or a number cannot be read.
    """
    completed = _CompletedLinks()
    for link in robot.findall("link"):
        inertials = link.findall("inertial")
        for repeated in inertials[1:]:
            link.remove(repeated)
        if inertials:
            _complete(link, inertials[0], completed)
    notes += completed.notes()


def _complete(link: ET.Element, inertial: ET.Element, completed: _CompletedLinks) -> None:
    """Completes the inertial of a link; it is removed if it has no mass."""
    name = link.get("name", "")
    mass_element = inertial.find("mass")
    if mass_element is None or mass_element.get("value") is None:
        link.remove(inertial)
        completed.lost_inertial.append(name)
        return
    mass = number_of(mass_element, "value", link)
    if mass < 0:
        raise FaultyFile(f"the mass of the link '{name[:40]}' is {mass:g}, below zero. Correct it")
    inertia = inertial.find("inertia")
    if inertia is None:
        inertia = ET.SubElement(inertial, "inertia")
    nonzero_axes = [axis for axis in _MOMENTS if number_of(inertia, axis, link)]
    if mass and len(nonzero_axes) < 2:
        inertia.attrib = dict.fromkeys(_MOMENTS, str(_BALL_INERTIA_PER_KG * mass))
        completed.got_ball.append(name)
    elif mass and len(nonzero_axes) == 2:
        _add_third_moment(link, inertia, nonzero_axes)
        completed.got_third_moment.append(name)
    # Absent numbers become zero
    for attribute in (*_MOMENTS, *_PRODUCTS):
        inertia.set(attribute, str(number_of(inertia, attribute, link)))


def _add_third_moment(link: ET.Element, inertia: ET.Element, nonzero_axes: list[str]) -> None:
    """Adds the least possible moment about the missing axis, which becomes a principal axis.

    The triangle inequality requires at least the difference of the other two principal moments.
    """
    (missing_axis,) = set(_MOMENTS) - set(nonzero_axes)
    first, second = (number_of(inertia, axis, link) for axis in nonzero_axes)
    product_name = _PRODUCT_OF_OTHER_AXES[missing_axis]
    product = number_of(inertia, product_name, link)
    difference = math.hypot(first - second, 2.0 * product)
    inertia.set(missing_axis, str(difference + min(LEAST_INERTIA, first, second)))
    for name in _PRODUCTS:
        if name != product_name:
            inertia.set(name, "0")
