"""The teacher's targets in the terms of a student, by numbers worked out here and through both controllers."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from congrasp.common.hands import get_hand
from congrasp.common.task.config import ControlConfig, TaskConfig
from congrasp.common.task.control import decode, guided
from congrasp.common.task.features import scene_of
from congrasp.common.task.observation import observe
from congrasp.common.task.privileged import extra, observe_for_teacher, student_action
from tests.scenes import HAND, N, evaluated, scene
from tests.scenes import scene_of as compiled_scene

ALLEGRO = get_hand("allegro")


_student_action = jax.jit(functools.partial(student_action, ALLEGRO, ControlConfig()))


def label(teacher, ahead, limit, velocity, table, own):
    """The student's slide along x, in units of action, where all is along x."""

    def along(x):
        return [x, 0, 0, 0, 0, 0]

    lag = np.append(-0.05, np.zeros(15))  # the first finger joint's servo follows a target of before
    rows = np.array([*along(ahead), limit, *along(velocity), table, *along(own), *lag], np.float32)
    assert len(rows) == extra(ALLEGRO)
    action = np.append(np.full(16, 0.3), along(teacher)).astype(np.float32)
    found = np.asarray(_student_action(rows, action))
    np.testing.assert_allclose(found[:16], action[:16] + lag / 0.1, atol=1e-6)  # alpha_f = 0.1 rad
    np.testing.assert_allclose(found[17:], 0.0, atol=1e-6)
    return found[16]


def test_a_label_is_the_way_from_the_student_s_guidance_to_the_teacher_s_target():
    """alpha_w = 0.02 m; 15 m/s^2 allow a lead of 15 / 1800 m = 8.33 mm beyond v / 20."""
    assert label(0.2, 0.001, 0.04, 0.0, 1.0, 0.0) == pytest.approx((0.001 + 0.004) / 0.02, abs=1e-5)
    # The tracker is 3 mm off: the student's guidance is 4 mm ahead, and the target is where it was.
    assert label(0.2, 0.001, 0.04, 0.0, 1.0, 0.004) == pytest.approx((0.005 - 0.004) / 0.02, abs=1e-5)
    assert label(0.0, 0.03, 0.04, 0.0, 1.0, 0.03) == pytest.approx((15 / 1800 - 0.03) / 0.02, abs=1e-4)
    # At 0.1 m/s the target is 5 mm ahead at least to keep the speed: 5 mm and a third of 8.33 mm without the table.
    assert label(0.0, 0.03, 0.04, 0.1, 0.0, 0.01) == pytest.approx((0.005 + 5 / 1800 - 0.01) / 0.02, abs=1e-4)
    np.testing.assert_allclose(ALLEGRO.wrist_servos[:, 0], [1800.0, 90.0], rtol=1e-4)


def test_with_its_label_a_student_gives_the_wrist_the_teacher_s_target():
    """Whatever its tracker shows, as long as both know the wrist's velocity, which they do here."""
    task = TaskConfig(surface_points=N, constraints=("heading", "affordance", "fingers"))
    tracked = dataclasses.replace(task, sensing=dataclasses.replace(task.sensing, position_noise=(0.0, 0.01)))
    state, surface, goal = scene(5)
    state = state._replace(u_velocity=0.1 * state.u_velocity)  # as slow as its limits allow
    ahead = evaluated(guided, compiled_scene(task, state, surface, goal), task.control).ahead
    state = state._replace(u=state.u + ahead - 0.004)  # and near its guidance
    off = np.array([[0.004, -0.003, 0.002]], np.float32)
    seen = state._replace(
        object_position=state.object_position + off, object_position_initial=state.object_position_initial - off
    )
    motors = len(HAND.motors)
    action = jnp.asarray(np.random.default_rng(0).normal(0.0, 0.5, (4, motors + 6)), jnp.float32)

    @jax.jit
    def targets(action):
        true, shown = scene_of(HAND, task, state, surface, goal), scene_of(HAND, tracked, seen, surface, goal)
        rows = observe_for_teacher(true, shown, task.control)
        own = student_action(HAND, task.control, rows, action)
        one, two, copied = (decode(s, task.control, a) for s, a in ((true, action), (shown, own), (shown, action)))
        return rows, observe(true), one, two, copied

    rows, whole, teacher, student, copied = targets(action)
    np.testing.assert_array_equal(rows[:, : -extra(HAND)], whole)
    np.testing.assert_allclose(student.u_target, teacher.u_target, atol=1e-5)
    np.testing.assert_array_equal(student.q_target, teacher.q_target)
    assert np.abs(copied.u_target - teacher.u_target).max() > 1e-3  # what the teacher's residual would have given
