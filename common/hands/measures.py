"""A hand's size and strength in a few numbers, from which its training follows (`services.train.recipe`)."""

import functools

import numpy as np

from common.hands.spec import Hand, Link, chain_of

HUMAN_OPENING = 0.106
"""m between thumb and fingers of the human hand, which grasps objects of their own size."""
_EXPONENT = 0.6
_SCALES = 0.3, 3.0


def fitting_scale(opening: float) -> float:
    """The factor on the objects of a hand that opens so wide (m), to one decimal.

    s = (opening / human opening)^0.6. The exponent is that of the paper's two factors: an opening 1.75 times the human
    hand's gives Allegro's 1.4, one of 1.16 times Sharpa's 1.1. It is below one since at the same density an object's
    mass grows with the cube of its lengths.
    """
    return round(float(np.clip((opening / HUMAN_OPENING) ** _EXPONENT, *_SCALES)), 1)


@functools.cache
def tip_forces(hand: Hand) -> np.ndarray:
    """(G,) the forces in N with which the fingertips can press, thumb first, with the fingers straight.

    Of a finger it is the least over its joints of torque limit / distance of the joint's axis from the tip: what the
    tip bears whichever way it presses.
    """
    return np.array([_force(hand, hand.links[i]) for i in hand.tip_links])


def _force(hand: Hand, link: Link) -> float:
    """The force of the finger that ends with this link."""
    links = {other.name: other for other in hand.links}
    joints = [joint for name in chain_of(hand, link.name) for joint in links[name].joints]
    assert link.tip is not None
    ways = [np.subtract(link.tip, joint.anchor) for joint in joints]
    levers = [float(np.linalg.norm(np.cross(joint.axis, way))) for joint, way in zip(joints, ways, strict=True)]
    return min(joint.torque_limit / max(lever, 1e-6) for joint, lever in zip(joints, levers, strict=True))
