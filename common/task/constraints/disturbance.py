"""Disturbs references in training like captured human grasps.

In a captured pose, joints are off by some tenths of a radian and the wrist by a centimetre, the
fingers are more or less closed than those of the hand that follows it, and the waypoints of a
captured path jitter. The size of the disturbance is drawn for each episode, between none and the
maxima below.
"""

import numpy as np

from congrasp.common import chance, rotations
from congrasp.common.hands.motors import follow_couplings
from congrasp.common.hands.spec import Hand
from congrasp.common.runtime.lazy_jax import jnp
from congrasp.common.task.types import Array

JOINTS = 0.3
"""rad, largest standard deviation of an independent error of every finger joint."""
CLOSURE = (0.6, 1.1)
"""Least and greatest closure at full scale, as a share of the range from the open hand to the
reference's fingers.
"""
WRIST = (0.01, 0.2)
"""m and rad, largest standard deviation of the wrist's errors along and about each axis."""
JITTER = 0.005
"""m, largest standard deviation of an independent error of every coordinate of every waypoint but
the last.
"""


def fingers_numbers(hand: Hand) -> int:
    """Number of random numbers that `disturbed_fingers` uses for a pose: the closure, and each
    joint.
    """
    return 1 + len(hand.joints)


def wrist_numbers(waypoints: int) -> int:
    """Number of random numbers that `disturbed_wrist` uses for K waypoints: translation, rotation,
    3 K of jitter.
    """
    return 6 + 3 * waypoints


def disturbed_fingers(hand: Hand, q: Array, amount: Array, uniform: Array) -> Array:
    """Disturbs reference fingers (B, F), within their limits.

    Args:
      hand: the hand.
      q: (B, F) finger angles, rad.
      amount: (B,) between 0 and 1, scale of the errors.
      uniform: (B, 1 + F) random numbers in [0, 1).
    """
    least, greatest = CLOSURE
    closure = least + (greatest - least) * uniform[:, :1]
    q_open = jnp.array(hand.q_open)
    amount = amount[:, None]
    q = q_open + (1 + amount * (closure - 1)) * (q - q_open)
    q = q + amount * JOINTS * chance.normal(uniform[:, 1:])
    return follow_couplings(hand, jnp.clip(q, hand.lower, hand.upper))


def disturbed_wrist(
    position: Array, quaternion: Array, amount: Array, uniform: Array
) -> tuple[Array, Array]:
    """Disturbs wrist poses (B, K, 3), (B, K, 4) by one rigid motion for all K, with jitter of the
    waypoints.

    All rotate about the last one, so that a path keeps its shape.

    Args:
      position: positions in the object frame, m.
      quaternion: rotations from the wrist frame to the object frame.
      amount: (B,) between 0 and 1, scale of the errors.
      uniform: (B, 6 + 3 K) random numbers in [0, 1).
    """
    translation_error, rotation_error = WRIST
    noise = amount[:, None] * chance.normal(uniform)
    shift = translation_error * noise[:, :3]
    turn = rotations.from_rotation_vector(rotation_error * noise[:, 3:6])
    turn = jnp.broadcast_to(turn[:, None], quaternion.shape)
    waypoints = position.shape[1]
    jitters = (np.arange(waypoints) < waypoints - 1)[:, None]
    jitter = JITTER * jitters * noise[:, 6:].reshape(position.shape)
    last = position[:, -1:]
    moved = last + shift[:, None] + rotations.rotate(turn, position - last) + jitter
    return moved, rotations.multiply(turn, quaternion)
