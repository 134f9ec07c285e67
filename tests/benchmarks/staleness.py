"""What old rollouts cost: the decoupled objective and plain PPO at an artificial lag, beside on-policy training."""

import collections
import dataclasses
from typing import NamedTuple

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from congrasp.common.policy import bundle as bundles
from congrasp.learner.algorithms.ppo import PPO
from tests.benchmarks import toy

SETTINGS = dataclasses.replace(
    toy.SETTINGS, epochs=16, learning_rate=5e-3, learning_rate_range=(1e-5, 1e-2), kl_target=0.02
)
"""Many epochs over few samples, so that the trust region matters."""


class Setting(NamedTuple):
    """One way to train."""

    name: str
    lag: int
    decoupled: bool


def settings(lag: int) -> list[Setting]:
    """On-policy training, against which the others are measured, and both objectives at a lag."""
    return [
        Setting("on-policy", 0, True),
        Setting(f"decoupled, lag {lag}", lag, True),
        Setting(f"plain PPO, lag {lag}", lag, False),
    ]


def returns(setting: Setting, seed: int, count: int, worlds: int) -> np.ndarray:
    """Mean returns (count,) after each update of a training whose rollouts are all `setting.lag` versions old."""
    algorithm = PPO(toy.SPEC, dataclasses.replace(SETTINGS, decoupled=setting.decoupled))
    state = algorithm.init(seed)
    past = collections.deque([toy.bundle_of(state)], maxlen=setting.lag + 1)
    rng, key = np.random.default_rng(seed), jax.random.PRNGKey(seed)
    curve = []
    for _ in range(count):
        actor = past[0]

        def act(observation: np.ndarray, actor: bundles.PolicyBundle = actor) -> tuple[jax.Array, jax.Array]:
            nonlocal key
            key, sample = jax.random.split(key)
            return bundles.sample_action(toy.LAYOUT, actor.inference_parameters, observation, sample)

        state, _ = algorithm.update(state, toy.episode(act, worlds, rng))
        past.append(toy.bundle_of(state))
        curve.append(toy.mean_return(past[-1]))
    return np.array(curve)


def bench_staleness(lag: int, seeds: int, count: int, worlds: int) -> None:
    """Prints returns after a quarter, half and all of the updates, and their share of the on-policy gain."""
    updates = [count // 4, count // 2, count]
    table = Table(
        "", *(f"after {number} updates" for number in updates),
        title=f"Return: mean of {seeds} seeds ± standard deviation, share of the on-policy gain",
    )  # fmt: skip
    reference = None
    for setting in settings(lag):
        curves = np.array([returns(setting, seed, count, worlds) for seed in range(seeds)])
        found = curves[:, np.array(updates) - 1]
        mean = found.mean(0)
        reference = mean if reference is None else reference
        share = (mean - toy.STANDING_STILL) / (reference - toy.STANDING_STILL)
        rows = zip(mean, found.std(0), share, strict=True)
        table.add_row(
            setting.name, *(f"{value:.3f} ± {spread:.3f}, {100 * part:.1f} %" for value, spread, part in rows)
        )
    console = Console()
    console.print(table)
    console.print(
        f"Standing still returns {toy.STANDING_STILL:g}; the share is of what on-policy training gains on it."
    )
