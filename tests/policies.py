"""Policies of random weights."""

from collections.abc import Sequence

import jax
import numpy as np

from congrasp.common.config import NetworkConfig
from congrasp.common.policy.bundle import PolicyBundle, policy_spec
from congrasp.common.task.config import TaskConfig
from congrasp.learner.algorithms.protocol import random_policy


def random_bundle(
    task: TaskConfig,
    network: NetworkConfig,
    factor: float,
    seed: int = 1,
    std: float | Sequence[float] | None = None,
) -> PolicyBundle:
    """A policy whose actions depend on its observation, by a factor on the output's weights; and
    their deviations.
    """
    spec = policy_spec(task, network)
    policy = random_policy(seed, spec)
    actor = jax.tree.map(np.array, policy.params["actor"])
    actor["network"]["output"]["kernel"] *= factor
    if std is not None:
        actor["log_std"] = np.log(np.broadcast_to(std, spec.action_size)).astype(np.float32)
    return PolicyBundle(
        spec, task, {**policy.params, "actor": actor}, policy.observation, policy.value, 1, "t", 0
    )
