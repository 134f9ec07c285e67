"""Links of a hand that drive a finger from beside it, such as the crank of a gripper's finger."""

import functools

from congrasp.common.hands.mjcf import overlapping
from congrasp.common.hands.motors import transmission
from congrasp.common.hands.spec import Hand


@functools.cache
def linkage_pairs(hand: Hand) -> frozenset[tuple[str, str]]:
    """Returns each link of no finger that drives one, with the finger's link on which it is pinned.

    A motor moves both, and their shapes overlap where the pin is. The shape of a finger whose tip
    is missing does not.
    """
    motor_of_joint = transmission(hand).motor
    motors: dict[str, set[int]] = {link.name: set() for link in hand.links}
    for joint, motor in enumerate(motor_of_joint):
        motors[hand.links[hand.joint_links[joint]].name].add(int(motor))
    fingers = dict(zip(motors, hand.link_fingers, strict=True))
    pairs = set()
    for first, second in overlapping(hand):
        for link, other in ((first, second), (second, first)):
            if fingers[link] < 0 <= fingers[other] and motors[link] & motors[other]:
                pairs.add((link, other))
    return frozenset(pairs)
