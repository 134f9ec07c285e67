"""Advantages and losses, against numbers worked out by hand."""

import functools

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from congrasp.common.config import NetworkConfig
from congrasp.common.policy import network, normalizer
from congrasp.learner.algorithms import gae, losses
from congrasp.learner.distributed.collectives import Collectives
from tests.learner import toy

advantages = jax.jit(gae.advantages)


def test_three_steps_by_hand():
    """Gamma 0.5, lambda 0.5; step 1 ends an episode in the last two worlds, in the last one because
    of the clock.
    """
    reward = np.tile(np.float32([[1.0], [2.0], [3.0]]), 3)
    value = np.tile(np.float32([[0.5], [1.0], [1.5]]), 3)
    terminal, truncated = np.zeros((2, 3, 3), bool)
    terminal[1, 1:] = truncated[1, 2] = True
    advantage, returns = advantages(
        reward, value, np.full(3, 2.0, np.float32), terminal, 0.5, 0.5, truncated
    )
    # World 0: delta = 1+.5-.5 = 1, 2+.75-1 = 1.75, 3+1-1.5 = 2.5; A = 1+.25*2.375, 1.75+.25*2.5,
    # 2.5. World 1: delta = 2-1 = 1 and A = 1; before it A = 1+.25*1. World 2: delta = 2+.5*1-1 =
    # 1.5; A = 1+.25*1.5.
    expected = [[1.59375, 1.25, 1.375], [2.375, 1.0, 1.5], [2.5, 2.5, 2.5]]
    np.testing.assert_allclose(advantage, expected, rtol=1e-6)
    np.testing.assert_allclose(returns, expected + value, rtol=1e-6)


