"""The task as Gymnasium sees it: its own checker and wrappers, ends, seeds and actions."""

import hashlib

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import congrasp
from congrasp.common.errors import CongraspError
from congrasp.services.gym.vector_env import ACTION, GraspEnv, GraspVectorEnv
from tests.children import python

# Episodes of five steps, which end within a test, of a task whose programs are small.
SHORT = {
    **{
        "objects": 2,
        "physics": "native",
        "approach_steps": 3,
        "hold_steps": 2,
        "hold_steps_max": 2,
    },
    **{"constraints": ("heading",), "surface_points": 64},
}
COUNT = 4


@pytest.fixture(scope="module")
def vector():
    environments = congrasp.make_vec(num_envs=COUNT, **SHORT)
    yield environments
    environments.close()


@pytest.mark.slow
def test_gymnasium_accepts_the_environment():
    env = GraspEnv(**SHORT)
    check_env(env, skip_render_check=True)
    env.close()


def test_environments_restart_in_the_same_step(vector):
    """Without the object up an end is a termination; the last observation is returned with the
    first one of the next episode.
    """
    first, infos = vector.reset(seed=3)
    assert first in vector.observation_space
    assert infos == {}
    assert vector.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    still = np.zeros(vector.action_space.shape, np.float32)
    steps = [vector.step(still) for _ in range(SHORT["approach_steps"] + SHORT["hold_steps"])]
    for observation, reward, terminated, truncated, infos in steps[:-1]:
        assert observation in vector.observation_space
        assert reward.shape == (COUNT,)
        assert np.isfinite(reward).all()
        assert not (terminated | truncated).any()
        assert infos == {}
    observation, _, terminated, truncated, infos = steps[-1]
    assert (terminated ^ truncated).all()
    assert infos["_final_obs"].all()
    assert infos["_metrics"].all()
    assert infos["final_obs"] in vector.observation_space
    assert (np.abs(infos["final_obs"] - observation).max(-1) > 0.01).all()
    np.testing.assert_array_equal(
        infos["metrics"]["length"], SHORT["approach_steps"] + SHORT["hold_steps"]
    )
    np.testing.assert_array_equal(infos["metrics"]["success"] > 0, truncated)


def test_a_seed_decides_everything(vector):
    actions = (
        np.random.default_rng(0)
        .uniform(-ACTION, ACTION, (4, *vector.action_space.shape))
        .astype(np.float32)
    )

    def run(seed):
        observations = [vector.reset(seed=seed)[0]]
        return np.stack([*observations, *(vector.step(action)[0] for action in actions)])

    once = run(1)
    again = run(1)
    other = run(2)
    np.testing.assert_array_equal(once, again)
    assert np.abs(once - other).max() > 0.01


def test_gymnasium_makes_it_by_its_id():
    environments = gym.make_vec(
        "congrasp.services.gym:congrasp/Grasp-v0", COUNT, "vector_entry_point", **SHORT
    )
    assert isinstance(environments.unwrapped, GraspVectorEnv)
    assert environments.reset(seed=0)[0].shape == environments.observation_space.shape
    environments.close()


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        (
            {"id": "congrasp/Grasp-v9"},
            r"no environment 'congrasp/Grasp-v9'.*Known: congrasp/Grasp-v0",
        ),
        ({"gravity": 1.0}, "The task has no field 'gravity'"),
        ({"hand": "foot"}, "foot"),
        ({"num_envs": 0}, "num_envs is 0"),
        ({"approach_steps": -3}, "approach_steps is -3, not 1 to 10000"),
        ({"control_dt": float("nan")}, "control_dt is not a finite number"),
    ],
)
def test_unknown_names_and_no_environments(asked, says):
    with pytest.raises(CongraspError, match=says):
        congrasp.make_vec(**asked)


LENGTH = SHORT["approach_steps"] + SHORT["hold_steps"]


@pytest.fixture(scope="module")
def next_step():
    environments = congrasp.make_vec(num_envs=COUNT, autoreset_mode="NextStep", **SHORT)
    yield environments
    environments.close()


