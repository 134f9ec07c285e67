"""The learner's algorithms, by the names that a run's configuration chooses them by."""

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
"""Factories by name: of the policy's spec and the run's configuration."""


def make_algorithm(spec: PolicySpec, config: RunConfig) -> Algorithm:
    """The algorithm that the run's configuration names.

    Raises:
      CongraspError: there is none of that name.
    """
    if config.algorithm not in ALGORITHMS:
        raise CongraspError(f"There is no algorithm '{config.algorithm}'.", f"Choose among {', '.join(ALGORITHMS)}.")
    return ALGORITHMS[config.algorithm](spec, config)
