"""Motors and the joints they move, for underactuated hands: coupled and tendon-driven ones.

A policy commands motors; the task observes joints. The position of a motor is the sum of its
joints' angles times their coefficients. Contact decides how the joints of a tendon share a motion;
where targets need one angle for each, they are assumed to move together from limit to limit. For a
hand with a motor for every joint all of this is the identity.

Arrays are NumPy's or JAX's.
"""

import functools
from typing import Any, NamedTuple

import numpy as np

from congrasp.common.hands.spec import Hand, Link, chain_of

Array = Any


class _Transmission(NamedTuple):
    """Mapping between a hand's motors (M) and joints (F)."""

    pulled: np.ndarray
    """(M, T) indices of the joints of each motor."""
    coefficients: np.ndarray
    """(M, T), 0 where a motor pulls fewer than T joints."""
    motor: np.ndarray
    """(F,) index of the motor that moves each joint, directly or by its leader."""
    ratio: np.ndarray
    """(F,) radians of a joint per radian of its motor."""
    rest: np.ndarray
    """(F,) angle of a joint where its motor is at zero."""
    limits: np.ndarray
    """(2, M) lowest and highest position of each motor with all of its joints within their
    limits.
    """


@functools.lru_cache(maxsize=64)
def transmission(hand: Hand) -> _Transmission:
    """The hand's motors and joints, as arrays."""
    index = {joint.name: j for j, joint in enumerate(hand.joints)}
    most = max(len(motor.joints) for motor in hand.motors)
    pulled, coefficients = (
        np.zeros((len(hand.motors), most), int),
        np.zeros((len(hand.motors), most)),
    )
    owner, ratio, rest = np.zeros(len(index), int), np.ones(len(index)), np.zeros(len(index))
    for m, motor in enumerate(hand.motors):
        joints, c = (
            np.array([index[name] for name in motor.joints]),
            np.array([*motor.joints.values()]),
        )
        pulled[m, : len(c)], coefficients[m, : len(c)] = joints, c
        owner[joints] = m
        if len(c) > 1:
            lower, upper = (
                np.array([getattr(hand.joints[j], side) for j in joints])
                for side in ("lower", "upper")
            )
            start, end = np.where(c > 0, (lower, upper), (upper, lower))
            ratio[joints] = (end - start) / (c @ (end - start))
            rest[joints] = start - ratio[joints] * (c @ start)
        else:
            ratio[joints] = 1.0 / c
    for coupling in hand.couplings:
        j, leader = index[coupling.joint], index[coupling.leader]
        owner[j], ratio[j] = owner[leader], coupling.ratio * ratio[leader]
        rest[j] = coupling.offset + coupling.ratio * rest[leader]
    ends = np.sort([((getattr(hand, side) - rest) / ratio) for side in ("lower", "upper")], axis=0)
    limits = np.array(
        [
            [ends[0][owner == m].max() for m in range(len(pulled))],
            [ends[1][owner == m].min() for m in range(len(pulled))],
        ]
    )
    single = (x.astype(np.float32) for x in (ratio, rest, limits))
    return _Transmission(pulled, coefficients.astype(np.float32), owner, *single)


def motor_positions(hand: Hand, q: Array) -> Array:
    """Positions (..., M) of the motors at joint angles (..., F), rad."""
    if len(hand.motors) == len(hand.joints):
        return q
    own = transmission(hand)
    return (own.coefficients * q[..., own.pulled]).sum(-1)


def joint_positions(hand: Hand, motors: Array) -> Array:
    """Joint angles (..., F) for positions (..., M) of the motors, rad; joints of a tendon move
    together.
    """
    if len(hand.motors) == len(hand.joints):
        return motors
    own = transmission(hand)
    return own.ratio * motors[..., own.motor] + own.rest


def motor_limits(hand: Hand) -> np.ndarray:
    """Lowest and highest motor positions (2, M), rad."""
    return transmission(hand).limits


def coupled(hand: Hand, q: Array) -> Array:
    """Joint angles (..., F) with coupled joints set by their leaders."""
    if not hand.couplings:
        return q
    names = [joint.name for joint in hand.joints]
    leader, ratio, offset = (
        np.arange(len(names)),
        np.ones(len(names), np.float32),
        np.zeros(len(names), np.float32),
    )
    for coupling in hand.couplings:
        j = names.index(coupling.joint)
        leader[j], ratio[j], offset[j] = (
            names.index(coupling.leader),
            coupling.ratio,
            coupling.offset,
        )
    return ratio * q[..., leader] + offset


HUMAN_OPENING = 0.106
"""Opening in m between thumb and fingers of the human hand, whose object scale is one."""
_EXPONENT = 0.6
_SCALES = 0.3, 3.0


def fitting_scale(opening: float) -> float:
    """Returns the factor on object lengths for a hand with this opening (m), to one decimal.

    s = (opening / human opening)^0.6. The exponent is that of the paper's two factors: an opening
    1.75 times the human hand's gives Allegro's 1.4, one of 1.16 times Sharpa's 1.1. It is below one
    because the mass of an object grows with the cube of its lengths.
    """
    return round(float(np.clip((opening / HUMAN_OPENING) ** _EXPONENT, *_SCALES)), 1)


@functools.cache
def tip_forces(hand: Hand) -> np.ndarray:
    """Greatest forces (G,) in N with which the fingertips can press, thumb first, with straight
    fingers.

    The force of a finger is the minimum over its motors of torque limit / |dx/dm|, where |dx/dm| is
    the displacement of the tip per radian of the motor, including all joints that it moves. For a
    motor of one joint it is the distance of the joint's axis from the tip. The tip can bear this
    force in any direction.
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
    return min(
        hand.motors[m].torque_limit / max(float(np.linalg.norm(way)), 1e-6)
        for m, way in ways.items()
    )