@pytest.fixture(scope="module")
def manual():
    environments = congrasp.make_vec(num_envs=COUNT, autoreset_mode=AutoresetMode.DISABLED, **SHORT)
    yield environments
    environments.close()


def still(envs):
    return np.zeros(envs.action_space.shape, np.float32)


def test_environments_restart_in_the_next_step(next_step):
    assert next_step.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    next_step.reset(seed=3)
    for _ in range(LENGTH):
        last, _, terminated, truncated, infos = next_step.step(still(next_step))
    assert (terminated ^ truncated).all()
    assert infos["_metrics"].all()
    first, reward, terminated, truncated, infos = next_step.step(still(next_step))
    assert infos == {}
    assert not reward.any()
    assert not (terminated | truncated).any()
    assert (np.abs(first - last).max(-1) > 0.01).all()
    ends = [next_step.step(still(next_step))[2:4] for _ in range(LENGTH)]
    assert [bool((a | b).all()) for a, b in ends] == [False] * (LENGTH - 1) + [True]


def test_both_automatic_modes_draw_the_same_episodes(vector, next_step):
    vector.reset(seed=5)
    next_step.reset(seed=5)
    for _ in range(LENGTH):
        observation = vector.step(still(vector))[0]
        next_step.step(still(next_step))
    np.testing.assert_array_equal(observation, next_step.step(still(next_step))[0])


def test_a_mask_resets_some_environments(manual):
    manual.reset(seed=1)
    before = manual.step(still(manual))[0]
    mask = np.array([True, False, False, True])
    after, _ = manual.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(after[~mask], before[~mask])
    assert (np.abs(after[mask] - before[mask]).max(-1) > 0.01).all()


def test_each_environment_has_its_own_seed(manual):
    together = manual.reset(seed=[7, 8, 2**40, 2**100])[0]
    np.testing.assert_array_equal(manual.reset(seed=[8, 7, 2**100, 0])[0][:3], together[[1, 0, 3]])
    np.testing.assert_array_equal(manual.reset(seed=np.int64(7))[0][:2], together[:2])
    different = manual.reset(seed=[0, 2**32, 2**40, 2**64])[0]
    assert len(np.unique(different, axis=0)) == COUNT
    observations = manual.reset(seed=[None, 7, None, None])[0]
    np.testing.assert_array_equal(observations[1], together[0])
    assert len(np.unique([*observations, *different], axis=0)) == 2 * COUNT


def test_an_environment_draws_the_same_alone_and_among_others(manual):
    env = GraspEnv(**SHORT)
    np.testing.assert_array_equal(env.reset(seed=3)[0], manual.reset(seed=[1, 3, 5, 7])[0][1])
    env.close()


def test_episodes_without_a_seed_differ_between_processes(vector):
    code = "import congrasp, hashlib\n"
    code += f"envs = congrasp.make_vec(num_envs={COUNT}, **{SHORT!r})\n"
    code += "print(hashlib.sha1(envs.reset()[0].tobytes()).hexdigest())"
    here = congrasp.make_vec(num_envs=COUNT, **SHORT)
    digest = hashlib.sha1(here.reset()[0].tobytes()).hexdigest()
    here.close()
    assert python("-c", code).stdout.strip() not in (digest, "")


def test_arrays_may_be_changed_by_the_caller(vector):
    vector.reset(seed=1)
    step = vector.step(still(vector))
    for array in step[:4]:
        array[...] = 0
    after = vector.step(still(vector))
    assert after[0].any()
    assert after[1].any()


SHAPE = (COUNT, 26)


