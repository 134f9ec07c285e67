import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from congrasp.common.config import PPOConfig
from congrasp.common.errors import CongraspError, PhysicsError
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy import network, normalizer
from congrasp.learner.algorithms import ppo
from congrasp.learner.algorithms.ppo import PPO
from congrasp.learner.algorithms.protocol import LearnedPolicy, NonFiniteUpdate, TrainState
from tests.compiled import program_count
from tests.learner import toy

ALGORITHM = PPO(toy.SPEC, toy.SETTINGS)
step = ALGORITHM.update


def fresh(seed: int = 0) -> TrainState:
    return ALGORITHM.init(seed)


def changed(**settings) -> PPO:
    return PPO(toy.SPEC, dataclasses.replace(toy.SETTINGS, **settings))


def rollout(
    bundle: bundles.PolicyBundle, seed: int, worlds: int = 64, reach: float = 1.0
) -> dict[str, np.ndarray]:
    return toy.sampled(bundle, jax.random.PRNGKey(seed), worlds, np.random.default_rng(seed), reach)


def leaves(state: TrainState) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(state)]


@pytest.mark.parametrize("lag", [0, 2])
def test_ppo_learns_to_reach(lag):
    """From hardly moving to better than halving the distance at every step, also from stale
    rollouts.
    """
    state = fresh()
    published = [toy.bundle_of(state)]
    assert toy.mean_return(published[0]) < toy.STANDING_STILL / 2
    for seed in range(60):
        batch = rollout(published[max(0, len(published) - 1 - lag)], seed)
        state, metrics = step(state, batch)
        published.append(toy.bundle_of(state))
    assert toy.mean_return(published[-1]) > toy.HALVING
    assert metrics["explained_variance"] > 0.5
    if lag == 0:
        assert metrics["importance_mean"] == pytest.approx(1.0, abs=1e-3)


def test_counters_and_normalisers_follow_the_batch():
    state = fresh()
    batch = rollout(toy.bundle_of(state), 0)
    state, _ = step(state, batch)
    state, _ = step(state, rollout(toy.bundle_of(state), 1))
    assert state.version == 2
    assert state.transitions == 2 * 64 * toy.STEPS
    assert state.observation.count == state.value.count == 2 * 64 * toy.STEPS
    assert state.observation.mean.dtype == np.float64


def test_the_normaliser_moves_after_the_epochs():
    """The log probability that the learner recomputes is the behaviour's, though the batch is
    unlike all before.
    """
    state = fresh()
    for seed in range(5):
        state, _ = step(state, rollout(toy.bundle_of(state), seed))
    old = normalizer.observation_affine(state.observation, toy.LAYOUT)
    batch = rollout(toy.bundle_of(state), 9, reach=5.0)
    state, metrics = step(state, batch)
    assert metrics["importance_max"] == pytest.approx(1.0, abs=1e-3)
    assert metrics["behaviour_kl"] == pytest.approx(0.0, abs=1e-4)
    new = normalizer.observation_affine(state.observation, toy.LAYOUT)
    assert np.max(np.abs(new.scale / old.scale - 1.0)) > 0.2


def test_moving_the_value_statistics_does_not_move_the_values():
    """In rewards' units the critic says the same before and after its normaliser took the batch
    in.
    """
    frozen = changed(learning_rate=0.0, learning_rate_range=(0.0, 0.0))
    state = frozen.init(0)
    batch = rollout(toy.bundle_of(state), 0)
    probe = normalizer.apply(
        normalizer.observation_affine(normalizer.empty((11,)), toy.LAYOUT),
        batch["last_observation"],
    )

    def values(state):
        affine = normalizer.value_affine(state.value)
        return (
            np.asarray(network.value(state.params, toy.LAYOUT, probe)) / affine.scale + affine.shift
        )

    before = values(state)
    after, _ = frozen.update(state, batch)
    assert after.value.count > 0
    np.testing.assert_allclose(values(after), before, rtol=1e-4, atol=1e-4)


def test_rounding_is_separated_from_lag():
    """Rollouts of the same version with log probabilities .01 off show as a gap of .01, older ones
    not at all.
    """
    # The first update normalises by its own batch
    state, _ = step(fresh(), rollout(toy.bundle_of(fresh()), 1))
    batch = rollout(toy.bundle_of(state), 0)
    batch["log_probability"] = batch["log_probability"] + np.where(
        np.arange(64) < 32, 0.01, 0.5
    ).astype(np.float32)
    batch["lag"] = (np.arange(64) >= 32).astype(np.int32)
    _, metrics = step(state, batch)
    assert metrics["log_probability_gap"] == pytest.approx(0.01, rel=1e-2)
    assert metrics["behaviour_kl"] == pytest.approx(0.255, rel=1e-3)


