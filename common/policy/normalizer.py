"""Running statistics of observations and returns.

A batch is summarised on its device as count, mean and M2 (the sum of squared deviations from the
mean) in float32; the host merges these few hundred numbers into the running statistics in float64
(Chan et al. 1979). Counts beyond 2^24 therefore stay exact and small updates of an old mean are not
lost, without 64-bit mode on the device. Merging is associative up to float64 rounding: the deltas
of several learner ranks, merged in rank order on every rank, are bitwise identical.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common.policy.network import CLOUD, POINT, TRUNK, Layout
from congrasp.common.task.types import Array

LIMIT = 10.0
"""Normalised observations are clipped to [-LIMIT, LIMIT]."""
_MIN_STD = 1e-3
"""Smallest standard deviation by which values are divided."""


class Statistics(NamedTuple):
    """Count, mean and squared deviations of the samples so far; float64 arrays on the host."""

    count: Array
    """() number of samples."""
    mean: Array
    """(...) mean of each entry."""
    m2: Array
    """(...) sum of squared deviations from the mean."""


class Affine(NamedTuple):
    """A frozen normalisation x -> (x - shift) * scale in float32."""

    shift: Array
    scale: Array


def empty(shape: tuple[int, ...] = ()) -> Statistics:
    """Returns statistics without samples."""
    return Statistics(np.zeros(()), np.zeros(shape), np.zeros(shape))


@functools.partial(jax.jit, static_argnames="event_axes")
def moments(samples: Array, event_axes: int = 0) -> Statistics:
    """Float32 statistics of a batch over all axes but the last `event_axes`.

    Two passes with the compensation of the mean's rounding (Chan, Golub and LeVeque 1983, equation
    1.7).
    """
    axes = tuple(range(samples.ndim - event_axes))
    count = np.prod([samples.shape[axis] for axis in axes], dtype=np.float64)
    estimate = jnp.mean(samples, axes, dtype=jnp.float32)
    deviation = samples.astype(jnp.float32) - estimate
    error = jnp.mean(deviation, axes)
    m2 = jnp.sum(deviation * deviation, axes) - jnp.float32(count) * error * error
    return Statistics(jnp.float32(count), estimate + error, jnp.maximum(m2, 0.0))


def merge(*parts: Statistics) -> Statistics:
    """Statistics of the union of disjoint samples, in float64 on the host."""
    total = empty(np.shape(parts[0].mean))
    for part in parts:
        count, mean, m2 = (np.asarray(entry, np.float64) for entry in part)
        if count == 0:
            continue
        combined = total.count + count
        shift = mean - total.mean
        total = Statistics(
            combined,
            total.mean + shift * (count / combined),
            total.m2 + m2 + shift * shift * (total.count * count / combined),
        )
    return total


def _std(statistics: Statistics) -> np.ndarray:
    """Standard deviations, bounded away from zero."""
    return np.maximum(np.sqrt(statistics.m2 / statistics.count), _MIN_STD)


def observation_affine(statistics: Statistics, layout: Layout) -> Affine:
    """Normalisation of observations (..., D); the identity while there are no samples.

    `state` and `heading` are centred and divided by their standard deviation. Optional blocks are
    divided by their root mean square without centring: zero, which means "inactive", stays exactly
    zero, and a nearly constant feature is not amplified to the clip. Mask bits are unchanged. All
    points of a cloud have the same scales, so that their order does not matter.
    """
    size = sum(width for _, width in layout)
    shift = np.zeros(size)
    scale = np.ones(size)
    start = 0
    for name, width in layout:
        block = slice(start, start + width)
        start += width
        if statistics.count == 0 or name == "mask":
            continue
        part = Statistics(statistics.count, statistics.mean[block], statistics.m2[block])
        if name in TRUNK:
            shift[block] = part.mean
            scale[block] = 1.0 / _std(part)
            continue
        mean_square = part.mean**2 + part.m2 / part.count
        if name == CLOUD:
            mean_square = np.tile(mean_square.reshape(-1, POINT).mean(0), width // POINT)
        scale[block] = 1.0 / np.maximum(np.sqrt(mean_square), _MIN_STD)
    return Affine(shift.astype(np.float32), scale.astype(np.float32))


def privileged_affine(statistics: Statistics) -> Affine:
    """Normalisation of the critic's privileged inputs (..., P) by mean and standard deviation, or
    the identity.
    """
    if statistics.count == 0:
        zeros = np.zeros_like(statistics.mean, np.float32)
        return Affine(shift=zeros, scale=np.ones_like(zeros))
    scale = 1.0 / _std(statistics)
    return Affine(statistics.mean.astype(np.float32), scale.astype(np.float32))


def apply(affine: Affine, observation: Array) -> Array:
    """Normalised observations (..., D) in float32, clipped to `LIMIT`. Zeros of inactive blocks
    stay zero.
    """
    normalized = (observation.astype(jnp.float32) - affine.shift) * affine.scale
    return jnp.clip(normalized, -LIMIT, LIMIT)


def value_affine(statistics: Statistics) -> Affine:
    """Normalisation of returns by mean and standard deviation; the identity while there are no
    samples.
    """
    if statistics.count == 0:
        return Affine(np.float32(0.0), np.float32(1.0))
    return Affine(np.float32(statistics.mean), np.float32(1.0 / _std(statistics)))
