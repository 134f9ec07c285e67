"""Poses of a hand's links by MuJoCo, for one hand pose at a time, so that recorders and pictures need no JAX backend.

`common.hands.kinematics.link_poses` computes the same for batches in JAX.
"""

import functools

import mujoco
import numpy as np

from congrasp.common.hands.mjcf import add_hand
from congrasp.common.hands.spec import Hand


@functools.cache
def _model(hand: Hand) -> mujoco.MjModel:
    """Returns a model of the hand only, with its wrist at the origin."""
    spec = mujoco.MjSpec()
    add_hand(spec, hand)
    return spec.compile()


def posed(hand: Hand, q: np.ndarray) -> mujoco.MjData:
    """Bodies and joints of the hand at finger angles (F,) rad, with its wrist at the origin."""
    data = mujoco.MjData(_model(hand))
    for joint, angle in zip(hand.joints, q, strict=True):
        data.joint(joint.name).qpos[0] = angle
    mujoco.mj_kinematics(data.model, data)
    return data


def mujoco_link_poses(hand: Hand, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins (L, 3) and orientations (L, 4) of the links' frames in the wrist frame.

    Args:
      hand: the hand.
      q: (F,) finger angles, rad.
    """
    data = posed(hand, q)
    bodies = [data.body(link.name).id for link in hand.links]
    return data.xpos[bodies], data.xquat[bodies]