def test_truncated_ends_have_the_td_errors_of_both_rules():
    """With a critic of zeros but for its bias, V = 0.7 everywhere."""
    state = fresh()
    critic = jax.tree.map(jnp.zeros_like, state.params["critic"])
    critic["output"] = {**critic["output"], "bias": jnp.array([0.7])}
    state = state._replace(params={**state.params, "critic": critic})
    batch = rollout(toy.bundle_of(state), 0)
    _, none = step(state, batch)
    assert (
        none["truncated"]
        == none["td_error_truncated"]
        == none["td_error_truncated_as_terminal"]
        == 0.0
    )
    batch["truncated"][-1, :16] = True
    reward = batch["reward"]
    ended = batch["reward"][-1, :16].mean()
    errors = {}
    for bootstrap in (True, False):
        _, metrics = changed(bootstrap_truncated=bootstrap).update(
            fresh()._replace(params=state.params), batch
        )
        # Episodes of ten steps, a quarter of which were truncated: one step of forty.
        assert metrics["truncated"] == pytest.approx(1 / 40)
        assert metrics["td_error_truncated"] == pytest.approx(ended + 0.9 * 0.7 - 0.7, abs=1e-5)
        assert metrics["td_error_truncated_as_terminal"] == pytest.approx(ended - 0.7, abs=1e-5)
        continues = np.full(reward.shape, 0.9, np.float32)
        continues[-1, 16 * bootstrap :] = 0.0
        errors[bootstrap] = np.std(reward + 0.7 * continues - 0.7)
        assert metrics["td_error_std"] == pytest.approx(errors[bootstrap], abs=1e-5)
    assert errors[True] != errors[False]


@pytest.mark.parametrize(
    ("kl", "before", "limits", "rate"),
    [
        (0.05, 2e-3, (1e-5, 1.0), 2e-3 / 1.5),
        (0.004, 2e-3, (1e-5, 1.0), 3e-3),
        (0.02, 2e-3, (1e-5, 1.0), 2e-3),
        (0.006, 2e-3, (1e-5, 1.0), 2e-3),
        (float("inf"), 2e-3, (1e-5, 1.0), 2e-3 / 1.5),
        (0.0, 2.5e-4, (1e-4, 3e-4), 3e-4),
        (1.0, 1.2e-4, (1e-4, 3e-4), 1e-4),
    ],
)
def test_learning_rate_follows_the_divergence_within_its_range(kl, before, limits, rate):
    hyper = {"kl_target": 0.012, "learning_rate_range": limits}
    np.testing.assert_allclose(
        ppo.adapted_rate(jnp.float32(before), jnp.float32(kl), hyper), rate, rtol=1e-6
    )


def test_a_trained_policy_begins_with_a_tenth_of_the_rate():
    policy = ALGORITHM.policy(fresh())
    rates = [
        float(state.optimizer.hyperparams["learning_rate"])
        for state in (fresh(), ALGORITHM.init(0, policy))
    ]
    assert rates == pytest.approx([toy.SETTINGS.learning_rate, toy.SETTINGS.learning_rate / 10])


def test_divergence_and_noise_are_bounded_as_the_run_settles():
    """Over the last updates the target falls to a tenth, the noise's ceiling geometrically; before,
    it has a floor.
    """
    settings = PPOConfig(kl_target=0.01, settling=0.2)
    targets = [settings.kl_target_at(version, 1000) for version in (0, 800, 900, 1000, 1200)]
    np.testing.assert_allclose(targets, [0.01, 0.01, 0.0055, 0.001, 0.001], rtol=1e-9)
    settings = PPOConfig(settling=0.3, final_std=0.1, least_std=0.35)
    noise = [settings.noise_kept_at(version, 10) for version in (0, 6, 7, 8, 9, 10)]
    np.testing.assert_allclose(noise, [np.inf, np.inf, 2 / 3, 1 / 2, 0.0, 0.0])
    assert [settings.least_std_at(version, 10) for version in (0, 6, 7, 9, 10)] == [
        0.35,
        0.35,
        0.0,
        0.0,
        0.0,
    ]
    never = PPOConfig(kl_target=0.01, final_std=0.1, least_std=0.35)  # settles
    assert never.kl_target_at(9, 9) == 0.01
    assert never.noise_kept_at(9, 9) == np.inf
    assert never.least_std_at(9, 9) == 0.35
    assert PPOConfig(settling=0.3, final_std=0.0).noise_kept_at(9, 10) == np.inf


