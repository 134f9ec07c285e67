"""Averages of policies: a policy whose weights lie between those of several others.

After a policy has been trained further, the mean of its weights before and after often keeps what
both can do, because the training stays where the loss is nearly linear along the way (Wortsman et
al. 2022, "Robust fine-tuning of zero-shot models", arXiv 2109.01903, and "Model soups", arXiv
2203.05482). Policies of separate trainings from random weights have no useful mean.
"""

import dataclasses
import math
from collections.abc import Sequence

import jax
import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.policy.bundle import PolicyBundle, without_critic

_TOLERANCE = 1e-6
"""Largest deviation from one of the sum of the weights."""


def average(policies: Sequence[PolicyBundle], weights: Sequence[float]) -> PolicyBundle:
    """Returns a policy whose parameters and statistics are weighted means.

    Args:
      policies: policies of one hand, task and network. Task, version, run and number of steps of
        the result are those of the first.
      weights: weight of each policy; their sum is 1.

    Returns:
      The mean, with a critic if all policies have one.

    Raises:
      CongraspError: the policies do not match, or the weights are not one for each with sum 1.
    """
    if len(weights) != len(policies):
        raise CongraspError(
            f"There are {len(policies)} policies and {len(weights)} weights.",
            "Pass one weight for each policy.",
        )
    if not math.isclose(sum(weights), 1.0, abs_tol=_TOLERANCE):
        raise CongraspError(
            f"The sum of the weights is {sum(weights):g}.", "Pass weights whose sum is 1."
        )
    first, *others = policies
    for other in others:
        first.spec.require(other.spec, "to be averaged")
    same_critics = all(
        policy.has_critic
        and policy.spec == first.spec
        and _has_inputs(policy) == _has_inputs(first)
        for policy in policies
    )
    if not same_critics:
        policies = [without_critic(policy) for policy in policies]

    def mean(*arrays: np.ndarray) -> np.ndarray:
        """Weighted mean in float64, in the type of the first array."""
        total = np.zeros(np.shape(arrays[0]))
        for weight, array in zip(weights, arrays, strict=True):
            total = total + weight * np.asarray(array, np.float64)
        return total.astype(np.asarray(arrays[0]).dtype)

    means = {}
    for name in ("params", "observation", "value", "privileged"):
        means[name] = jax.tree.map(mean, *(getattr(policy, name) for policy in policies))
    return dataclasses.replace(policies[0], **means)


def _has_inputs(policy: PolicyBundle) -> bool:
    """True if the policy has statistics of its critic's privileged inputs."""
    return policy.privileged is not None
