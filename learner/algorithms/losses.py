"""Decoupled proximal policy optimisation (Hilton et al. 2021, arXiv 2110.00641).

Three policies are involved: the behaviour policy acted, possibly some versions ago; the proximal
policy is the learner's at the start of the update; the current one is being optimised. The trust
region is around the proximal policy, so that old data do not consume it before learning begins; an
importance weight corrects for the behaviour policy. With the proximal policy equal to the behaviour
policy the weight is exactly one and the objective is that of plain PPO.

A batch is evaluated once in an update by the proximal policy and the critic; minibatches of the
samples then minimise the objective.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from congrasp.common.policy import network, normalizer
from congrasp.common.policy.network import Layout, Params
from congrasp.common.policy.normalizer import Affine
from congrasp.common.task.types import Array
from congrasp.learner.algorithms import gae
from congrasp.learner.distributed.collectives import Collectives

MAX_TOGETHER = 1 << 15
"""Transitions that the networks evaluate together, if a step of all environments has no more."""


class Sample(NamedTuple):
    """Transitions of a minibatch, with quantities that stay fixed during an update; leading axis
    M.
    """

    observation: Array
    """(M, D) normalised."""
    action: Array
    """(M, A)."""
    log_proximal: Array
    """(M,) log probability of the action under the proximal policy, computed as `objective`
    does.
    """
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
    """Share of the samples with a positive advantage and a ratio above the range: the clip holds
    their probability.
    """
    clip_fraction_falling: Array
    """Share of the samples with a negative advantage and a ratio below the range."""
    clip_fraction_stale: Array
    """Share outside the range among the stale samples; 0 without any."""


def importance_weight(log_proximal: Array, log_behaviour: Array, maximum: Array | float) -> Array:
    """Returns min(pi_proximal / pi_behaviour, maximum), computed in log space to avoid overflow; no
    gradient.
    """
    return jnp.exp(
        jax.lax.stop_gradient(jnp.minimum(log_proximal - log_behaviour, jnp.log(maximum)))
    )


def surrogate(log_ratio: Array, advantage: Array, weight: Array, clip: Array | float) -> Array:
    """Loss -w min(r A, clip(r, 1 - eps, 1 + eps) A) of each sample, with r = pi / pi_proximal =
    exp(`log_ratio`).
    """
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - clip, 1.0 + clip)
    return -weight * jnp.minimum(ratio * advantage, clipped * advantage)


def objective(
    params: Params,
    layout: Layout,
    log_std_proximal: Array,
    sample: Sample,
    coefficients: Coefficients,
) -> tuple[Array, Terms]:
    """Scalar to minimise and its terms: surrogate + c_v (V - target)^2 - c_e entropy, means over
    the minibatch.
    """
    mean, log_std = network.policy(params, layout, sample.observation, exact=False)
    log_ratio = network.log_probability(mean, log_std, sample.action) - sample.log_proximal
    ratio = jnp.exp(log_ratio)
    clip = coefficients.clip
    outside = jnp.abs(ratio - 1.0) > clip
    error = network.value(params, layout, sample.observation, sample.privileged) - sample.target
    terms = Terms(
        policy_loss=jnp.mean(
            surrogate(log_ratio, sample.advantage, sample.weight, coefficients.clip)
        ),
        value_loss=jnp.mean(error * error),
        entropy=network.entropy(log_std),
        kl=jnp.mean(network.kl_divergence(sample.mean_proximal, log_std_proximal, mean, log_std)),
        clip_fraction=jnp.mean(outside),
        clip_fraction_rising=jnp.mean((sample.advantage > 0.0) & (ratio > 1.0 + clip)),
        clip_fraction_falling=jnp.mean((sample.advantage < 0.0) & (ratio < 1.0 - clip)),
        clip_fraction_stale=jnp.sum(outside & sample.stale) / jnp.maximum(jnp.sum(sample.stale), 1),
    )
    total = (
        terms.policy_loss
        + coefficients.value * terms.value_loss
        - coefficients.entropy * terms.entropy
    )
    return total, terms


class Inputs(NamedTuple):
    """Inputs of an update, in addition to the state."""

    batch: dict[str, Array]
    observations: Affine
    """Normalisation of observations, frozen."""
    privileged: Affine | None
    """Normalisation of the critic's privileged inputs, frozen; None if there are none."""
    returns: Affine
    """Normalisation of returns, frozen."""
    hyper: dict[str, Any]
    """Hyperparameters that are arguments of the compiled program; the others are static."""


class Evaluation(NamedTuple):
    """A batch evaluated by the proximal policy and the critic; leading axes (T, B)."""

    samples: Sample
    """Inputs of the networks, not normalised yet: gathering a minibatch's rows in half precision is
    cheaper.
    """
    log_weight: Array
    """Log of proximal over behaviour probability."""
    weight: Array
    """The same ratio, truncated; not a logarithm."""
    value: Array
    """In units of the scaled rewards, like the `returns`."""
    returns: Array
    advantage_std: Array
    """() mean over all ranks."""
    td_error: Array
    truncated_error: Array
    """TD error of a final step without bootstrap, r - V."""


def normalised_inputs(affine: Affine | None, privileged: Array | None) -> Array | None:
    """Normalised privileged inputs of the critic; None if there are none."""
    if affine is None or privileged is None:
        return None
    return normalizer.apply(affine, privileged)


