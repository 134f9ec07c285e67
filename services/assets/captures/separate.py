"""Separates overlapping fingers of a reference pose.

Captured hands have other bones and flesh than the hand that follows them. Their angles therefore make its fingers
overlap, in poses that no hand can hold.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from congrasp.common.hands.kinematics import link_transforms
from congrasp.common.hands.motors import transmission
from congrasp.common.hands.spec import Hand
from congrasp.common.task.plausibility import overlaps
from congrasp.common.task.types import Array

DEEPEST = 0.001
"""Tolerated overlap of two links, as skin and flesh give way, m."""
_ITERATIONS = 100


def separated(hand: Hand, q: np.ndarray) -> np.ndarray:
    """Returns the nearest finger angles whose links overlap by at most `DEEPEST`.

    They minimise |q - q_0|^2 subject to the limit on all pairs of `common.task.plausibility.overlaps`, by sequential
    quadratic programming. The variables are motors, so that couplings and tendons are preserved; all joints stay within
    their limits.

    Args:
      hand: any hand.
      q: (M, F) rad, within the limits; poses within the limit are returned unchanged.
    """
    deep = np.asarray(deepest(hand, q)) > DEEPEST
    return np.stack([_apart(hand, row) if moved else row for row, moved in zip(q, deep, strict=True)])


@functools.partial(jax.jit, static_argnums=0)
def deepest(hand: Hand, q: Array) -> Array:
    """Greatest overlap (M,) of two links at finger angles (M, F), m; 0 if there is none."""
    return jnp.maximum(overlaps(hand, link_transforms(hand, q)).max(-1), 0.0)


def _apart(hand: Hand, q: np.ndarray) -> np.ndarray:
    """Separates one pose (F,)."""
    own, motors = transmission(hand), range(len(hand.motors))
    # Range of each motor until the first of its joints is at a limit.
    ends = np.sort([(limit - q) / own.ratio for limit in (hand.lower, hand.upper)], axis=0)
    bounds = [(min(ends[0][own.motor == m].max(), 0.0), max(ends[1][own.motor == m].min(), 0.0)) for m in motors]
    weight = np.bincount(own.motor, own.ratio**2)
    found = minimize(
        lambda way: (0.5 * weight @ way**2, weight * way),
        np.zeros(len(weight)),
        jac=True,
        method="SLSQP",
        bounds=bounds,
        constraints={
            "type": "ineq",
            "fun": lambda way: np.asarray(_room(hand, q, way), float),
            # For two intersecting axes the direction of separation is undefined.
            "jac": lambda way: np.nan_to_num(np.asarray(_room_change(hand, q, way), float)),
        },
        options={"maxiter": _ITERATIONS},
    )
    apart = np.clip(q + own.ratio * found.x[own.motor], hand.lower, hand.upper).astype(q.dtype)
    before, after = deepest(hand, np.stack([q, apart]))
    return apart if after < before else q


def _room_of(hand: Hand, q: Array, way: Array) -> Array:
    """Remaining clearance (Q,) in mm of pairs of links after a motion (M,) of the motors from angles (F,)."""
    own = transmission(hand)
    return 1e3 * (DEEPEST - overlaps(hand, link_transforms(hand, q + own.ratio * way[own.motor])))


_room = jax.jit(_room_of, static_argnums=0)
_room_change = jax.jit(jax.jacfwd(_room_of, 2), static_argnums=0)
