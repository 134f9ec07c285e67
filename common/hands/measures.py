"""Size and strength of a hand in a few numbers that determine its training (`services.train.recipe`)."""

import functools

import numpy as np

from congrasp.common.hands.motors import transmission
from congrasp.common.hands.spec import Hand, Link, chain_of

HUMAN_OPENING = 0.106
"""Opening in m between thumb and fingers of the human hand, whose object scale is one."""
_EXPONENT = 0.6
_SCALES = 0.3, 3.0


def fitting_scale(opening: float) -> float:
    """Returns the factor on object lengths for a hand with this opening (m), to one decimal.

    s = (opening / human opening)^0.6. The exponent is that of the paper's two factors: an opening 1.75 times the human
    hand's gives Allegro's 1.4, one of 1.16 times Sharpa's 1.1. It is below one because the mass of an object grows with
    the cube of its lengths.
    """
    return round(float(np.clip((opening / HUMAN_OPENING) ** _EXPONENT, *_SCALES)), 1)


@functools.cache
def tip_forces(hand: Hand) -> np.ndarray:
    """Greatest forces (G,) in N with which the fingertips can press, thumb first, with straight fingers.

    The force of a finger is the minimum over its motors of torque limit / |dx/dm|, where |dx/dm| is the displacement of
    the tip per radian of the motor, including all joints that it moves. For a motor of one joint it is the distance of
    the joint's axis from the tip. The tip can bear this force in any direction.
    """
    return np.array([_force(hand, hand.links[i]) for i in hand.tip_links])


def _force(hand: Hand, link: Link) -> float:
    """Returns the force of the finger that ends with this link, N."""
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
