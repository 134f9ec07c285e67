"""Registry of the learner's algorithms, by their names in a run's configuration."""

from collections.abc import Callable

from congrasp.common.config import RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.policy.bundle import PolicySpec
from congrasp.learner.algorithms.distill import Distillation
from congrasp.learner.algorithms.ppo import PPO
from congrasp.learner.algorithms.protocol import Algorithm

ALGORITHMS: dict[str, Callable[[PolicySpec, RunConfig], Algorithm]] = {
    "ppo": lambda spec, config: PPO(spec, config.ppo, config.updates),
    "distill": Distillation,
}
"""Factories by name; arguments are the policy's spec and the run's configuration."""


def make_algorithm(spec: PolicySpec, config: RunConfig) -> Algorithm:
    """Returns the algorithm named by the run's configuration.

    Raises:
      CongraspError: there is no such algorithm.
    """
    if config.algorithm not in ALGORITHMS:
        raise CongraspError(
            f"There is no algorithm '{config.algorithm}'.", f"Choose from: {', '.join(ALGORITHMS)}."
        )
    return ALGORITHMS[config.algorithm](spec, config)
