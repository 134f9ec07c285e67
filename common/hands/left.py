"""Left hands, as mirror images of right ones."""

import dataclasses
import functools

from congrasp.common import mirror
from congrasp.common.hands.spec import Capsule, Hand, Joint, Link, Solid, Vector, vector

LEFT = "_left"
"""Ends the name of a left hand."""
SIDE = ":left"
"""The same, as a user may write it."""


def right_name(name: str) -> tuple[str, bool]:
    """Name of the right hand whose mirror image a hand is, or its own name; and True if it is a left hand."""
    for ending in (SIDE, LEFT):
        if name.endswith(ending):
            return name.removesuffix(ending), True
    return name, False


@functools.cache
def left_hand(hand: Hand) -> Hand:
    """The left hand of a right one, with the same names, angles, limits and gains."""
    return dataclasses.replace(hand, name=hand.name + LEFT, links=tuple(map(_link, hand.links)))


def _link(link: Link) -> Link:
    """A mirrored link."""
    return dataclasses.replace(
        link,
        joints=tuple(map(_joint, link.joints)),
        capsules=tuple(Capsule(_point(x.start), _point(x.end), x.radius) for x in link.capsules),
        tip=link.tip and _point(link.tip),
        solids=tuple(map(_solid, link.solids)),
    )


def _joint(joint: Joint) -> Joint:
    """A mirrored joint, whose angles mean the same."""
    return dataclasses.replace(joint, axis=vector(mirror.axial(joint.axis)), anchor=_point(joint.anchor))


def _solid(solid: Solid) -> Solid:
    """A mirrored solid; each kind is symmetric in its own frame."""
    w, x, y, z = mirror.quaternion(solid.quaternion).tolist()
    return dataclasses.replace(solid, position=_point(solid.position), quaternion=(w, x, y, z))


def _point(point: Vector) -> Vector:
    """A mirrored point."""
    return vector(mirror.vector(point))
