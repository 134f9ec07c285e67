"""Decoupled proximal policy optimisation (Hilton et al. 2021, arXiv 2110.00641).

Three policies are involved: the behaviour policy acted, possibly some versions ago; the proximal policy is the
learner's at the start of the update; the current one is being optimised. The trust region is around the proximal
policy, so that old data do not consume it before learning begins; an importance weight corrects for the behaviour
policy. With the proximal policy equal to the behaviour policy the weight is exactly one and the objective is that of
plain PPO.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from congrasp.common.policy import network
from congrasp.common.policy.network import Layout, Params
from congrasp.common.task.types import Array


class Sample(NamedTuple):
    """Transitions of a minibatch, with quantities that stay fixed during an update; leading axis M."""

    observation: Array
    """(M, D) normalised."""
    action: Array
    """(M, A)."""
    log_proximal: Array
    """(M,) log probability of the action under the proximal policy, computed as `objective` does."""
    mean_proximal: Array
    """(M, A) mean of the proximal policy, computed as `objective` does."""
    weight: Array
    """(M,) truncated importance weight of the proximal relative to the behaviour policy."""
    advantage: Array
    """(M,) normalised."""
    target: Array
    """(M,) normalised return."""
    stale: Array
    """(M,) bool, True where the behaviour policy is of an earlier version than the proximal one."""
    privileged: Array | None = None
    """(M, P) normalised privileged inputs of the critic, if it has any."""


class Coefficients(NamedTuple):
    """Scalars of the objective."""

    clip: Array
    entropy: Array
    value: Array


class Terms(NamedTuple):
    """Scalars of one minibatch, for finiteness checks and metrics."""

    policy_loss: Array
    value_loss: Array
    entropy: Array
    kl: Array
    """Mean KL(proximal || current), nats."""
    clip_fraction: Array
    """Share of the samples whose ratio lies outside the clip range."""
    clip_fraction_rising: Array
    """Share of the samples with a positive advantage and a ratio above the range: the clip holds their probability."""
    clip_fraction_falling: Array
    """Share of the samples with a negative advantage and a ratio below the range."""
    clip_fraction_stale: Array
    """Share outside the range among the stale samples; 0 without any."""


def importance_weight(log_proximal: Array, log_behaviour: Array, maximum: Array | float) -> Array:
    """Returns min(pi_proximal / pi_behaviour, maximum), computed in log space to avoid overflow; no gradient."""
    return jnp.exp(jax.lax.stop_gradient(jnp.minimum(log_proximal - log_behaviour, jnp.log(maximum))))


def surrogate(log_ratio: Array, advantage: Array, weight: Array, clip: Array | float) -> Array:
    """Loss -w min(r A, clip(r, 1 - eps, 1 + eps) A) of each sample, with r = pi / pi_proximal = exp(`log_ratio`)."""
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - clip, 1.0 + clip)
    return -weight * jnp.minimum(ratio * advantage, clipped * advantage)


def objective(
    params: Params, layout: Layout, log_std_proximal: Array, sample: Sample, coefficients: Coefficients
) -> tuple[Array, Terms]:
    """Scalar to minimise and its terms: surrogate + c_v (V - target)^2 - c_e entropy, means over the minibatch."""
    mean, log_std = network.policy(params, layout, sample.observation, exact=False)
    log_ratio = network.log_probability(mean, log_std, sample.action) - sample.log_proximal
    ratio, clip = jnp.exp(log_ratio), coefficients.clip
    outside = jnp.abs(ratio - 1.0) > clip
    error = network.value(params, layout, sample.observation, sample.privileged) - sample.target
    terms = Terms(
        policy_loss=jnp.mean(surrogate(log_ratio, sample.advantage, sample.weight, coefficients.clip)),
        value_loss=jnp.mean(error * error),
        entropy=network.entropy(log_std),
        kl=jnp.mean(network.kl_divergence(sample.mean_proximal, log_std_proximal, mean, log_std)),
        clip_fraction=jnp.mean(outside),
        clip_fraction_rising=jnp.mean((sample.advantage > 0.0) & (ratio > 1.0 + clip)),
        clip_fraction_falling=jnp.mean((sample.advantage < 0.0) & (ratio < 1.0 - clip)),
        clip_fraction_stale=jnp.sum(outside & sample.stale) / jnp.maximum(jnp.sum(sample.stale), 1),
    )
    total = terms.policy_loss + coefficients.value * terms.value_loss - coefficients.entropy * terms.entropy
    return total, terms
