"""Measure of a hand that does not look natural, from joint angles and contacts.

For every hand: a finger that touches nothing rests near a neighbour, neither hooked nor
stretched. For hands with human anatomy also the coupling of the two last joints of a finger, whose
tendons they share: theta_DIP = 2/3 theta_PIP (Rijpkema and Girard 1991, "Computer animation of
knowledge-based human grasping"; Lin, Wu and Huang 2000, "Modeling the constraints of human hand
motion", which also states that neighbouring fingers bend together), and the middle joints of
neighbouring fingers, also in contact: a single finger that is bent into a loop beside straight ones
looks wrong even where it touches the object.

The wrist is not measured. Its flexion and deviation are angles to the forearm, which a hand without
an arm does not have; the direction assumed for it would decide the result.

Bending is counted as a share of the way from the open hand to the fist, so that one measure serves
hands of any size; deviations are converted to radians with the length of that way.
"""

import functools
from typing import NamedTuple

import numpy as np

from congrasp.common.hands.spec import Hand
from congrasp.common.runtime.lazy_jax import jnp
from congrasp.common.task.types import Array

_BENDS = 0.4
"""Least angle between the open hand and the fist of a joint that bends its finger, rad."""
_APART = 0.2
"""Difference in bending between an idle finger and its neighbour that still looks natural."""
_UNEVEN = 0.3
"""Difference in bending between the joints of an idle finger that still looks natural."""
_RESTING = (-0.1, 0.85)
"""Range of bending in which an idle finger is neither stretched nor hooked."""
_DISTAL_RATIO = 2.0 / 3.0
_DISTAL_SLACK = 0.35
"""Deviation from the coupling of DIP and PIP that people show, rad: contacts extend the last
joint."""
_PROXIMAL_GAP = 0.7
"""Difference between the middle joint (PIP) of a finger and that of the neighbour which is most
like it that people show, rad: it is below .74 for the index finger, .48 for the middle and .53 for
the ring finger in nine of ten frames of MyoDM's captured grasps."""
_MAX_DEVIATION_RAD = 1.0
"""Deviation of one finger above which the measure does not grow."""


class FingerJoints(NamedTuple):
    """Joints that bend the G fingers of a hand. The thumb is the first finger, without joints."""

    bends: np.ndarray
    """(G, F) bool: the joint bends the finger."""
    range: np.ndarray
    """(G,) mean angle of these joints between the open hand and the fist, rad."""
    distal: np.ndarray
    """(D,) index of the last joint of each finger with human anatomy."""
    proximal: np.ndarray
    """(D,) index of the joint before it."""
    distal_finger: np.ndarray
    """(D,) index of the finger."""


@functools.cache
def finger_joints(hand: Hand) -> FingerJoints:
    """Returns the joints of a hand's fingers."""
    way = hand.q_closed - hand.q_open
    finger_of_joint = hand.link_fingers[hand.joint_links]
    bends = np.zeros((len(hand.fingers), len(hand.joints)), bool)
    for finger in range(1, len(hand.fingers)):
        bends[finger] = (finger_of_joint == finger) & (np.abs(way) > _BENDS)
    lengths = np.where(bends, np.abs(way), 0.0).sum(-1)
    names = [joint.name for joint in hand.joints]
    distal = []
    if hand.anatomical:
        distal = [i for i, name in enumerate(names) if name.endswith("_dip")]
    proximal = [names.index(names[i].replace("_dip", "_pip")) for i in distal]
    return FingerJoints(
        bends=bends,
        range=lengths / np.maximum(bends.sum(-1), 1),
        distal=np.array(distal, int),
        proximal=np.array(proximal, int),
        distal_finger=finger_of_joint[np.array(distal, int)],
    )


def unnatural(hand: Hand, q: Array, touching: Array) -> Array:
    """Deviation of a hand from natural postures, in rad: the mean over its fingers without the
    thumb; 0 looks natural.

    Args:
      hand: the hand.
      q: (B, F) finger angles, rad.
      touching: (B, L) bool, links in contact.

    Returns:
      (B,) deviations from 0 to 1 rad.
    """
    deviation = finger_deviations(hand, q, touching)
    return jnp.mean(deviation, -1)


def finger_deviations(hand: Hand, q: Array, touching: Array) -> Array:
    """Deviation (B, G - 1) of each finger without the thumb, rad, at most 1; see `unnatural`."""
    joints = finger_joints(hand)
    deviation = joints.range * _idle_deviations(hand, q, touching)
    if len(joints.distal):
        coupled = _DISTAL_RATIO * q[:, joints.proximal]
        off = jnp.maximum(jnp.abs(q[:, joints.distal] - coupled) - _DISTAL_SLACK, 0.0)
        gap = _gap_to_neighbour(q[:, joints.proximal])
        off = off + jnp.maximum(gap - _PROXIMAL_GAP, 0.0)
        deviation = deviation.at[:, joints.distal_finger].add(off)
    return jnp.minimum(deviation[:, 1:], _MAX_DEVIATION_RAD)


def _idle_deviations(hand: Hand, q: Array, touching: Array) -> Array:
    """Deviation (B, G) in bending of each finger that touches nothing; 0 for the others and the
    thumb.
    """
    joints = finger_joints(hand)
    way = jnp.array(np.where(joints.bends.any(0), hand.q_closed - hand.q_open, 1.0))
    bending = (q - hand.q_open) / way
    count = np.maximum(joints.bends.sum(-1), 1)
    of_finger = jnp.where(joints.bends, bending[:, None, :], 0.0)
    mean = jnp.sum(of_finger, -1) / count

    uneven = jnp.where(joints.bends, jnp.abs(bending[:, None, :] - mean[..., None]), 0.0)
    uneven = jnp.maximum(jnp.max(uneven, -1) - _UNEVEN, 0.0)
    lowest, highest = _RESTING
    hooked = jnp.maximum(mean - highest, 0.0)
    stretched = jnp.maximum(lowest - mean, 0.0)
    gap = jnp.pad(_gap_to_neighbour(mean[:, 1:]), ((0, 0), (1, 0)))  # none of the thumb
    apart = jnp.maximum(gap - _APART, 0.0)

    links = hand.link_fingers
    idle = [~jnp.any(touching[:, links == finger], -1) for finger in range(len(hand.fingers))]
    return jnp.stack(idle, -1) * (uneven + hooked + stretched + apart)


def _gap_to_neighbour(angles: Array) -> Array:
    """Difference (B, N) between each finger's value and that of the nearer of its neighbours; 0
    without neighbours.

    Args:
      angles: (B, N) one value of each of N fingers beside each other, without the thumb.
    """
    fingers = angles.shape[-1]
    gaps = []
    for finger in range(fingers):
        neighbours = [n for n in (finger - 1, finger + 1) if 0 <= n < fingers]
        if not neighbours:
            gaps.append(jnp.zeros_like(angles[:, 0]))
            continue
        differences = jnp.abs(angles[:, np.array(neighbours)] - angles[:, finger, None])
        gaps.append(jnp.min(differences, -1))
    return jnp.stack(gaps, -1)
