"""Generalised advantage estimation (Schulman et al. 2016, arXiv 1506.02438, equation 16)."""

import jax
import jax.numpy as jnp

from common.task.types import Array


def advantages(
    reward: Array, value: Array, last_value: Array, terminal: Array, gamma: Array | float, gae_lambda: Array | float
) -> tuple[Array, Array]:
    """Advantages and lambda-returns, both (T, B), of a chunk in which episodes follow one another.

    A_t = delta_t + gamma lambda (1 - terminal_t) A_{t+1} with delta_t = r_t + gamma (1 - terminal_t) V_{t+1} - V_t, and
    the return is A_t + V_t. Beyond a terminal step the value is zero; where the chunk is cut inside an episode, V_T is
    the value of the observation after the last step.

    Args:
      reward: (T, B).
      value: (T, B) values of the observations that were acted on, in the rewards' unit.
      last_value: (B,) value of the observation after the last step; ignored where that step was terminal.
      terminal: (T, B) bool, true where an episode ended with this step.
      gamma: discount.
      gae_lambda: lambda.
    """
    continues = 1.0 - terminal.astype(value.dtype)
    next_value = jnp.concatenate([value[1:], last_value[None]])
    delta = reward + gamma * continues * next_value - value

    def backward(advantage: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        delta_t, continues_t = step
        advantage = delta_t + gamma * gae_lambda * continues_t * advantage
        return advantage, advantage

    _, advantage = jax.lax.scan(backward, jnp.zeros_like(last_value), (delta, continues), reverse=True)
    return advantage, advantage + value
