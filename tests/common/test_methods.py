"""The methods that are compared, and the teacher's targets in the terms of a student."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from congrasp.common.config import CurriculumConfig, RunConfig, run_config_from_json, to_json
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import pretrained_file
from congrasp.common.task.config import ControlConfig, RewardWeights, TaskConfig
from congrasp.common.task.control import decode, guided
from congrasp.common.task.features import scene_of
from congrasp.common.task.methods import METHODS, evaluated_as, get_method, takes, with_method
from congrasp.common.task.observation import layout, observe
from congrasp.common.task.privileged import extra, observe_for_teacher, student_action
from congrasp.common.task.reward import reward_terms
from tests.scenes import HAND, F, N, evaluated, scene
from tests.scenes import scene_of as compiled_scene

FIRST = RewardWeights(drop=2.0)
LAST = RewardWeights(drop=9.0, heading_position=30.0)
RUN = RunConfig(
    updates=100,
    task=TaskConfig(reward=FIRST),
    curriculum=CurriculumConfig(ramp=(20, 40), reward=LAST),
)


@pytest.mark.parametrize("name", [name for name, method in METHODS.items() if method.learns])
def test_run_records_its_method(name):
    run = with_method(RUN, name)
    assert run.task.method == name
    assert run_config_from_json(to_json(run)) == run
    assert evaluated_as(run.task, name, "a policy") == run.task
    assert with_method(run, name) == run or name == "single-stage"
    assert (run == RUN) == (name == "ours")


def test_single_settings_of_the_ablations():
    assert not with_method(RUN, "no-dynamic-center").task.dynamic_center
    assert with_method(RUN, "no-feedforward").task.control == dataclasses.replace(
        RUN.task.control, lookahead=0
    )


def test_two_phases_by_hand():
    """Of 100 updates 60 have stationary objects; the weights change with the phase."""
    curriculum = with_method(RUN, "two-phase").curriculum
    assert [curriculum.stationary(version) for version in (0, 59, 60)] == [True, True, False]
    assert [curriculum.weights(FIRST, version) for version in (0, 59, 60)] == [FIRST, FIRST, LAST]
    constant = with_method(
        dataclasses.replace(RUN, curriculum=CurriculumConfig()), "two-phase"
    ).curriculum
    assert constant.weights(FIRST, 99) == FIRST


def test_a_single_stage_has_the_last_weights_from_the_start():
    run = with_method(RUN, "single-stage")
    assert run.curriculum.weights(run.task.reward, 0) == LAST
    assert not run.curriculum.stationary(0)
    constant = with_method(dataclasses.replace(RUN, curriculum=CurriculumConfig()), "single-stage")
    assert constant.curriculum.weights(constant.task.reward, 0) == FIRST


def test_graspxl_has_heading_and_affordance():
    task = with_method(RUN, "graspxl").task
    assert [name for name, _ in layout(HAND, task)] == ["state", "heading", "affordance", "mask"]
    assert not task.dynamic_center


def test_dgrasp_always_has_a_pose():
    run = with_method(RUN, "dgrasp")
    assert [name for name, _ in layout(HAND, run.task)] == [
        "state",
        "heading",
        "pose_finger",
        "pose_wrist",
        "mask",
    ]
    assert run.task.p_pose == 1.0
    terms = jax.jit(lambda weights, *step: reward_terms(scene_of(HAND, run.task, *step), weights))
    for version in (0, 99):
        paid = terms(run.curriculum.weights(run.task.reward, version), *scene(0))
        assert not np.any(paid["heading_direction"])
        assert not np.any(paid["heading_position"])
        assert np.any(paid["pose_wrist_position"])


def test_pd_ignores_actions():
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
        np.testing.assert_allclose(
            still.q_target - state.q_target, np.tile(moved, (4, 1)), atol=1e-6
        )
        pushed = act(rng.normal(size=(4, F + 6)).astype(np.float32), *step)
        np.testing.assert_array_equal(pushed.q_target, still.q_target)
        np.testing.assert_array_equal(pushed.u_target, still.u_target)


def test_a_policy_keeps_its_method(tmp_path):
    """One from before there were methods is ours; another one's name is refused in one line."""
    ours = bundles.load(pretrained_file("human"))
    assert ours.task.method == "ours"
    with pytest.raises(
        CongraspError, match=r"human\.safetensors has the method 'ours', not 'no-feedforward'"
    ):
        evaluated_as(ours.task, "no-feedforward", "human.safetensors")
    task = with_method(RunConfig(task=ours.task), "no-feedforward").task
    bundles.save(dataclasses.replace(ours, task=task), tmp_path / "other.safetensors")
    assert bundles.load(tmp_path / "other.safetensors").task == task


