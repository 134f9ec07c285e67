"""Environments whose policy sees a camera's cloud: the true pose of the object is not among its
inputs.
"""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from congrasp.actors.physics.native import NativePhysics
from congrasp.actors.worker import RolloutWorker
from congrasp.common import rotations
from congrasp.common.task import observation, privileged
from congrasp.common.task.config import SensingConfig, TaskConfig
from congrasp.common.task.control import decode
from tests import task as suite
from tests.scenes import evaluated
from tests.task import HAND

OBJECTS = suite.OBJECTS[1:2]
# A policy that is shown a camera's cloud, in episodes of 20 control steps.
TASK = TaskConfig(
    constraints=("heading",),
    surface_points=64,
    approach_steps=16,
    hold_steps=4,
    hold_steps_max=4,
    history=3,
    observation="camera",
    surface_normals=True,
    sensing=SensingConfig(period=(0.05, 0.05)),
)
BATCH = 2


@pytest.fixture(scope="module")
def running():
    """Environments after 18 of an episode's 20 control steps, in which the fingers close."""

    physics = NativePhysics(HAND, TASK, OBJECTS, 1)
    worker = RolloutWorker(
        HAND,
        TASK,
        physics,
        suite.bank_of(1, TASK.surface_points),
        suite.commanded,
        batch=BATCH,
        seed=0,
        half_precision=False,
        traced="all",
        taught=True,
        privileged=OBJECTS,
    )
    return worker, worker.collect(suite.command(fingers=0.8), 18)


def test_the_true_pose_changes_neither_observation_nor_targets(running):
    worker, _ = running
    env = worker.env
    state = worker.state
    physics_state = worker.physics.read(None)
    moved = physics_state._replace(
        object_position=physics_state.object_position + 0.3,
        object_quaternion=jnp.tile(jnp.array([0.0, 0.6, 0.0, 0.8]), (BATCH, 1)),
        object_velocity=physics_state.object_velocity + 1.0,
        contact_force=physics_state.contact_force + 5.0,
    )
    away = state.reset_state._replace(object_position=state.reset_state.object_position + 0.2)
    away = state._replace(reset_state=away)
    camera = state.sensing.sensor
    elsewhere = camera._replace(cloud=camera.cloud._replace(points=camera.cloud.points + 0.01))
    tilted = camera._replace(cloud=camera.cloud._replace(normals=-camera.cloud.normals))

    @jax.jit
    def shown(state, physics_state):
        scene = env.seen(env.with_scene(state, physics_state))
        return observation.observe(scene), decode(
            scene, TASK.control, jnp.ones((BATCH, len(HAND.motors) + 6))
        )

    before, targets = shown(state, physics_state)
    after, others = shown(away, moved)
    np.testing.assert_array_equal(before, after)
    for one, other in zip(targets, others, strict=True):
        np.testing.assert_array_equal(one, other)
    for other, least in ((tilted, 0.1), (elsewhere, 0.009)):
        sensing = state.sensing._replace(sensor=other)
        changed, _ = shown(state._replace(sensing=sensing), physics_state)
        assert np.abs(changed - before).max() > least


def test_the_cloud_is_the_object_s_surface_as_of_the_last_image(running):
    worker, rollout = running
    state = worker.state
    trace = rollout.trace
    points = np.asarray(state.sensing.sensor.cloud.points)
    turn = np.asarray(trace.object_quaternion)
    surface = np.asarray(state.surface.points)
    ages = []
    for age in range(5):  # an image is at most 5 control steps old
        step = len(turn) - 1 - age
        local = rotations.inverse_transform(trace.object_position[step], turn[step], points)
        ages.append(np.linalg.norm(local[:, :, None] - surface[:, None], axis=-1).min(-1).max(-1))
    np.testing.assert_allclose(np.min(ages, 0), 0.0, atol=1e-5)
    scene = worker.env.seen(state)
    np.testing.assert_array_equal(scene.state.object_position, 0.0)
    observation_vector = evaluated(observation.observe, scene)
    start = sum(size for name, size in observation.layout(HAND, TASK)[:1])
    block = np.asarray(observation_vector[:, start : start + 4 * 64]).reshape(BATCH, 64, 4)
    features = scene.features
    expected = rotations.inverse_transform(
        features.wrist_position, features.wrist_quaternion, points
    )
    np.testing.assert_allclose(block[..., :3], expected, atol=1e-6)
    assert not block[..., 3].any()


def test_teacher_and_critic_see_the_true_state(running):
    _, rollout = running
    full = dataclasses.replace(TASK, observation="full")
    size = sum(size for _, size in observation.layout(HAND, full))
    names = [name for name, _ in observation.layout(HAND, full)]
    assert "cloud" not in names
    assert rollout.teacher_observation.shape[-1] > size
    assert rollout.privileged.shape[-1] == sum(size for _, size in privileged.layout(HAND, TASK))
    fields = itertools.chain.from_iterable(observation.fields(HAND, TASK).values())
    described = {field.name for field in fields}
    assert (
        not {"object_displacement", "object_rotation", "past object_position", "force"} & described
    )
