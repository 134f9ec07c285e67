"""A hand's size and strength in a few numbers, from which its training follows (`services.train.recipe`)."""

import functools

import numpy as np

from congrasp.common.hands.motors import transmission
from congrasp.common.hands.spec import Hand, Link, chain_of

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

    Of a finger it is the least over its motors of torque limit / |dx/dm|, the tip's way for a radian of the motor with
    all of the joints that it moves: where it moves one, the distance of the joint's axis from the tip. That is what the
    tip bears whichever way it presses.
    """
    return np.array([_force(hand, hand.links[i]) for i in hand.tip_links])


def _force(hand: Hand, link: Link) -> float:
    """The force of the finger that ends with this link."""
    assert link.tip is not None
    own, finger = transmission(hand), chain_of(hand, link.name)
    moved = [joint for other in hand.links for joint in other.joints if other.name in finger]
    index = {joint.name: j for j, joint in enumerate(hand.joints)}
    ways: dict[int, np.ndarray] = {}
    for joint in moved:
        j = index[joint.name]
        way = own.ratio[j] * np.cross(joint.axis, np.subtract(link.tip, joint.anchor))
        ways[int(own.motor[j])] = ways.get(int(own.motor[j]), np.zeros(3)) + way
    return min(hand.motors[m].torque_limit / max(float(np.linalg.norm(way)), 1e-6) for m, way in ways.items())