@hypothesis.settings(max_examples=40, deadline=None)
@hypothesis.given(st.integers(0, 10_000), st.floats(0.5, 1.0), st.floats(0.0, 1.0), st.booleans())
def test_any_rollout_has_the_advantages_of_the_definition(seed, gamma, gae_lambda, marked):
    """A step that ends an episode passes nothing on, and a mark of truncation on another step is
    ignored.
    """
    rng = np.random.default_rng(seed)
    reward, value = rng.normal(size=(2, 7, 3)).astype(np.float32)
    terminal, truncated = rng.random((2, 7, 3)) < 0.3
    last = rng.normal(size=3).astype(np.float32)
    advantage, returns = advantages(
        reward, value, last, terminal, gamma, gae_lambda, truncated if marked else None
    )
    expected = np.empty((7, 3))
    following = np.zeros(3)
    after = last
    for t in reversed(range(7)):
        bootstrap = np.where(terminal[t], marked * value[t] * truncated[t], after)
        delta = reward[t] + gamma * bootstrap - value[t]
        following = delta + np.where(terminal[t], 0.0, gamma * gae_lambda * following)
        expected[t] = following
        after = value[t]
    np.testing.assert_allclose(advantage, expected, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(returns, expected + value, rtol=1e-4, atol=1e-4)


LAYOUT = (("state", 3), *toy.LAYOUT[1:])


@pytest.mark.parametrize(
    ("ratio", "advantage", "weight", "loss"),
    [
        (1.1, 2.0, 1.0, -2.2),  # inside the range
        (1.5, 2.0, 1.0, -2.4),  # gains no more than the clip gives
        (0.5, 2.0, 1.0, -1.0),  # the worse of both: not clipped
        (0.5, -2.0, 1.0, 1.6),  # clipped from below
        (1.5, -2.0, 1.0, 3.0),
        (1.5, 2.0, 0.25, -0.6),  # the importance weight scales the clipped term
    ],
)
def test_surrogate_by_hand(ratio, advantage, weight, loss):
    got = losses.surrogate(jnp.log(ratio), jnp.array(advantage), jnp.array(weight), 0.2)
    np.testing.assert_allclose(got, loss, rtol=1e-5)


@pytest.mark.parametrize(
    ("log_proximal", "log_behaviour", "weight"),
    [
        (-3.0, -3.0, 1.0),
        (-3.0 + np.log(2.0), -3.0, 2.0),
        (-1.0, -5.0, 4.0),
        (0.0, -500.0, 4.0),
        (-500.0, 0.0, 0.0),
    ],
)
def test_importance_weight_is_truncated_and_never_overflows(log_proximal, log_behaviour, weight):
    got = losses.importance_weight(jnp.float32(log_proximal), jnp.float32(log_behaviour), 4.0)
    np.testing.assert_allclose(got, weight, rtol=1e-5, atol=1e-30)


def test_importance_weight_has_no_gradient():
    assert (
        jax.grad(lambda x: losses.importance_weight(x, jnp.float32(0.0), 4.0))(jnp.float32(0.5))
        == 0.0
    )


@pytest.fixture(scope="module")
def case():
    params = network.init(0, LAYOUT, 2, NetworkConfig(hidden=(8,), encoder=2))
    rng = np.random.default_rng(1)
    observation = rng.normal(size=(64, 12)).astype(np.float32)
    mean, log_std = network.policy(params, LAYOUT, observation)
    action = np.asarray(mean) + rng.normal(size=(64, 2)).astype(np.float32) * 0.6
    log_proximal = network.log_probability(mean, log_std, action)
    sample = losses.Sample(
        observation=observation,
        action=action,
        log_proximal=log_proximal,
        mean_proximal=mean,
        weight=losses.importance_weight(log_proximal, log_proximal, 4.0),
        advantage=rng.normal(size=64).astype(np.float32),
        target=rng.normal(size=64).astype(np.float32),
        stale=np.arange(64) >= 48,
    )
    return params, log_std, sample


# Compiled as wholes: that is quicker than compiling every operation by itself.
objective = jax.jit(losses.objective, static_argnums=1)


@jax.jit
def plain_ppo(params, sample, log_behaviour, clip=0.2, value=0.5, entropy=0.01):
    """Schulman et al. 2017, equations 7 and 9, written out for this test alone."""
    mean, log_std = network.policy(params, LAYOUT, sample.observation)
    ratio = jnp.exp(network.log_probability(mean, log_std, sample.action) - log_behaviour)
    bounded = jnp.minimum(jnp.maximum(ratio, 1 - clip), 1 + clip)
    gain = jnp.mean(jnp.minimum(ratio * sample.advantage, bounded * sample.advantage))
    error = jnp.mean((network.value(params, LAYOUT, sample.observation) - sample.target) ** 2)
    return -gain + value * error - entropy * network.entropy(log_std)


def test_fresh_data_reduce_it_to_plain_ppo(case):
    params, log_std, sample = case
    coefficients = losses.Coefficients(clip=0.2, entropy=0.01, value=0.5)
    # Away from the proximal policy, so that some are clipped
    moved = jax.tree.map(lambda leaf: leaf + 0.05, params)
    (loss, terms), gradient = jax.jit(
        jax.value_and_grad(losses.objective, has_aux=True), static_argnums=1
    )(moved, LAYOUT, log_std, sample, coefficients)
    expected, expected_gradient = jax.value_and_grad(plain_ppo)(moved, sample, sample.log_proximal)
    assert 0.0 < terms.clip_fraction < 1.0
    np.testing.assert_allclose(loss, expected, rtol=1e-6)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6),
        gradient,
        expected_gradient,
    )


