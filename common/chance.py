"""Random draws from uniform numbers.

A reset needs hundreds of numbers for dozens of purposes. Each call of a generator would compile
into a program of its own, so all numbers come from one call, and the functions below turn them into
draws.
"""

import zlib
from collections.abc import Mapping

import numpy as np

from congrasp.common.runtime.lazy_jax import jax, jnp
from congrasp.common.task.types import Array

_LEAST = 2.0**-24
"""Half the step between two uniform numbers in single precision."""


def uniforms(key: Array, numbers: Mapping[str, int], batch: int) -> dict[str, Array]:
    """Random numbers (B, U) in [0, 1) by name, where U is given for each.

    Those of a name do not depend on the other names, nor on how many numbers these have.

    Args:
      key: random key.
      numbers: U by name.
      batch: B.
    """
    widest = max(numbers.values())
    seeds = np.array([zlib.crc32(name.encode()) for name in numbers], np.uint32)

    def drawn(seed: Array) -> Array:
        return jax.random.uniform(jax.random.fold_in(key, seed), (widest, batch))

    blocks = jax.vmap(drawn)(seeds)
    return {name: blocks[i, :count].T for i, (name, count) in enumerate(numbers.items())}


def normal(uniform: Array) -> Array:
    """Standard normal numbers, from uniform numbers in [0, 1) of the same shape."""
    return jax.scipy.special.ndtri(jnp.maximum(uniform, _LEAST))


def index(uniform: Array, count: Array | int) -> Array:
    """Uniform integers in [0, count), from uniform numbers in [0, 1) of the same shape."""
    return jnp.minimum((uniform * count).astype(jnp.int32), jnp.asarray(count, jnp.int32) - 1)


def weighted(uniform: Array, weights: Array) -> Array:
    """Samples indices (B,) int with probabilities proportional to weights (N,), from uniform
    numbers (B,) in [0, 1).
    """
    total = jnp.cumsum(jnp.asarray(weights))
    chosen = jnp.searchsorted(total, total[-1] * uniform, side="right")
    # Rounding may reach the upper bound
    return jnp.minimum(chosen, len(total) - 1).astype(jnp.int32)


def among(uniform: Array, allowed: Array) -> Array:
    """Samples a uniformly random index (B,) int of a true flag in each row of flags (B, N), from
    uniform numbers (B,) in [0, 1); 0 for a row without a true flag.
    """
    rank = jnp.cumsum(allowed, -1)
    return jnp.argmax(rank > index(uniform, rank[:, -1])[:, None], -1)
