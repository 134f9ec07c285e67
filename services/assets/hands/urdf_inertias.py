"""Inertias of the links in a URDF file, completed as MuJoCo requires."""

import xml.etree.ElementTree as ET

from congrasp.services.assets.hands.reading import FaultyFile, listed
from congrasp.services.assets.hands.urdf_numbers import number_of

LEAST_MASS = 1e-3
"""Mass of moving links without any, kg."""
LEAST_INERTIA = 1e-7
"""Inertia of moving links without any, kg.m^2."""
_BALL_INERTIA = 0.4 * 0.02**2
"""Inertia for each kg of a ball with the radius of a finger link, m^2."""
_DIAGONAL = ("ixx", "iyy", "izz")
_OFF_DIAGONAL = ("ixy", "ixz", "iyz")


class _Proposals:
    """Names of links whose inertias are proposed."""

    def __init__(self) -> None:
        self.guessed: list[str] = []
        self.raised: list[str] = []
        self.without_mass: list[str] = []

    def notes(self) -> list[str]:
        """Returns notes on the proposals."""
        notes = listed(
            "links with one axis of inertia or without '<inertia>' get that of a ball of their "
            "mass, 4 cm wide",
            self.guessed,
        )
        notes += listed(
            "links with inertia about two axes get the least possible about the third", self.raised
        )
        notes += listed(
            "'<inertial>' without mass, which follows from the link's shapes", self.without_mass
        )
        return notes


def complete_inertias(robot: ET.Element, notes: list[str]) -> None:
    """Removes repeated inertials and those without mass, and adds the inertias that MuJoCo needs.

    Args:
      robot: the root element.
      notes: proposals are appended.

    Raises:
      FaultyFile: a mass is negative, or a number cannot be read.
    """
    proposals = _Proposals()
    for link in robot.findall("link"):
        inertials = link.findall("inertial")
        for repeated in inertials[1:]:
            link.remove(repeated)
        if inertials:
            _complete(link, inertials[0], proposals)
    notes += proposals.notes()


def _complete(link: ET.Element, inertial: ET.Element, proposals: _Proposals) -> None:
    """Completes the inertial of a link; it is removed if it has no mass."""
    name = link.get("name", "")
    mass_element = inertial.find("mass")
    if mass_element is None or mass_element.get("value") is None:
        link.remove(inertial)
        proposals.without_mass.append(name)
        return
    mass = number_of(mass_element, "value", link)
    if mass < 0:
        raise FaultyFile(f"the mass of the link '{name[:40]}' is {mass:g}, below zero. Correct it")
    inertia = inertial.find("inertia")
    if inertia is None:
        inertia = ET.SubElement(inertial, "inertia")
    moments = {axis: number_of(inertia, axis, link) for axis in _DIAGONAL}
    nonzero = [moment for moment in moments.values() if moment]
    if mass and len(nonzero) < 2:
        inertia.attrib = dict.fromkeys(_DIAGONAL, str(_BALL_INERTIA * mass))
        proposals.guessed.append(name)
    elif mass and len(nonzero) == 2:  # an axis has at least the difference of the others
        zero = next(axis for axis in _DIAGONAL if not moments[axis])
        difference = abs(nonzero[0] - nonzero[1])
        inertia.set(zero, str(difference + min(LEAST_INERTIA, *nonzero)))
        proposals.raised.append(name)
    for axis in (*_DIAGONAL, *_OFF_DIAGONAL):
        inertia.set(axis, str(number_of(inertia, axis, link)))
