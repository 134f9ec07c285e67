"""Episodes of an exam under a policy whose actions are modified: an offset in each phase, and
noise.
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.actors.initial import InitialConditions
from congrasp.actors.physics import make_physics
from congrasp.actors.rollout import finished_episodes
from congrasp.actors.worker import RolloutWorker
from congrasp.common.policy.bundle import InferenceParameters, mean_action
from congrasp.common.policy.network import Layout
from congrasp.common.runtime.resources import cores
from congrasp.common.task.types import Array
from congrasp.services.evaluate.experiment import Experiment

PHASES = ("approach", "closing", "hold")
"""The first and second half of the steps with the table, and those without."""


class Modified(NamedTuple):
    """Parameters of `modified_action` for B environments."""

    policy: InferenceParameters
    offset: Array
    """(B, A), added to the policy's mean action."""
    noise: Array
    """(B,) standard deviation of normal noise on every action."""


def modified_action(
    layout: Layout, parameters: Modified, observation: Array, key: Array
) -> tuple[Array, Array]:
    """Action of a policy with offset and noise; an `actors.rollout.ActFunction` whose log
    probability is 0.
    """
    mean = mean_action(layout, parameters.policy, observation)
    noise = parameters.noise[:, None] * jax.random.normal(key, mean.shape)
    return mean + parameters.offset + noise, jnp.zeros(len(mean))


class Trials(NamedTuple):
    """K episodes to simulate."""

    condition: np.ndarray
    """(K,) int, rows of the initial conditions."""
    offset: np.ndarray
    """(K, phases, A)."""
    noise: np.ndarray
    """(K,)."""

    def rows(self, chosen: np.ndarray) -> "Trials":
        """Selects trials by index."""
        return Trials(self.condition[chosen], self.offset[chosen], self.noise[chosen])


class Outcomes(NamedTuple):
    """Results of K episodes."""

    success: np.ndarray
    """(K,) bool: the object had not fallen in the paper's window."""
    held: np.ndarray
    """(K,) bool: it was held for two seconds."""
    total: np.ndarray
    """(K,) return."""


class Simulator:
    """Simulates trials in batches of one size, with one compiled program."""

    def __init__(self, experiment: Experiment, batch: int):
        """Creates the engine with the objects of an experiment and `batch` environments."""
        self.batch = batch
        self.action_size = experiment.policy.spec.action_size
        self.fullest = 0.0
        """Highest occupancy of the engine's buffers; above 1, contacts were dropped."""
        self._policy = experiment.policy.inference_parameters
        self._task = experiment.task
        self._hold = experiment.steps
        physics = make_physics(
            experiment.physics,
            experiment.hand,
            experiment.task,
            experiment.scaled,
            threads=cores(),
        )
        self._worker = RolloutWorker(
            experiment.hand,
            experiment.task,
            physics,
            None,
            functools.partial(modified_action, experiment.policy.spec.layout),
            batch=batch,
            seed=experiment.seed,
            half_precision=False,
            traced="none",
        )

    def __enter__(self) -> "Simulator":
        return self

    def __exit__(self, *error: object) -> None:
        self._worker.physics.close()

    def unmodified(self, count: int) -> Trials:
        """Returns trials of the first `count` conditions under the policy alone."""
        offset = np.zeros((count, len(PHASES), self.action_size))
        return Trials(np.arange(count), offset, np.zeros(count))

    def run(
        self,
        conditions: InitialConditions,
        trials: Trials,
        progress: Callable[[int], None] = lambda done: None,
    ) -> Outcomes:
        """Simulates trials of these conditions, each to the end of the hold.

        Args:
          conditions: initial conditions, one a row.
          trials: the episodes; the last batch is padded with copies of the last one.
          progress: called with the number of finished episodes.
        """
        count = len(trials.condition)
        batches = []
        for start in range(0, count, self.batch):
            rows = np.minimum(np.arange(start, start + self.batch), count - 1)
            batches.append(self._run_batch(conditions, trials.rows(rows)))
            progress(min(start + self.batch, count))
        columns = [np.concatenate(column)[:count] for column in zip(*batches, strict=True)]
        return Outcomes(*columns)

    def _run_batch(self, conditions: InitialConditions, trials: Trials) -> Outcomes:
        """Simulates as many trials as there are environments."""
        begun = rows_of(conditions, trials.condition)
        self._worker.begin(begun._replace(hold=jnp.full_like(begun.hold, self._hold)))
        closing = self._task.approach_steps // 2
        chunk = math.gcd(closing, self._task.approach_steps, self._hold)
        noise = jnp.asarray(trials.noise, jnp.float32)
        for step in range(0, self._task.approach_steps + self._hold, chunk):
            phase = int(step >= closing) + int(step >= self._task.approach_steps)
            offset = jnp.asarray(trials.offset[:, phase], jnp.float32)
            parameters = Modified(self._policy, offset, noise)
            rollout = self._worker.collect(parameters, chunk)
            occupancy = np.asarray(rollout.occupancy)[:, :2]
            self.fullest = max(self.fullest, float(occupancy.max()))
        finished = finished_episodes(rollout, self._task)
        return Outcomes(
            success=finished["episode/success"] > 0,
            held=finished["episode/held"] > 0,
            total=finished["episode/return"],
        )


def rows_of(conditions: InitialConditions, rows: np.ndarray) -> InitialConditions:
    """Selects initial conditions by index."""
    selected: InitialConditions = jax.tree.map(lambda array: np.asarray(array)[rows], conditions)
    return selected


def joined(parts: list[InitialConditions]) -> InitialConditions:
    """Joins initial conditions of several batches."""
    conditions: InitialConditions = jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts)
    return conditions
