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
HUMAN_OPEN_GAP_M = 0.106
"""Opening in m between thumb and fingers of the human hand, whose object scale is one."""
_SCALE_EXPONENT = 0.6
_MIN_SCALE = 0.3
_MAX_SCALE = 3.0
_MIN_LEVER_M = 1e-6
"""Least displacement of a tip per radian of a motor, m."""


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
    """Returns the mapping between the hand's motors and joints, as arrays."""
    index = {joint.name: j for j, joint in enumerate(hand.joints)}
    most_joints = max(len(motor.joints) for motor in hand.motors)
    pulled = np.zeros((len(hand.motors), most_joints), int)
    coefficients = np.zeros((len(hand.motors), most_joints))
    motor_of_joint = np.zeros(len(index), int)
    ratio = np.ones(len(index))
    rest = np.zeros(len(index))
    for m, motor in enumerate(hand.motors):
        joints = np.array([index[name] for name in motor.joints])
        c = np.array([*motor.joints.values()])
        pulled[m, : len(c)] = joints
        coefficients[m, : len(c)] = c
        motor_of_joint[joints] = m
        if len(c) > 1:
            ratio[joints], rest[joints] = _tendon_motion(hand, joints, c)
        else:
            ratio[joints] = 1.0 / c
    for coupling in hand.couplings:
        follower = index[coupling.joint]
        leader = index[coupling.leader]
        motor_of_joint[follower] = motor_of_joint[leader]
        ratio[follower] = coupling.ratio * ratio[leader]
        rest[follower] = coupling.offset + coupling.ratio * rest[leader]
    return _Transmission(
        pulled=pulled,
        coefficients=coefficients.astype(np.float32),
        motor=motor_of_joint,
        ratio=ratio.astype(np.float32),
        rest=rest.astype(np.float32),
        limits=_motor_limits(hand, motor_of_joint, ratio, rest).astype(np.float32),
    )


def _tendon_motion(
    hand: Hand, joints: np.ndarray, coefficients: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Motion of the joints of a tendon, which reach their limits together.

    Args:
      hand: the hand.
      joints: (T,) indices of the joints.
      coefficients: (T,) of the joints.

    Returns:
      Radians (T,) of each joint per radian of the motor, and its angle (T,) where that is at zero.
    """
    lower = np.array([hand.joints[j].lower for j in joints])
    upper = np.array([hand.joints[j].upper for j in joints])
    start = np.where(coefficients > 0, lower, upper)
    end = np.where(coefficients > 0, upper, lower)
    ratio = (end - start) / (coefficients @ (end - start))
    return ratio, start - ratio * (coefficients @ start)


def _motor_limits(
    hand: Hand, motor_of_joint: np.ndarray, ratio: np.ndarray, rest: np.ndarray
) -> np.ndarray:
    """Positions (2, M) of the motors between which all of their joints are within their limits."""
    at_lower = (hand.lower - rest) / ratio
    at_upper = (hand.upper - rest) / ratio
    first, last = np.sort([at_lower, at_upper], axis=0)
    limits = np.zeros((2, len(hand.motors)))
    for m in range(len(hand.motors)):
        limits[0, m] = first[motor_of_joint == m].max()
        limits[1, m] = last[motor_of_joint == m].min()
    return limits


def motor_positions(hand: Hand, q: Array) -> Array:
    """Positions (..., M) of the motors at joint angles (..., F), rad."""
    if len(hand.motors) == len(hand.joints):
        return q
    mapping = transmission(hand)
    return (mapping.coefficients * q[..., mapping.pulled]).sum(-1)


def joint_positions(hand: Hand, motors: Array) -> Array:
    """Joint angles (..., F) for positions (..., M) of the motors, rad; joints of a tendon move
    together.
    """
    if len(hand.motors) == len(hand.joints):
        return motors
    mapping = transmission(hand)
    return mapping.ratio * motors[..., mapping.motor] + mapping.rest


def motor_limits(hand: Hand) -> np.ndarray:
    """Lowest and highest motor positions (2, M), rad."""
    return transmission(hand).limits


def follow_couplings(hand: Hand, q: Array) -> Array:
    """Joint angles (..., F) with coupled joints set by their leaders."""
    if not hand.couplings:
        return q
    names = [joint.name for joint in hand.joints]
    leader = np.arange(len(names))
    ratio = np.ones(len(names), np.float32)
    offset = np.zeros(len(names), np.float32)
    for coupling in hand.couplings:
        follower = names.index(coupling.joint)
        leader[follower] = names.index(coupling.leader)
        ratio[follower] = coupling.ratio
        offset[follower] = coupling.offset
    return ratio * q[..., leader] + offset


def fitting_scale(opening: float) -> float:
    """Returns the factor on object lengths for a hand with this opening (m), to one decimal.

    s = (opening / human opening)^0.6. The exponent is that of the paper's two factors: an opening
    1.75 times the human hand's gives Allegro's 1.4, one of 1.16 times Sharpa's 1.1. It is below one
    because the mass of an object grows with the cube of its lengths.
    """
    scale = (opening / HUMAN_OPEN_GAP_M) ** _SCALE_EXPONENT
    return round(float(np.clip(scale, _MIN_SCALE, _MAX_SCALE)), 1)


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
    mapping = transmission(hand)
    finger = chain_of(hand, link.name)
    displacements: dict[int, np.ndarray] = {}
    """Displacement (3,) of the tip per radian of each motor, m."""
    for j, joint in enumerate(hand.joints):
        if hand.links[hand.joint_links[j]].name not in finger:
            continue
        lever = np.cross(joint.axis, np.subtract(link.tip, joint.anchor))
        motor = int(mapping.motor[j])
        displacements[motor] = displacements.get(motor, np.zeros(3)) + mapping.ratio[j] * lever
    forces = []
    for motor, displacement in displacements.items():
        length = max(float(np.linalg.norm(displacement)), _MIN_LEVER_M)
        forces.append(hand.motors[motor].torque_limit / length)
    return min(forces)
