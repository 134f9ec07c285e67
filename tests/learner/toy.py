"""A continuous-control task of a few numbers, to see within seconds whether something learns: a
point goes to its goal.

The action in [-1, 1] moves the point by half of it; the reward is minus the distance after the
move; an episode has ten steps. The goal is uniform in [-1, 1]. Standing still returns -10 E|g| =
-5; halving the distance at every step returns -E|g| (1 - 2^-10), about -0.5; the best possible is
-E[max(|g| - 1/2, 0)] = -0.125.
"""

from collections.abc import Callable

import jax
import numpy as np

from congrasp.common.config import NetworkConfig, PPOConfig
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.bundle import PolicyBundle, PolicySpec
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.types import Array
from congrasp.learner.algorithms.protocol import TrainState

STANDING_STILL = -5.0
HALVING = -0.5
STEPS = 10
LAYOUT = (
    ("state", 2),
    ("heading", 1),
    ("affordance", 1),
    ("pose_finger", 1),
    ("pose_wrist", 1),
    ("trajectory", 1),
    ("mask", 4),
)
SPEC = PolicySpec("toy", LAYOUT, 1, NetworkConfig(hidden=(32, 32), encoder=2, initial_std=0.6))
SETTINGS = PPOConfig(epochs=4, minibatches=4, gamma=0.9, reward_scale=1.0, learning_rate=1e-3)


def observe(position: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Observations (B, D) of positions and goals (B,), in units that need normalising."""
    observation = np.zeros((len(position), sum(size for _, size in LAYOUT)), np.float32)
    observation[:, 0] = position
    observation[:, 1] = 7.0 + 100.0 * goal
    observation[:, 2] = goal - position
    return observation


def episode(
    act: Callable[[np.ndarray], tuple[Array, Array]],
    worlds: int,
    rng: np.random.Generator,
    reach: float = 1.0,
) -> dict[str, np.ndarray]:
    """A batch of whole episodes; `act` maps observations to actions and log probabilities, goals
    lie within `reach`.
    """
    goal = rng.uniform(-reach, reach, worlds)
    position = np.zeros(worlds)
    rows = []
    for step in range(STEPS):
        observation = observe(position, goal)
        action, log_probability = (np.asarray(x) for x in act(observation))
        position = position + 0.5 * np.clip(action[:, 0], -1, 1)
        terminal = np.full(worlds, step == STEPS - 1)
        reward = -np.abs(goal - position).astype(np.float32)
        rows.append(
            (observation, action, log_probability, reward, terminal, np.zeros(worlds, bool))
        )
    names = ("observation", "action", "log_probability", "reward", "terminal", "truncated")
    batch = {
        name: np.stack(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)
    }
    return {**batch, "last_observation": observe(position, goal)}


def sampled(
    bundle: PolicyBundle, key: Array, worlds: int, rng: np.random.Generator, reach: float = 1.0
) -> dict:
    """A batch of whole episodes under a policy's random actions."""
    keys = iter(jax.random.split(key, STEPS))

    def act(observation: np.ndarray) -> tuple[Array, Array]:
        return bundles.sample_action(LAYOUT, bundle.inference_parameters, observation, next(keys))

    return episode(act, worlds, rng, reach)


def bundle_of(state: TrainState) -> PolicyBundle:
    """The policy of a training state."""
    return PolicyBundle(
        SPEC,
        TaskConfig(),
        state.params,
        state.observation,
        state.value,
        state.version,
        "toy",
        state.transitions,
    )


def mean_return(bundle: PolicyBundle, worlds: int = 200) -> float:
    """Mean return of the policy's mean actions over fixed goals."""

    def act(observation: np.ndarray) -> tuple[Array, Array]:
        return bundles.mean_action(SPEC.layout, bundle.inference_parameters, observation), np.zeros(
            len(observation)
        )

    return float(episode(act, worlds, np.random.default_rng(123))["reward"].sum(0).mean())