def evaluate(
    params: Params, inputs: Inputs, collectives: Collectives, layout: Layout
) -> Evaluation:
    """Computes advantages, targets and importance weights, which stay fixed during the update."""
    batch = inputs.batch
    hyper = inputs.hyper
    action = batch["action"]
    behaviour = batch["log_probability"]
    log_std = params["actor"]["log_std"]

    def values(normalised: Array, privileged: Array | None) -> Array:
        normalised_privileged = normalised_inputs(inputs.privileged, privileged)
        value = network.value(params, layout, normalised, normalised_privileged)
        return value / inputs.returns.scale + inputs.returns.shift

    def evaluated(observation: Array, privileged: Array | None) -> tuple[Array, Array, Array]:
        normalised = normalizer.apply(inputs.observations, observation)
        exact, _ = network.policy(params, layout, normalised, exact=True)
        fast, _ = network.policy(params, layout, normalised, exact=False)
        return exact, fast, values(normalised, privileged)

    # Not all steps at once: the features of the points of 327,680 clouds are 40 GiB.
    steps = batch["observation"], batch.get("privileged")
    together = max(MAX_TOGETHER // action.shape[1], 1)
    exact, mean, value = jax.lax.map(lambda step: evaluated(*step), steps, batch_size=together)
    last_observation = normalizer.apply(inputs.observations, batch["last_observation"])
    last_value = values(last_observation, batch.get("last_privileged"))
    log_exact = network.log_probability(exact, log_std, action)
    weight = importance_weight(log_exact, behaviour, hyper["importance_max"])
    reward = batch["reward"] * hyper["reward_scale"]
    truncated = batch["truncated"] & hyper["bootstrap_truncated"]
    chunk = reward, value, last_value, batch["terminal"]
    advantage, returns = gae.advantages(*chunk, hyper["gamma"], hyper["gae_lambda"], truncated)
    advantage_std = jnp.sqrt(collectives.variance(advantage))
    samples = Sample(
        observation=batch["observation"],
        action=action,
        log_proximal=jnp.where(
            hyper["decoupled"], network.log_probability(mean, log_std, action), behaviour
        ),
        mean_proximal=mean,
        weight=jnp.where(hyper["decoupled"], weight, 1.0),
        advantage=(advantage - collectives.mean(jnp.mean(advantage))) / (advantage_std + 1e-8),
        target=(returns - inputs.returns.shift) * inputs.returns.scale,
        stale=jnp.broadcast_to(batch["lag"] > 0, reward.shape),
        privileged=batch.get("privileged"),
    )
    return Evaluation(
        samples=samples,
        log_weight=log_exact - behaviour,
        weight=weight,
        value=value,
        returns=returns,
        advantage_std=advantage_std,
        td_error=gae.td_errors(*chunk, hyper["gamma"], truncated),
        truncated_error=reward - value,
    )


def batch_metrics(
    inputs: Inputs, evaluation: Evaluation, collectives: Collectives
) -> dict[str, Array]:
    """Scalars about a batch and the age of its policy, over all ranks."""
    variance = collectives.variance(evaluation.returns)
    residual = collectives.variance(evaluation.returns - evaluation.value)
    truncated = evaluation.log_weight > jnp.log(inputs.hyper["importance_max"])
    fresh = ~evaluation.samples.stale
    gap, share = collectives.mean(
        (jnp.mean(jnp.abs(evaluation.log_weight) * fresh), jnp.mean(fresh))
    )
    return {
        # Actor and learner evaluate the same version in different programs: this is rounding, not
        # lag.
        "log_probability_gap": gap / jnp.maximum(share, 1e-9),
        "importance_max": collectives.max(jnp.max(evaluation.weight)),
        "explained_variance": 1.0 - residual / (variance + 1e-8),
        "advantage_std": evaluation.advantage_std,
        "td_error_std": jnp.sqrt(collectives.variance(evaluation.td_error)),
        **_truncation_metrics(inputs, evaluation, collectives),
        **collectives.mean(
            {
                "importance_mean": jnp.mean(evaluation.weight),
                "importance_truncated": jnp.mean(truncated.astype(jnp.float32)),
                "behaviour_kl": -jnp.mean(evaluation.log_weight),
                "reward_mean": jnp.mean(inputs.batch["reward"]),
                "return_mean": jnp.mean(evaluation.returns),
                "value_mean": jnp.mean(evaluation.value),
            }
        ),
    }


def _truncation_metrics(
    inputs: Inputs, evaluation: Evaluation, collectives: Collectives
) -> dict[str, Array]:
    """Share of truncated steps, and their mean TD error with and without bootstrap; 0 in a batch
    without any.
    """
    truncated = (inputs.batch["truncated"] & inputs.batch["terminal"]).astype(jnp.float32)
    cut = evaluation.truncated_error
    bootstrapped = cut + inputs.hyper["gamma"] * evaluation.value
    sums = {"td_error_truncated": bootstrapped, "td_error_truncated_as_terminal": cut}
    share, means = collectives.mean(
        (jnp.mean(truncated), {name: jnp.mean(truncated * error) for name, error in sums.items()})
    )
    return {
        "truncated": share,
        **{name: mean / jnp.maximum(share, 1e-9) for name, mean in means.items()},
    }