def test_the_clip_is_counted_by_the_end_it_holds_and_by_staleness(case):
    """Ratios of 1.5 and .5 lie outside 1 +- .2, and 1 within; of the sixteen stale samples eight
    lie outside.
    """
    params, log_std, sample = case
    ratio = np.ones(64, np.float32)
    ratio[:8] = 1.5
    ratio[8:12] = 0.5
    ratio[48:56] = 0.5
    advantage = np.where(np.arange(64) < 48, 1.0, -1.0).astype(np.float32)
    mean, log_std_now = network.policy(params, LAYOUT, sample.observation, exact=False)
    now = network.log_probability(mean, log_std_now, sample.action)
    moved = sample._replace(log_proximal=now - jnp.log(ratio), advantage=advantage)
    _, terms = objective(params, LAYOUT, log_std, moved, losses.Coefficients(0.2, 0.0, 0.0))
    assert terms.clip_fraction == 20 / 64
    # Nothing holds the four below: their advantage is positive
    assert terms.clip_fraction_rising == 8 / 64
    assert terms.clip_fraction_falling == 8 / 64
    assert terms.clip_fraction_stale == 8 / 16


def test_stale_data_do_not_use_up_the_trust_region(case):
    """The behaviour policy was far away: plain PPO clips such samples at once, the decoupled
    objective does not.
    """
    params, log_std, sample = case
    log_behaviour = sample.log_proximal - jnp.log(1.5)
    stale = sample._replace(
        weight=losses.importance_weight(sample.log_proximal, log_behaviour, 4.0),
        advantage=np.ones(64, np.float32),
    )

    def loss(params):
        return objective(params, LAYOUT, log_std, stale, losses.Coefficients(0.2, 0.0, 0.0))[0]

    def norm(gradient):
        return float(sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(gradient["actor"])))

    assert norm(jax.grad(loss)(params)) > 1e-3
    plain = jax.grad(lambda p: plain_ppo(p, stale, log_behaviour, value=0.0, entropy=0.0))(params)
    assert norm(plain) == 0.0


HYPER = {
    "importance_max": 4.0,
    "reward_scale": 1.0,
    "bootstrap_truncated": True,
    "gamma": 0.99,
    "gae_lambda": 0.95,
}
ROWS = {"observation": (12,), "action": (2,), "log_probability": (), "reward": ()}


def evaluate(batch):
    params = network.init(0, LAYOUT, 2, NetworkConfig(hidden=(64,), encoder=2))
    one = normalizer.Affine(jnp.float32(0.0), jnp.float32(1.0))
    inputs = losses.Inputs(batch, one, None, one, {**HYPER, "decoupled": True})
    return losses.evaluate(params, inputs, Collectives(None), LAYOUT)


def test_a_batch_that_is_evaluated_in_parts_has_the_same_samples(monkeypatch):
    """Five steps of three worlds: all at once, and two steps at a time with one that remains."""
    rng = np.random.default_rng(2)
    batch = {name: rng.normal(size=(5, 3, *row)).astype(np.float32) for name, row in ROWS.items()}
    batch |= {name: rng.random((5, 3)) < 0.3 for name in ("terminal", "truncated")}
    batch |= {
        "lag": np.zeros(3, np.int32),
        "last_observation": rng.normal(size=(3, 12)).astype(np.float32),
    }
    at_once = evaluate(batch)
    monkeypatch.setattr(losses, "MAX_TOGETHER", 6)
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5),
        evaluate(batch),
        at_once,
    )


def test_the_features_of_a_long_rollout_are_not_held_at_once():
    """Those of one layer of 64 units are 8 MiB a step of 2^15 worlds, 64 in all; what is kept of a
    step is 1 MiB.
    """
    worlds = 1 << 15

    def temporary(steps):
        batch = {
            name: jax.ShapeDtypeStruct((steps, worlds, *row), jnp.float32)
            for name, row in ROWS.items()
        }
        flags = jax.ShapeDtypeStruct((steps, worlds), bool)
        batch |= {
            "terminal": flags,
            "truncated": flags,
            "lag": jax.ShapeDtypeStruct((worlds,), jnp.int32),
        }
        batch["last_observation"] = jax.ShapeDtypeStruct((worlds, 12), jnp.float32)
        return jax.jit(evaluate).lower(batch).compile().memory_analysis().temp_size_in_bytes

    assert temporary(8) - temporary(1) < 7 * (2 << 20)
