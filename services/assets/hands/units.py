"""Checks of lengths, angles and masses that no hand has; the remedy names the likely unit."""

import pathlib

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Joint, Link
from congrasp.services.assets.objects.sizes import length
from congrasp.services.assets.objects.units import METRES

MIN_LINK = 5e-4
"""Length of the smallest link, m."""
MAX_LINK = 0.5
"""Length of the largest link, m."""
_MAX_DISTANCE = 1.0
"""Distance of a joint from the palm's origin, m."""
_MAX_ANGLE = 7.0
"""Largest limit of a joint, rad."""
_MAX_MASS = 5.0
"""Mass of a link, kg."""
_NOT_OF_A_HAND = ", which is no hand's."
_SCALED_TWICE = "Has a scale such as 0.001 been applied twice? Lengths are in metres."
_DEGREES = (
    "Are its limits in degrees? A URDF has radians; an MJCF has degrees, unless <compiler "
    'angle="radian"/>.'
)
_GRAMS = "Is its mass in grams? Masses are in kg."


def check_size(path: pathlib.Path, link: str, points: list[np.ndarray]) -> None:
    """Checks the length of a link.

    Args:
      path: file of the hand.
      link: name of the link.
      points: (3,) of its geometry, m; none for a link without any.

    Raises:
      CongraspError: no hand has such a link.
    """
    if not points:
        return
    size = float(np.ptp(points, axis=0).max())
    if size > MAX_LINK:
        remedy = _smaller_unit(size)
    elif size < MIN_LINK:
        remedy = _SCALED_TWICE
    else:
        return
    raise CongraspError(f"{path}: the link '{link}' is {length(size)} long{_NOT_OF_A_HAND}", remedy)


def check_units(path: pathlib.Path, links: list[Link]) -> None:
    """Checks the distances, angles and masses of links.

    Args:
      path: file of the hand.
      links: its links.

    Raises:
      CongraspError: no hand has such a link.
    """
    for link in links:
        _check_distance(path, link)
        _check_angles(path, link)
        _check_mass(path, link)


def _check_distance(path: pathlib.Path, link: Link) -> None:
    """Raises a CongraspError for a joint so far from the palm that its file is in millimetres."""
    distances = [float(np.linalg.norm(joint.anchor)) for joint in link.joints]
    farthest = max(distances, default=0.0)
    if farthest > _MAX_DISTANCE:
        raise CongraspError(
            f"{path}: the joint of the link '{link.name}' is {length(farthest)} away from the palm"
            f"{_NOT_OF_A_HAND}",
            _smaller_unit(farthest),
        )


def _check_angles(path: pathlib.Path, link: Link) -> None:
    """Raises a CongraspError for a joint that turns so far that its limits are in degrees."""
    largest = max(link.joints, key=lambda joint: (_largest_angle(joint), joint.name), default=None)
    if largest is None:
        return
    angle = _largest_angle(largest)
    if angle > _MAX_ANGLE:
        raise CongraspError(
            f"{path}: the joint '{largest.name}' has a limit of {angle:.4g} rad{_NOT_OF_A_HAND}",
            _DEGREES,
        )


def _largest_angle(joint: Joint) -> float:
    """Largest angle of a joint, rad."""
    return max(-joint.lower, joint.upper)


def _check_mass(path: pathlib.Path, link: Link) -> None:
    """Raises a CongraspError for a link so heavy that its mass is in grams."""
    if link.mass > _MAX_MASS:
        raise CongraspError(
            f"{path}: the link '{link.name}' weighs {link.mass:.4g} kg{_NOT_OF_A_HAND}", _GRAMS
        )


def _smaller_unit(size: float) -> str:
    """Remedy for a length of a hand, supposed to be m, that is too large."""
    units = []
    for unit, metres in METRES.items():
        if size * metres < MAX_LINK:
            units.append(f"{unit} ({length(size * metres)})")
    question = f"Are its lengths in {' or '.join(units)}? " if units else ""
    return (
        f'{question}Give meshes a scale such as "0.001 0.001 0.001", and offsets in metres; or '
        f"pass another --palm."
    )
