"""Left hands: mirror images of right ones."""

import dataclasses
import functools

from congrasp.common import mirror
from congrasp.common.hands.spec import Capsule, Hand, Joint, Link, Solid, Vector, vector

LEFT = "_left"
"""End of the name of a left hand."""
SIDE = ":left"
"""The same end, as a user may write it."""


@functools.cache
def left_hand(hand: Hand) -> Hand:
    """Returns the left hand of a right one, with the same angles, limits and gains.

    Its links and joints have the same names.
    """
    links = tuple(_mirrored_link(link) for link in hand.links)
    return dataclasses.replace(hand, name=hand.name + LEFT, links=links)


def _mirrored_link(link: Link) -> Link:
    """Returns a mirrored link."""
    return dataclasses.replace(
        link,
        joints=tuple(_mirrored_joint(joint) for joint in link.joints),
        capsules=tuple(_mirrored_capsule(capsule) for capsule in link.capsules),
        tip=link.tip and _mirrored_point(link.tip),
        solids=tuple(_mirrored_solid(solid) for solid in link.solids),
    )


def _mirrored_joint(joint: Joint) -> Joint:
    """Returns a mirrored joint, whose angles mean the same."""
    return dataclasses.replace(
        joint,
        axis=vector(mirror.axial(joint.axis)),
        anchor=_mirrored_point(joint.anchor),
    )


def _mirrored_capsule(capsule: Capsule) -> Capsule:
    """Returns a mirrored capsule."""
    start = _mirrored_point(capsule.start)
    end = _mirrored_point(capsule.end)
    return Capsule(start, end, capsule.radius)


def _mirrored_solid(solid: Solid) -> Solid:
    """Returns a mirrored solid; each kind is symmetric in its own frame."""
    w, x, y, z = mirror.quaternion(solid.quaternion).tolist()
    position = _mirrored_point(solid.position)
    return dataclasses.replace(solid, position=position, quaternion=(w, x, y, z))


def _mirrored_point(point: Vector) -> Vector:
    """Returns a mirrored point."""
    return vector(mirror.vector(point))
