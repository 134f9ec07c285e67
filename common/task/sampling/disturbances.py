"""Disturbs references like captured human grasps, for training.

In a captured pose, joints are off by some tenths of a radian and the wrist by a centimetre, the fingers are more or
less closed than those of the hand that follows it, and the waypoints of a captured path jitter. The size of the
disturbance is drawn for each episode, between none and the maxima below.
"""

import jax
import jax.numpy as jnp

from congrasp.common import rotations
from congrasp.common.hands.motors import coupled
from congrasp.common.hands.spec import Hand
from congrasp.common.task.types import Array

JOINTS = 0.3
"""rad, largest standard deviation of an independent error of every finger joint."""
CLOSURE = (0.6, 1.1)
"""Least and greatest closure at full scale, as a share of the range from the open hand to the reference's fingers."""
WRIST = 0.01, 0.2
"""m and rad, largest standard deviation of the wrist's errors along and about each axis."""
JITTER = 0.005
"""m, largest standard deviation of an independent error of every coordinate of every waypoint but the last."""


def disturbed_fingers(hand: Hand, q: Array, amount: Array, key: Array) -> Array:
    """Disturbs reference fingers (B, F), within their limits.

    Args:
      hand: the hand.
      q: (B, F) finger angles, rad.
      amount: (B,) between 0 and 1, scale of the errors.
      key: random key.
    """
    closure_key, joint_key = jax.random.split(key)
    share = jax.random.uniform(closure_key, (len(q), 1), minval=CLOSURE[0], maxval=CLOSURE[1])
    q_open, amount = jnp.array(hand.q_open), amount[:, None]
    q = q_open + (1 + amount * (share - 1)) * (q - q_open)
    q = q + amount * JOINTS * jax.random.normal(joint_key, q.shape)
    return coupled(hand, jnp.clip(q, hand.lower, hand.upper))


def disturbed_wrist(position: Array, quaternion: Array, amount: Array, key: Array) -> tuple[Array, Array]:
    """Disturbs wrist poses (B, K, 3), (B, K, 4) by one rigid motion for all K, with jitter of the waypoints.

    All rotate about the last one, so that a path keeps its shape.

    Args:
      position: positions in the object frame, m.
      quaternion: rotations from the wrist frame to the object frame.
      amount: (B,) between 0 and 1, scale of the errors.
      key: random key.
    """
    move_key, turn_key, jitter_key = jax.random.split(key, 3)
    amount = amount[:, None]
    move = amount * WRIST[0] * jax.random.normal(move_key, (len(position), 3))
    turn = rotations.from_rotation_vector(amount * WRIST[1] * jax.random.normal(turn_key, (len(position), 3)))
    jitter = amount[..., None] * JITTER * jax.random.normal(jitter_key, position.shape)
    jitter = jitter.at[:, -1].set(0.0)
    turn, last = jnp.broadcast_to(turn[:, None], quaternion.shape), position[:, -1:]
    return last + move[:, None] + rotations.rotate(turn, position - last) + jitter, rotations.multiply(turn, quaternion)