@pytest.mark.parametrize("least", [0.0, 0.7])
def test_an_update_raises_the_noise_to_its_floor_and_the_last_one_leaves_the_final_noise(least):
    """The deviations are 0.6 before each update; a floor of 0.7 is above what an update reaches."""
    settings = dataclasses.replace(toy.SETTINGS, settling=0.5, final_std=0.2, least_std=least)
    batch = rollout(toy.bundle_of(fresh()), 0)
    stds = {}
    for version in (3, 4, 7):
        moved, metrics = PPO(toy.SPEC, settings, updates=8).update(
            fresh()._replace(version=version), batch
        )
        stds[version] = metrics["action_std"]
        np.testing.assert_allclose(
            np.exp(moved.params["actor"]["log_std"]), metrics["action_std"], rtol=1e-6
        )
    assert stds[3] == pytest.approx(0.7, rel=1e-6) if least else stds[3] > 0.5
    assert stds[4] <= 0.6 * (0.2 / 0.6) ** 0.25 * (1 + 1e-6)
    assert stds[7] == pytest.approx(0.2, rel=1e-5)


def test_a_run_that_settles_lowers_its_rate_in_its_last_update():
    """By the divergence that the rate of the first update suits."""
    batch = rollout(toy.bundle_of(fresh()), 0)
    _, metrics = changed(minibatches=1, epochs=2).update(fresh(), batch)
    settings = dataclasses.replace(
        toy.SETTINGS, minibatches=1, epochs=2, kl_target=metrics["kl"], settling=0.5
    )
    rates = {}
    for version in (0, 8):
        moved, _ = PPO(toy.SPEC, settings, updates=8).update(
            fresh()._replace(version=version), batch
        )
        rates[version] = float(moved.optimizer.hyperparams["learning_rate"])
    np.testing.assert_allclose(rates[0] / rates[8], 1.5, rtol=1e-6)


def test_a_policy_that_left_its_trust_region_waits_while_the_critic_learns():
    """With one minibatch, the second epoch sees what the first one's step did."""
    batch = rollout(toy.bundle_of(fresh()), 0)
    moved = []
    for epochs, target in ((1, 1e-7), (2, 1e-7), (2, 1.0)):
        state, _ = changed(minibatches=1, epochs=epochs, kl_target=target).update(fresh(), batch)
        moved.append(
            {name: np.asarray(ravel_pytree(tree)[0]) for name, tree in state.params.items()}
        )
    once, held, free = moved
    np.testing.assert_allclose(held["actor"], once["actor"], rtol=1e-4, atol=1e-7)
    assert np.abs(free["actor"] - once["actor"]).max() > 1e-5
    assert np.abs(held["critic"] - once["critic"]).max() > 1e-5


def test_a_rate_that_is_too_large_for_a_settled_policy_does_not_break_it():
    """Standard deviations of a hundredth; without the trust region the first update is too
    large.
    """
    algorithm = changed(learning_rate=1e-3, kl_target=0.012)
    state = fresh()
    actor = {
        **state.params["actor"],
        "log_std": jnp.full_like(state.params["actor"]["log_std"], np.log(0.01)),
    }
    state = state._replace(params={**state.params, "actor": actor})
    rates = []
    for seed in range(6):
        state, metrics = algorithm.update(state, rollout(toy.bundle_of(state), seed))
        assert metrics["kl"] < 3.0
        rates.append(metrics["learning_rate"])
    assert rates[-1] < rates[0] / 2


@pytest.mark.parametrize(
    "field", ["observation", "last_observation", "action", "log_probability", "reward"]
)
def test_a_value_that_is_not_finite_is_named_and_changes_nothing(field):
    state = fresh()
    batch = rollout(toy.bundle_of(state), 0)
    batch[field].flat[17] = np.nan
    params = jax.tree.map(np.asarray, state.params)
    with pytest.raises(PhysicsError, match=f"rollouts of update 1: {field}") as caught:
        step(state, batch)
    jax.tree.map(np.testing.assert_array_equal, caught.value.state.params, params)
    assert caught.value.state.version == 0


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ({"reward_scale": 1e25}, "value loss"),
        (
            {"learning_rate": 3.0, "learning_rate_range": (3.0, 3.0)},
            "policy .the KL divergence is too large",
        ),
    ],
)
def test_an_optimisation_that_breaks_is_named_and_changes_nothing(wrong, why):
    """Neither weights nor the optimiser's moments: the next batch goes on from the update
    before.
    """
    algorithm = changed(**wrong)
    state = algorithm.init(0)
    batch = rollout(toy.bundle_of(state), 0)
    before = [np.array(leaf) for leaf in jax.tree.leaves((state.params, state.optimizer))]
    with pytest.raises(NonFiniteUpdate, match=f"optimisation of update 1: {why}") as caught:
        algorithm.update(state, batch)
    after = jax.tree.leaves((caught.value.state.params, caught.value.state.optimizer))
    assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))


