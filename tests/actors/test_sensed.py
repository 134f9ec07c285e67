"""Environments whose policy sees what a robot's sensors show, beside what a teacher sees."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from congrasp.actors.physics.native import NativePhysics
from congrasp.actors.worker import RolloutWorker
from congrasp.common.hands.motors import motor_positions
from congrasp.common.policy.bundle import full_layout
from congrasp.common.task import observation, privileged
from congrasp.common.task.config import SensingConfig, TaskConfig
from congrasp.common.task.privileged import extra
from tests import task as suite
from tests.scenes import evaluated
from tests.task import HAND

OBJECTS = suite.OBJECTS[1:2]
BATCH = 2
DELAY = 3
LATENCY = 2
# A policy that is shown a tracker's poses, in episodes of 20 control steps.
TASK = TaskConfig(
    constraints=("heading",),
    surface_points=64,
    approach_steps=16,
    hold_steps=4,
    hold_steps_max=4,
    history=6,
    observation="tracked",
    sensing=SensingConfig(
        delay=(DELAY * 0.01, DELAY * 0.01), latency=(LATENCY * 0.01, LATENCY * 0.01)
    ),
)


@pytest.fixture(scope="module")
def late():
    """Environments with a tracker and servos that are late, and 18 of an episode's 20 control
    steps.

    The wrist follows its guidance while the fingers close.
    """
    physics = NativePhysics(HAND, TASK, OBJECTS, 1)
    bank = suite.bank_of(1, TASK.surface_points)
    running = RolloutWorker(
        HAND,
        TASK,
        physics,
        bank,
        suite.commanded,
        batch=BATCH,
        seed=0,
        half_precision=False,
        traced="all",
        taught=True,
        privileged=OBJECTS,
    )
    yield running, running.collect(suite.command(fingers=0.8), 18)
    physics.close()


def test_a_late_tracker_shows_the_pose_of_so_many_steps_ago(late):
    running, rollout = late
    readings = running.state.sensing.readings
    trace = rollout.trace
    for age in range(TASK.history):
        now = 17 - age
        np.testing.assert_allclose(readings.q[:, age], trace.q[now], atol=1e-6)
        if age >= LATENCY:  # the trace has the targets that the servos followed
            np.testing.assert_allclose(
                readings.u_target[:, age], trace.u_target[now + LATENCY], atol=1e-6
            )
        np.testing.assert_allclose(
            readings.object_position[:, age], trace.object_position[now - DELAY], atol=1e-6
        )
        np.testing.assert_allclose(
            readings.object_quaternion[:, age], trace.object_quaternion[now - DELAY], atol=1e-6
        )
    seen = running.env.seen(running.state).state
    true = running.env.scene_of(running.state).state
    np.testing.assert_array_equal(true.object_position, trace.object_position[17])
    np.testing.assert_array_equal(seen.object_position, readings.object_position[:, 0])
    assert not np.array_equal(seen.object_position, true.object_position)
    np.testing.assert_array_equal(seen.object_position_initial, true.object_position_initial)
    assert not seen.contact_force.any()


def test_servos_follow_the_target_of_so_many_steps_ago(late):
    """The teacher sees the targets that they follow, the student its newest ones."""
    running, rollout = late
    env = running.env
    state = running.state
    readings = state.sensing.readings
    action = jnp.zeros((BATCH, len(HAND.motors) + 6))
    _, (command, _) = jax.jit(env.targets)(state, action, env.settings)
    np.testing.assert_allclose(command[:, :6], readings.u_target[:, LATENCY - 1], atol=1e-6)
    np.testing.assert_allclose(
        command[:, 6:], motor_positions(HAND, readings.q_target[:, LATENCY - 1]), atol=1e-6
    )
    np.testing.assert_array_equal(env.scene_of(state).state.q_target, readings.q_target[:, LATENCY])
    np.testing.assert_array_equal(env.seen(state).state.q_target, readings.q_target[:, 0])
    moving = np.abs(np.diff(rollout.trace.q_target, axis=0)).max((1, 2))
    # Nothing is followed before it arrives
    assert moving.max() > 0.05
    assert moving[: LATENCY - 1].max() == 0.0


def test_a_teacher_sees_all_beside_a_student(late):
    _, rollout = late
    layouts = (observation.layout(HAND, TASK), full_layout(TASK))
    sizes = [sum(dict(layout).values()) for layout in layouts]
    assert [
        rollout.observation.shape[-1],
        rollout.teacher_observation.shape[-1] - extra(HAND),
    ] == sizes
    start = 0
    for field in observation.fields(HAND, dataclasses.replace(TASK, observation="full"))["state"]:
        part = rollout.teacher_observation[1:, :, start : start + field.size]
        start += field.size
        if field.name == "q":
            np.testing.assert_allclose(part, rollout.trace.q[:-1], atol=1e-6)
        elif field.name == "object_displacement":
            away = np.linalg.norm(rollout.trace.object_position[:-1] - running_start(late), axis=-1)
            np.testing.assert_allclose(np.linalg.norm(part, axis=-1), away, atol=1e-6)


def test_the_critic_sees_the_trackers_and_the_true_state(late):
    running, rollout = late
    names = [name for name, _ in privileged.layout(HAND, TASK)]
    size = sum(size for _, size in privileged.layout(HAND, TASK))
    assert rollout.privileged.shape == (18, BATCH, size)
    assert rollout.last_privileged.shape == (
        BATCH,
        size,
    )
    numbers = dict(zip(names, np.moveaxis(rollout.privileged, -1, 0), strict=False))
    np.testing.assert_array_equal(numbers["delay"], DELAY)
    np.testing.assert_array_equal(numbers["period"], 1.0)
    np.testing.assert_allclose(numbers["mass"], OBJECTS[0].mass, rtol=1e-6)
    # 16 steps of approach, then the hold's four run down.
    np.testing.assert_allclose(numbers["hold_remaining"][:, 0], [1.0] * 17 + [0.75])
    np.testing.assert_array_equal(
        rollout.privileged[..., len(names) - 1 :], rollout.teacher_observation[..., : -extra(HAND)]
    )
    observed = evaluated(observation.observe, running.env.privileged(running.state))
    np.testing.assert_allclose(rollout.last_privileged[:, len(names) - 1 :], observed, atol=1e-6)


def running_start(late):
    """(B, 3) where the objects began."""
    return np.asarray(late[0].state.reset_state.object_position)


def test_a_fresh_episode_begins_with_fresh_readings(late):
    """The last test of `late`: its episodes end after two more control steps."""
    running, _ = late
    rollout = running.collect(suite.command(fingers=0.8), 2)
    assert rollout.terminal[-1].all()
    readings = running.state.sensing.readings
    start = running.state.reset_state
    for age in range(TASK.history):
        np.testing.assert_array_equal(readings.object_position[:, age], start.object_position)
        np.testing.assert_array_equal(readings.q[:, age], start.q)
    np.testing.assert_array_equal(readings.u, 0.0)