def test_invalid_methods_are_refused():
    with pytest.raises(CongraspError, match=r"no method 'magic'.*ours, pd"):
        get_method("magic")
    with pytest.raises(CongraspError, match=r"'pd' does not learn.*congrasp evaluate --method pd"):
        with_method(RUN, "pd")


def test_rows_that_a_method_supports():
    assert takes("ours", "heading")
    assert takes("graspxl", "affordance")
    assert takes("pd", "trajectory+affordance")
    assert not takes("pd", "affordance")
    assert takes("dgrasp", "pose")
    assert not takes("dgrasp", "heading")


# --- targets of a teacher ---


ALLEGRO = get_hand("allegro")


_student_action = jax.jit(functools.partial(student_action, ALLEGRO, ControlConfig()))


def label(teacher, ahead, limit, velocity, table, own):
    """The student's slide along x, in units of action, where all is along x."""

    def along(x):
        return [x, 0, 0, 0, 0, 0]

    # The first finger joint's servo follows a target of before
    lag = np.append(-0.05, np.zeros(15))
    rows = np.array([*along(ahead), limit, *along(velocity), table, *along(own), *lag], np.float32)
    assert len(rows) == extra(ALLEGRO)
    action = np.append(np.full(16, 0.3), along(teacher)).astype(np.float32)
    student = np.asarray(_student_action(rows, action))
    np.testing.assert_allclose(
        student[:16], action[:16] + lag / 0.1, atol=1e-6
    )  # alpha_f = 0.1 rad
    np.testing.assert_allclose(student[17:], 0.0, atol=1e-6)
    return student[16]


def test_label_reaches_the_teacher_s_target():
    """alpha_w = 0.02 m; 15 m/s^2 allow a lead of 15 / 1800 m = 8.33 mm beyond v / 20."""
    assert label(0.2, 0.001, 0.04, 0.0, 1.0, 0.0) == pytest.approx((0.001 + 0.004) / 0.02, abs=1e-5)
    # The tracker is 3 mm off: the student's guidance is 4 mm ahead, and the target is where it was.
    assert label(0.2, 0.001, 0.04, 0.0, 1.0, 0.004) == pytest.approx(
        (0.005 - 0.004) / 0.02, abs=1e-5
    )
    assert label(0.0, 0.03, 0.04, 0.0, 1.0, 0.03) == pytest.approx(
        (15 / 1800 - 0.03) / 0.02, abs=1e-4
    )
    # At 0.1 m/s the target is 5 mm ahead at least to keep the speed: 5 mm and a third of 8.33 mm
    # without the table.
    assert label(0.0, 0.03, 0.04, 0.1, 0.0, 0.01) == pytest.approx(
        (0.005 + 5 / 1800 - 0.01) / 0.02, abs=1e-4
    )
    np.testing.assert_allclose(ALLEGRO.wrist_servos[:, 0], [1800.0, 90.0], rtol=1e-4)


def test_labelled_student_moves_like_its_teacher():
    """Whatever its tracker shows, as long as both know the wrist's velocity, which they do here."""
    task = TaskConfig(surface_points=N, constraints=("heading", "affordance", "fingers"))
    tracked = dataclasses.replace(
        task, sensing=dataclasses.replace(task.sensing, position_noise=(0.0, 0.01))
    )
    state, surface, goal = scene(5)
    state = state._replace(u_velocity=0.1 * state.u_velocity)  # as slow as its limits allow
    ahead = evaluated(guided, compiled_scene(task, state, surface, goal), task.control).ahead
    state = state._replace(u=state.u + ahead - 0.004)  # and near its guidance
    off = np.array([[0.004, -0.003, 0.002]], np.float32)
    seen = state._replace(
        object_position=state.object_position + off,
        object_position_initial=state.object_position_initial - off,
    )
    motors = len(HAND.motors)
    action = jnp.asarray(np.random.default_rng(0).normal(0.0, 0.5, (4, motors + 6)), jnp.float32)

    @jax.jit
    def targets(action):
        true = scene_of(HAND, task, state, surface, goal)
        tracked_scene = scene_of(HAND, tracked, seen, surface, goal)
        rows = observe_for_teacher(true, tracked_scene, task.control)
        label = student_action(HAND, task.control, rows, action)
        one, two, copied = (
            decode(s, task.control, a)
            for s, a in ((true, action), (tracked_scene, label), (tracked_scene, action))
        )
        return rows, observe(true), one, two, copied

    rows, full_target, teacher, student, copied = targets(action)
    np.testing.assert_array_equal(rows[:, : -extra(HAND)], full_target)
    np.testing.assert_allclose(student.u_target, teacher.u_target, atol=1e-5)
    np.testing.assert_array_equal(student.q_target, teacher.q_target)
    # What the teacher's residual would have given
    assert np.abs(copied.u_target - teacher.u_target).max() > 1e-3
