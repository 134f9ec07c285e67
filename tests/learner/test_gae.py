"""Advantages and returns: an example worked out by hand, and the definition for any rollout."""

import hypothesis
import hypothesis.strategies as st
import jax
import numpy as np

from congrasp.learner.algorithms import gae

advantages = jax.jit(gae.advantages)


def test_three_steps_by_hand():
    """Gamma 0.5, lambda 0.5; step 1 ends an episode in the last two worlds, in the last one because of the clock."""
    reward = np.tile(np.float32([[1.0], [2.0], [3.0]]), 3)
    value = np.tile(np.float32([[0.5], [1.0], [1.5]]), 3)
    terminal, truncated = np.zeros((2, 3, 3), bool)
    terminal[1, 1:] = truncated[1, 2] = True
    advantage, returns = advantages(reward, value, np.full(3, 2.0, np.float32), terminal, 0.5, 0.5, truncated)
    # World 0: delta = 1+.5-.5 = 1, 2+.75-1 = 1.75, 3+1-1.5 = 2.5; A = 1+.25*2.375, 1.75+.25*2.5, 2.5.
    # World 1: delta = 2-1 = 1 and A = 1; before it A = 1+.25*1. World 2: delta = 2+.5*1-1 = 1.5; A = 1+.25*1.5.
    expected = [[1.59375, 1.25, 1.375], [2.375, 1.0, 1.5], [2.5, 2.5, 2.5]]
    np.testing.assert_allclose(advantage, expected, rtol=1e-6)
    np.testing.assert_allclose(returns, expected + value, rtol=1e-6)


@hypothesis.settings(max_examples=40, deadline=None)
@hypothesis.given(st.integers(0, 10_000), st.floats(0.5, 1.0), st.floats(0.0, 1.0), st.booleans())
def test_any_rollout_has_the_advantages_of_the_definition(seed, gamma, gae_lambda, marked):
    """A step that ends an episode passes nothing on, and a mark of truncation on another step is ignored."""
    rng = np.random.default_rng(seed)
    reward, value = rng.normal(size=(2, 7, 3)).astype(np.float32)
    terminal, truncated = rng.random((2, 7, 3)) < 0.3
    last = rng.normal(size=3).astype(np.float32)
    advantage, returns = advantages(reward, value, last, terminal, gamma, gae_lambda, truncated if marked else None)
    expected, following, after = np.empty((7, 3)), np.zeros(3), last
    for t in reversed(range(7)):
        bootstrap = np.where(terminal[t], marked * value[t] * truncated[t], after)
        delta = reward[t] + gamma * bootstrap - value[t]
        following = delta + np.where(terminal[t], 0.0, gamma * gae_lambda * following)
        expected[t], after = following, value[t]
    np.testing.assert_allclose(advantage, expected, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(returns, expected + value, rtol=1e-4, atol=1e-4)
