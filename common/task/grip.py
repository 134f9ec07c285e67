"""Resistance of a grasp's contacts to the object's weight.

An object turns out of a grasp when its weight, times the horizontal distance of its centre of mass
from the grasp, exceeds the torque that friction can resist. Contacts that lie apart resist more
than contacts at one spot: friction mu f at a distance d from the others' centre resists mu f d.
"""

from typing import NamedTuple

from congrasp.common.runtime.lazy_jax import jnp
from congrasp.common.task.types import Array, SceneState

_SAFETY = 2.0
"""Ratio of resistance to load above which more earns nothing."""
_MIN_LEVER_M = 0.01
"""Shortest lever arm of the weight: a grip must resist its torque in any case."""


class ObjectLoad(NamedTuple):
    """True parameters of B objects, which only a simulator knows."""

    weight: Array
    """(B,) N."""
    friction: Array
    """(B,) sliding friction between hand and object."""


def resistance(state: SceneState, load: ObjectLoad, counts: Array) -> Array:
    """Share (B,) of the wanted resistance that the contacts offer, in [0, 1].

    The mean of two shares: mu sum(f) over twice the weight, and mu sum(f d) over twice the weight
    times its lever arm, where d is the distance of a contact from the force-weighted centre of all
    contacts. Each is at most 1.

    Args:
      state: scene of the control step.
      load: weight and friction of the objects.
      counts: (B, L) bool, links whose contacts count.
    """
    present = state.contact_found & counts[..., None]
    force = jnp.where(present, jnp.linalg.norm(state.contact_force, axis=-1), 0.0)
    batch = force.shape[0]
    force = force.reshape(batch, -1)
    place = jnp.where(present[..., None], state.contact_position, 0.0).reshape(batch, -1, 3)

    total = jnp.sum(force, -1)
    share = force / jnp.maximum(total, 1e-6)[:, None]
    center = jnp.sum(share[..., None] * place, -2)
    apart = jnp.linalg.norm(place - center[:, None], axis=-1)
    torque = load.friction * jnp.sum(force * apart, -1)
    lever = jnp.linalg.norm((state.object_position - center)[:, :2], axis=-1)

    wanted_force = _SAFETY * load.weight
    wanted_torque = wanted_force * jnp.maximum(lever, _MIN_LEVER_M)
    carries = jnp.minimum(load.friction * total / wanted_force, 1.0)
    resists = jnp.minimum(torque / wanted_torque, 1.0)
    return jnp.where(total > 0.0, (carries + resists) / 2.0, 0.0)
