"""Natural posture of captured hands, with the policies' measure (`common.task.posture`)."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common import rotations
from congrasp.common.hands import kinematics
from congrasp.common.hands.spec import Hand
from congrasp.common.task.posture import unnatural
from congrasp.services.assets.captures.contact import CONTACT_DISTANCE_M
from congrasp.services.assets.captures.surface import Surface

_SAMPLES = 9
"""Points along a capsule at which its skin is compared with the object."""


def posture_deviations(
    hand: Hand,
    q: np.ndarray,
    position: np.ndarray,
    quaternion: np.ndarray,
    surface: Surface,
) -> np.ndarray:
    """Returns deviations (M,) of captured grasps from natural postures, rad.

    A link touches the object if its skin is within `CONTACT_DISTANCE_M` of the surface, or below.

    Args:
      hand: the hand.
      q: (M, F) finger angles, rad.
      position: (M, 3) of the wrist in the object frame, m.
      quaternion: (M, 4) of the wrist in the object frame.
      surface: surface of the object.
    """
    ends = np.asarray(_capsules(hand, q, position, quaternion))
    shares = np.linspace(0.0, 1.0, _SAMPLES)[:, None]
    points = (1 - shares) * ends[:, :, :1] + shares * ends[:, :, 1:]
    gaps = surface.distance(points).min(-1) - hand.capsule_radii
    touching = np.zeros((len(q), len(hand.links)), bool)
    for capsule, link in enumerate(hand.capsule_links):
        touching[:, link] |= gaps[:, capsule] <= CONTACT_DISTANCE_M
    return np.asarray(unnatural(hand, jnp.asarray(q), jnp.asarray(touching)))


@functools.partial(jax.jit, static_argnums=0)
def _capsules(hand: Hand, q: jax.Array, position: jax.Array, quaternion: jax.Array) -> jax.Array:
    """End points (M, C, 2, 3) of the hand's capsules in the object frame, m."""
    local = kinematics.capsules(hand, kinematics.link_transforms(hand, q))
    flat = local.reshape(len(local), -1, 3)
    return rotations.transform(position, quaternion, flat).reshape(local.shape)
