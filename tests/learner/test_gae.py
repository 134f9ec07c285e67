import hypothesis
import hypothesis.strategies as st
import jax.numpy as jnp
import numpy as np

from congrasp.learner.algorithms import gae


def test_three_steps_by_hand():
    # gamma 0.5, lambda 0.5: deltas from the back, without and with a terminal step.
    reward = jnp.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]])
    value = jnp.array([[0.5, 0.5], [1.0, 1.0], [1.5, 1.5]])
    terminal = jnp.array([[False, False], [False, True], [False, False]])
    advantage, returns = gae.advantages(reward, value, jnp.array([2.0, 2.0]), terminal, 0.5, 0.5)
    # World 0: delta = 1+.5-.5 = 1, 2+.75-1 = 1.75, 3+1-1.5 = 2.5; A = 1+.25*2.375, 1.75+.25*2.5, 2.5.
    # World 1: step 1 ends an episode: delta = 2-1 = 1 and A = 1; before it A = 1+.25*1.
    expected = [[1.59375, 1.25], [2.375, 1.0], [2.5, 2.5]]
    np.testing.assert_allclose(advantage, expected, rtol=1e-6)
    np.testing.assert_allclose(returns, np.array(expected) + np.asarray(value), rtol=1e-6)


def test_nothing_leaks_over_a_terminal_step():
    rng = np.random.default_rng(0)
    reward, value = rng.normal(size=(2, 8, 3)).astype(np.float32)
    terminal = np.zeros((8, 3), bool)
    terminal[3] = True
    before, _ = gae.advantages(reward, value, value[0], terminal, 0.99, 0.95)
    reward[4:] += 5.0
    value[4:] -= 7.0
    after, _ = gae.advantages(reward, value, value[0] + 1.0, terminal, 0.99, 0.95)
    np.testing.assert_array_equal(before[:4], after[:4])
    assert not np.allclose(before[4:], after[4:])


def test_the_last_value_counts_only_where_the_chunk_is_cut():
    reward, value = np.ones((2, 2), np.float32), np.zeros((2, 2), np.float32)
    terminal = np.array([[False, False], [False, True]])
    advantage, _ = gae.advantages(reward, value, np.full(2, 10.0, np.float32), terminal, 0.5, 1.0)
    np.testing.assert_allclose(advantage[:, 0], [1.0 + 0.5 * 6.0, 6.0])
    np.testing.assert_allclose(advantage[:, 1], [1.5, 1.0])


def test_a_truncated_step_bootstraps_from_the_value_it_was_acted_on_and_cuts_the_chain():
    # gamma 0.5, lambda 0.5; both worlds end an episode at step 1, and in world 0 the clock did.
    reward = np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]], np.float32)
    value = np.array([[0.5, 0.5], [1.0, 1.0], [1.5, 1.5]], np.float32)
    terminal = np.array([[False, False], [True, True], [False, False]])
    truncated = np.array([[False, False], [True, False], [False, False]])
    advantage, returns = gae.advantages(reward, value, np.full(2, 2.0, np.float32), terminal, 0.5, 0.5, truncated)
    # World 0: delta_1 = 2 + .5 * 1 - 1 = 1.5, A_0 = (1 + .5 * 1 - .5) + .25 * 1.5. World 1: delta_1 = 2 - 1 = 1.
    expected = [[1.375, 1.25], [1.5, 1.0], [2.5, 2.5]]
    np.testing.assert_allclose(advantage, expected, rtol=1e-6)
    np.testing.assert_allclose(returns, np.array(expected) + value, rtol=1e-6)


@hypothesis.settings(max_examples=25, deadline=None)
@hypothesis.given(seed=st.integers(0, 10_000), gamma=st.floats(0.5, 1.0), gae_lambda=st.floats(0.0, 1.0))
def test_truncation_adds_the_discounted_value_within_its_own_episode_alone(seed, gamma, gae_lambda):
    rng = np.random.default_rng(seed)
    reward, value = rng.normal(size=(2, 7, 3)).astype(np.float32)
    terminal, marked = rng.random((2, 7, 3)) < 0.3
    last = rng.normal(size=3).astype(np.float32)
    cut, _ = gae.advantages(reward, value, last, terminal, gamma, gae_lambda)
    bootstrapped, _ = gae.advantages(reward, value, last, terminal, gamma, gae_lambda, marked)
    # A mark on a step that ends nothing is ignored; the others reach back to their episode's start, no further.
    expected, reached = np.empty((7, 3)), np.zeros(3)
    for t in reversed(range(7)):
        reached = np.where(terminal[t], gamma * value[t] * marked[t], gamma * gae_lambda * reached)
        expected[t] = reached
    np.testing.assert_allclose(bootstrapped - cut, expected, atol=1e-4)


@hypothesis.settings(max_examples=25, deadline=None)
@hypothesis.given(seed=st.integers(0, 10_000), gamma=st.floats(0.5, 1.0))
def test_lambda_one_is_the_discounted_sum_of_rewards(seed, gamma):
    rng = np.random.default_rng(seed)
    reward, value = rng.normal(size=(2, 6, 2)).astype(np.float32)
    terminal = rng.random((6, 2)) < 0.3
    last = rng.normal(size=2).astype(np.float32)
    _, returns = gae.advantages(reward, value, last, terminal, gamma, 1.0)
    expected, following = np.empty((6, 2)), last.astype(np.float64)
    for t in reversed(range(6)):
        following = reward[t] + gamma * np.where(terminal[t], 0.0, following)
        expected[t] = following
    np.testing.assert_allclose(returns, expected, rtol=1e-4, atol=1e-4)
