"""The methods that are compared: what each changes of a run, and which policies are taken for one."""

import dataclasses

import jax
import numpy as np
import pytest

from congrasp.common.config import CurriculumConfig, RunConfig, run_config_from_json, to_json
from congrasp.common.errors import CongraspError
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import pretrained_file
from congrasp.common.task.config import RewardWeights, TaskConfig
from congrasp.common.task.control import decode
from congrasp.common.task.features import scene_of
from congrasp.common.task.methods import METHODS, evaluated_as, get_method, takes, with_method
from congrasp.common.task.observation import layout
from congrasp.common.task.reward import reward_terms
from tests.scenes import HAND, F, scene

FIRST, LAST = RewardWeights(drop=2.0), RewardWeights(drop=9.0, heading_position=30.0)
RUN = RunConfig(updates=100, task=TaskConfig(reward=FIRST), curriculum=CurriculumConfig(ramp=(20, 40), reward=LAST))


@pytest.mark.parametrize("name", [name for name, method in METHODS.items() if method.learns])
def test_a_run_of_a_method_says_so_and_survives_the_wire(name):
    run = with_method(RUN, name)
    assert run.task.method == name
    assert run_config_from_json(to_json(run)) == run
    assert evaluated_as(run.task, name, "a policy") == run.task
    assert with_method(run, name) == run or name == "single-stage"
    assert (run == RUN) == (name == "ours")


def test_single_settings_of_the_ablations():
    assert not with_method(RUN, "no-dynamic-center").task.dynamic_center
    assert with_method(RUN, "no-feedforward").task.control == dataclasses.replace(RUN.task.control, lookahead=0)


def test_two_phases_by_hand():
    """Of 100 updates 60 have stationary objects; the weights change with the phase."""
    curriculum = with_method(RUN, "two-phase").curriculum
    assert [curriculum.stationary(version) for version in (0, 59, 60)] == [True, True, False]
    assert [curriculum.weights(FIRST, version) for version in (0, 59, 60)] == [FIRST, FIRST, LAST]
    constant = with_method(dataclasses.replace(RUN, curriculum=CurriculumConfig()), "two-phase").curriculum
    assert constant.weights(FIRST, 99) == FIRST


def test_a_single_stage_has_the_last_weights_from_the_start():
    run = with_method(RUN, "single-stage")
    assert run.curriculum.weights(run.task.reward, 0) == LAST and not run.curriculum.stationary(0)
    constant = with_method(dataclasses.replace(RUN, curriculum=CurriculumConfig()), "single-stage")
    assert constant.curriculum.weights(constant.task.reward, 0) == FIRST


def test_graspxl_knows_heading_and_affordance_alone():
    task = with_method(RUN, "graspxl").task
    assert [name for name, _ in layout(HAND, task)] == ["state", "heading", "affordance", "mask"]
    assert not task.dynamic_center


def test_dgrasp_has_a_pose_in_every_episode_and_no_reward_for_the_heading():
    run = with_method(RUN, "dgrasp")
    assert [name for name, _ in layout(HAND, run.task)] == ["state", "heading", "pose_finger", "pose_wrist", "mask"]
    assert run.task.p_pose == 1.0
    terms = jax.jit(lambda weights, *step: reward_terms(scene_of(HAND, run.task, *step), weights))
    for version in (0, 99):
        paid = terms(run.curriculum.weights(run.task.reward, version), *scene(0))
        assert not np.any(paid["heading_direction"]) and not np.any(paid["heading_position"])
        assert np.any(paid["pose_wrist_position"])


def test_without_learning_actions_count_for_nothing_and_fingers_close_after_half_the_approach():
    task = evaluated_as(TaskConfig(), "pd", "a policy")
    state, surface, goal = scene(1)
    state = state._replace(q_target=np.tile(np.float32(HAND.q_open), (4, 1)))
    act = jax.jit(lambda action, *step: decode(scene_of(HAND, task, *step), task.control, action))
    rng = np.random.default_rng(0)
    closing = np.clip(np.array(HAND.q_closed) - HAND.q_open, -0.05, 0.05)
    half = task.approach_steps // 2
    for time, moved in ((half - 1.0, 0.0 * closing), (half, closing)):
        step = state._replace(time=np.full(4, time, np.float32)), surface, goal
        still = act(np.zeros((4, F + 6), np.float32), *step)
        np.testing.assert_allclose(still.q_target - state.q_target, np.tile(moved, (4, 1)), atol=1e-6)
        pushed = act(rng.normal(size=(4, F + 6)).astype(np.float32), *step)
        np.testing.assert_array_equal(pushed.q_target, still.q_target)
        np.testing.assert_array_equal(pushed.u_target, still.u_target)


def test_a_policy_keeps_its_method(tmp_path):
    """One from before there were methods is ours; another one's name is refused in one line."""
    ours = bundles.load(pretrained_file("human"))
    assert ours.task.method == "ours"
    with pytest.raises(CongraspError, match=r"human\.safetensors has the method 'ours', not 'no-feedforward'"):
        evaluated_as(ours.task, "no-feedforward", "human.safetensors")
    task = with_method(RunConfig(task=ours.task), "no-feedforward").task
    bundles.save(dataclasses.replace(ours, task=task), tmp_path / "other.safetensors")
    assert bundles.load(tmp_path / "other.safetensors").task == task


def test_what_cannot_be():
    with pytest.raises(CongraspError, match=r"no method 'magic'.*ours, pd"):
        get_method("magic")
    with pytest.raises(CongraspError, match=r"'pd' does not learn.*congrasp evaluate --method pd"):
        with_method(RUN, "pd")


def test_rows_that_a_method_can_be_asked_for():
    assert takes("ours", "heading") and takes("graspxl", "affordance")
    assert takes("pd", "trajectory+affordance") and not takes("pd", "affordance")
    assert takes("dgrasp", "pose") and not takes("dgrasp", "heading")
