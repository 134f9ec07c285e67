"""The task as Gymnasium sees it: its own checker, ends, and what comes after them."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import congrasp
from congrasp.common.errors import CongraspError
from congrasp.services.gym.vector_env import ACTION, GraspEnv, GraspVectorEnv

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
    made = congrasp.make_vec(num_envs=COUNT, **SHORT)
    yield made
    made.close()


@pytest.mark.slow
def test_gymnasium_accepts_the_environment():
    env = GraspEnv(**SHORT)
    check_env(env, skip_render_check=True)
    env.close()


def test_environments_restart_in_the_same_step(vector):
    """Without the object up an end is a termination; the last observation comes beside the first
    one of the next.
    """
    first, infos = vector.reset(seed=3)
    assert first in vector.observation_space and infos == {}
    assert vector.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    still = np.zeros(vector.action_space.shape, np.float32)
    steps = [vector.step(still) for _ in range(SHORT["approach_steps"] + SHORT["hold_steps"])]
    for observation, reward, terminated, truncated, infos in steps[:-1]:
        assert (
            observation in vector.observation_space
            and reward.shape == (COUNT,)
            and np.isfinite(reward).all()
        )
        assert not (terminated | truncated).any() and infos == {}
    observation, _, terminated, truncated, infos = steps[-1]
    assert (terminated ^ truncated).all() and infos["_final_obs"].all() and infos["_episode"].all()
    assert infos["final_obs"] in vector.observation_space
    assert (np.abs(infos["final_obs"] - observation).max(-1) > 0.01).all()
    np.testing.assert_array_equal(
        infos["episode"]["length"], SHORT["approach_steps"] + SHORT["hold_steps"]
    )
    np.testing.assert_array_equal(infos["episode"]["success"] > 0, truncated)


def test_a_seed_decides_everything(vector):
    actions = (
        np.random.default_rng(0)
        .uniform(-ACTION, ACTION, (4, *vector.action_space.shape))
        .astype(np.float32)
    )

    def run(seed):
        observations = [vector.reset(seed=seed)[0]]
        return np.stack([*observations, *(vector.step(action)[0] for action in actions)])

    once, again, other = run(1), run(1), run(2)
    np.testing.assert_array_equal(once, again)
    assert np.abs(once - other).max() > 0.01


def test_gymnasium_makes_it_by_its_id():
    made = gym.make_vec(
        "congrasp.services.gym:congrasp/Grasp-v0", COUNT, "vector_entry_point", **SHORT
    )
    assert (
        isinstance(made.unwrapped, GraspVectorEnv)
        and made.reset(seed=0)[0].shape == made.observation_space.shape
    )
    made.close()


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        (
            {"id": "congrasp/Grasp-v9"},
            r"no environment 'congrasp/Grasp-v9'.*Known: congrasp/Grasp-v0",
        ),
        ({"gravity": 1.0}, "The task has no field 'gravity'"),
        ({"hand": "foot"}, "foot"),
        ({"num_envs": 0}, "There are 0 environments"),
    ],
)
def test_unknown_names_and_no_environments(asked, says):
    with pytest.raises(CongraspError, match=says):
        congrasp.make_vec(**asked)