def test_more_minibatches_than_transitions_are_refused():
    batch = rollout(toy.bundle_of(fresh()), 0, worlds=1)
    with pytest.raises(CongraspError, match="10 transitions cannot be split into 16 minibatches"):
        changed(minibatches=16).update(fresh(), batch)


def test_other_hyperparameters_do_not_compile_again():
    state, _ = step(fresh(), rollout(toy.bundle_of(fresh()), 0))
    compiled = program_count(ppo.optimise)
    for seed, clip in enumerate((0.1, 0.3)):
        other = changed(clip=clip, entropy=0.01, gamma=0.5, max_grad_norm=0.1)
        state, _ = other.update(state, rollout(toy.bundle_of(state), seed))
    assert program_count(ppo.optimise) == compiled


def test_same_seed_and_data_give_the_same_bits():
    batch = rollout(toy.bundle_of(fresh()), 0)
    first = step(fresh(), batch)[0]
    second = step(fresh(), batch)[0]
    other = step(fresh(1), batch)[0]
    assert all(np.array_equal(a, b) for a, b in zip(leaves(first), leaves(second), strict=True))
    assert not np.array_equal(first.params["actor"]["log_std"], other.params["actor"]["log_std"])


def test_published_weights_outlive_the_next_update():
    """In one process a bundle shares the learner's arrays, which the next update must not take
    away.
    """
    state = fresh()
    bundle = toy.bundle_of(state)
    step(state, rollout(bundle, 0))
    assert np.isfinite(np.asarray(bundle.params["actor"]["log_std"])).all()
    assert np.isfinite(np.asarray(bundle.inference_parameters.normalization.scale)).all()


WIDE = dataclasses.replace(toy.SPEC, privileged=(("future", 1),))


def with_future(batch: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Rewards that no observation predicts, and a privileged input that tells which world has
    which.
    """
    sign = np.where(np.arange(batch["reward"].shape[1]) % 2, 1.0, -1.0).astype(np.float32)
    inputs = np.broadcast_to(3.0 + 0.1 * sign, batch["reward"].shape)[..., None]
    rewards = batch["reward"] + 2.0 * sign
    return {
        **batch,
        "reward": rewards,
        "privileged": inputs.astype(np.float16),
        "last_privileged": inputs[-1].copy(),
    }


def test_a_privileged_critic_explains_hidden_value():
    explained = {}
    for spec in (toy.SPEC, WIDE):
        algorithm = PPO(spec, toy.SETTINGS)
        state = algorithm.init(0)
        for seed in range(15):
            batch = with_future(rollout(toy.bundle_of(state), seed))
            state, metrics = algorithm.update(
                state, {name: batch[name] for name in algorithm.batch_schema}
            )
        explained[bool(spec.privileged)] = metrics["explained_variance"]
    assert explained[True] > 0.8 > 0.4 > explained[False]
    assert state.privileged.count == 15 * 64 * toy.STEPS
    np.testing.assert_allclose(state.privileged.mean, [3.0], atol=1e-3)
    np.testing.assert_array_equal(algorithm.policy(state).privileged.mean, state.privileged.mean)


@pytest.mark.parametrize("field", ["privileged", "last_privileged"])
def test_a_privileged_input_that_is_not_finite_is_named(field):
    algorithm = PPO(WIDE, toy.SETTINGS)
    state = algorithm.init(0)
    batch = with_future(rollout(toy.bundle_of(state), 0))
    batch[field].flat[5] = np.nan
    with pytest.raises(NonFiniteUpdate, match=f"rollouts of update 1: {field}"):
        algorithm.update(state, batch)


def test_a_policy_without_privileged_inputs_begins_with_the_same_values():
    state, _ = step(fresh(), rollout(toy.bundle_of(fresh()), 0))
    narrow = toy.bundle_of(state)
    wide = bundles.with_inputs_of(WIDE, narrow.task, narrow)
    algorithm = PPO(WIDE, toy.SETTINGS)
    begun = algorithm.init(
        0, LearnedPolicy(wide.params, wide.observation, wide.value, wide.privileged)
    )
    assert begun.privileged.count == 0
    batch = with_future(rollout(wide, 1))
    _, wider = algorithm.update(begun, batch)
    _, before = ALGORITHM.update(ALGORITHM.init(0, ALGORITHM.policy(state)), batch)
    assert wider["value_mean"] == pytest.approx(before["value_mean"], rel=1e-4)