@pytest.mark.parametrize(
    ("actions", "says"),
    [
        (np.zeros(SHAPE[1]), "shape"),
        (np.zeros((3, SHAPE[1])), "shape"),
        (np.zeros((COUNT, SHAPE[1] + 1)), "shape"),
        (np.full(SHAPE, np.nan), "finite"),
        (np.full(SHAPE, 1e300), "finite"),
        ([["a"] * SHAPE[1]] * COUNT, "numbers"),
    ],
)
def test_invalid_actions_are_refused(actions, says, vector):
    vector.reset(seed=1)
    with pytest.raises(CongraspError, match=says):
        vector.step(actions)
    assert np.isfinite(vector.step(still(vector))[0]).all()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"seed": -1}, "seed is -1"),
        ({"seed": 1.5}, "seed is 1.5"),
        ({"seed": [1, 2]}, "2 seeds for 4"),
        ({"options": {"reset_masks": 1}}, "reset_masks"),
        ({"options": {"reset_mask": np.ones(3, bool)}}, "reset_mask has shape"),
        ({"options": {"reset_mask": np.ones(COUNT)}}, "type float64"),
        ({"options": {"reset_mask": np.zeros(COUNT, bool)}}, "false everywhere"),
    ],
)
def test_invalid_resets_are_refused(arguments, says, vector):
    with pytest.raises(CongraspError, match=says):
        vector.reset(**arguments)


def test_a_step_needs_an_episode_and_an_open_environment():
    envs = congrasp.make_vec(num_envs=2, **SHORT)
    with pytest.raises(CongraspError, match="Call reset"):
        envs.step(still(envs))
    envs.close()
    with pytest.raises(CongraspError, match="closed"):
        envs.reset()


def test_an_unknown_autoreset_mode_is_refused():
    with pytest.raises(CongraspError, match=r"'sometimes'.*NEXT_STEP"):
        congrasp.make_vec(autoreset_mode="sometimes")


WRAPPERS = gym.wrappers.vector


def test_statistics_of_gymnasium_count_episodes(vector, next_step):
    for envs in (vector, next_step):
        counted = WRAPPERS.RecordEpisodeStatistics(envs)
        counted.reset(seed=1)
        for _ in range(LENGTH):
            *_, infos = counted.step(still(envs))
        np.testing.assert_array_equal(infos["episode"]["l"], LENGTH)
        assert infos["_metrics"].all()


def test_wrappers_of_gymnasium_accept_vectors(next_step):
    normal = WRAPPERS.NormalizeReward(WRAPPERS.NormalizeObservation(next_step))
    halved = WRAPPERS.TransformObservation(next_step, lambda obs: obs / 2)
    flat = WRAPPERS.FlattenObservation(next_step)
    for envs in (normal, halved, flat):
        envs.reset(seed=1)
        for _ in range(LENGTH + 2):
            observation, reward, *_ = envs.step(still(envs))
        assert observation.shape == next_step.observation_space.shape
        assert np.isfinite(observation).all()
        assert np.isfinite(reward).all()


def test_wrappers_of_gymnasium_accept_a_single_environment():
    env = gym.make("congrasp.services.gym:congrasp/Grasp-v0", **SHORT)
    env = gym.wrappers.RecordEpisodeStatistics(gym.wrappers.FlattenObservation(env))
    env = gym.wrappers.NormalizeReward(gym.wrappers.NormalizeObservation(env))
    env = gym.wrappers.TransformObservation(env, lambda obs: obs.clip(-10, 10), None)
    env.reset(seed=1)
    for _ in range(LENGTH):
        observation, _, terminated, truncated, info = env.step(env.action_space.sample())
    assert terminated or truncated
    assert info["episode"]["l"] == info["metrics"]["length"] == LENGTH
    assert np.abs(observation).max() <= 10
    env.close()


def test_a_loop_like_those_of_cleanrl_collects_returns(next_step):
    """PPO's collection: arrays of all steps, without those of a restart, which have no action."""
    envs = WRAPPERS.RecordEpisodeStatistics(next_step)
    envs.reset(seed=1)
    rng = np.random.default_rng(0)
    returns = []
    used = []
    restarted = np.zeros(COUNT, bool)
    for _ in range(3 * (LENGTH + 1)):
        actions = rng.normal(size=envs.action_space.shape).clip(-ACTION, ACTION)
        _, _, terminated, truncated, infos = envs.step(actions)
        used.append(~restarted)
        restarted = terminated | truncated
        if "episode" in infos:
            returns += infos["episode"]["r"][infos["_episode"]].tolist()
    assert np.sum(used) == 3 * LENGTH * COUNT
    assert len(returns) == 3 * COUNT
    assert np.isfinite(returns).all()
