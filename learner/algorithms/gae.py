"""Generalised advantage estimation (Schulman et al. 2016, arXiv 1506.02438, equation 16)."""

import jax
import jax.numpy as jnp

from congrasp.common.task.types import Array


def td_errors(
    reward: Array,
    value: Array,
    last_value: Array,
    terminal: Array,
    gamma: Array | float,
    truncated: Array | None = None,
) -> Array:
    """Temporal-difference errors delta_t = r_t + gamma V' - V_t, (T, B), of a chunk of consecutive
    episodes.

    V' is V_{t+1} inside an episode, zero after a terminal step, and V_t after a truncated one: a
    rollout lacks the observation after the last step of an episode, and V_t replaces its value, as
    in rsl_rl.

    Args:
      reward, value, last_value, terminal, gamma, truncated: see `advantages`.
    """
    following = jnp.concatenate([value[1:], last_value[None]])
    at_end = jnp.zeros_like(value) if truncated is None else jnp.where(truncated, value, 0.0)
    return reward + gamma * jnp.where(terminal, at_end, following) - value


def advantages(
    reward: Array,
    value: Array,
    last_value: Array,
    terminal: Array,
    gamma: Array | float,
    gae_lambda: Array | float,
    truncated: Array | None = None,
) -> tuple[Array, Array]:
    """Advantages and lambda-returns, both (T, B), of a chunk of consecutive episodes.

    A_t = delta_t + gamma lambda (1 - terminal_t) A_{t+1} with the delta_t of `td_errors`, and the
    return is A_t + V_t. Where the chunk is cut inside an episode, V_T is the value of the
    observation after the last step.

    Args:
      reward: (T, B).
      value: (T, B) values of the observations before each action, in the rewards' unit.
      last_value: (B,) value of the observation after the last step; ignored where that step was
        terminal.
      terminal: (T, B) bool, True where an episode ended with this step.
      gamma: discount.
      gae_lambda: lambda.
      truncated: (T, B) bool, terminal steps to bootstrap from, because a time limit ended the
        episode. None for no step.
    """
    continues = 1.0 - terminal.astype(value.dtype)
    delta = td_errors(reward, value, last_value, terminal, gamma, truncated)

    def backward(advantage: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        delta_t, continues_t = step
        advantage = delta_t + gamma * gae_lambda * continues_t * advantage
        return advantage, advantage

    _, advantage = jax.lax.scan(
        backward, jnp.zeros_like(last_value), (delta, continues), reverse=True
    )
    return advantage, advantage + value
