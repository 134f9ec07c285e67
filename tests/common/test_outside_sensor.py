"""A sensor that only `own_sensor.py` and its row know: episodes, training, serving and command lines
use it as those of the project.
"""

import dataclasses

import numpy as np
import pytest

from congrasp.actors.physics.native import NativePhysics
from congrasp.actors.worker import RolloutWorker
from congrasp.common.config import NetworkConfig, PPOConfig, RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.policy.bundle import policy_spec
from congrasp.common.request import GraspRequest
from congrasp.common.task import observation
from congrasp.common.task.config import SensingConfig, TaskConfig
from congrasp.common.task.sensors import SENSORS, get_sensor
from congrasp.learner.algorithms.ppo import PPO
from congrasp.learner.algorithms.protocol import collate
from congrasp.learner.hub.task_ranges import task_ranges
from congrasp.services.serve.inference import LocalPolicy
from congrasp.services.train.command import untrained
from tests import task as suite
from tests.common.own_sensor import SWITCH_FORCE_N, Tactile
from tests.task import HAND

OBJECTS = suite.OBJECTS[1:2]
BATCH = 2
STEPS = 20
TASK = TaskConfig(
    constraints=("heading",),
    surface_points=64,
    approach_steps=16,
    hold_steps=4,
    hold_steps_max=4,
    back_off_range=(0.01, 0.01),
    preshape_margin=(0.0, 0.0),
    history=3,
    observation="tactile",
    sensing=SensingConfig(delay=(0.02, 0.02)),
)
RUN = RunConfig(task=TASK, network=NetworkConfig(hidden=(16,), encoder=4))


@pytest.fixture(scope="module", autouse=True)
def registered():
    """Its row, during these tests."""
    SENSORS["tactile"] = Tactile()
    yield
    del SENSORS["tactile"]


@pytest.fixture(scope="module")
def episode(registered):
    """Environments at the start, their initial state, and an episode in which the fingers close."""
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
        privileged=OBJECTS,
    )
    first = worker.state
    yield first, worker.collect(suite.command(fingers=0.8), STEPS)
    physics.close()


def switches_of(rows):
    """The part of observations (..., D) that only this sensor has."""
    start = 0
    for block in observation.fields(HAND, TASK).values():
        for field in block:
            if field.name == "switches":
                return np.asarray(rows)[..., start : start + field.size]
            start += field.size
    raise AssertionError


def test_outside_sensor_is_observed_in_an_episode(episode):
    _, rollout = episode
    assert np.asarray(rollout.has_episode).all()
    force = np.linalg.norm(rollout.trace.contact_force, axis=-1)
    switches = switches_of(rollout.observation)
    assert not switches[0].any()
    np.testing.assert_array_equal(switches[1:], force[:-1] > SWITCH_FORCE_N)
    assert switches.any()


def test_outside_sensor_is_trained_with(episode):
    _, rollout = episode
    algorithm = PPO(policy_spec(TASK, RUN.network), PPOConfig(epochs=1, minibatches=1))
    before = algorithm.init(0)
    weights = np.array(before.params["actor"]["network"]["trunk_0"]["kernel"])
    batch = collate([rollout._asdict()], algorithm.batch_schema)
    after, metrics = algorithm.update(before, batch)
    assert after.version == 1
    assert all(np.isfinite(value) for value in metrics.values())
    changed = np.any(after.params["actor"]["network"]["trunk_0"]["kernel"] != weights, 1)
    size = dict(observation.layout(HAND, TASK))["state"]
    switches = changed[size - len(HAND.links) : size]
    np.testing.assert_array_equal(switches, switches_of(rollout.observation).any((0, 1)))


def test_outside_sensor_is_within_the_ranges_of_admission(episode):
    _, rollout = episode
    ranges = task_ranges(TASK, RUN.curriculum)
    assert (np.abs(rollout.observation) <= ranges.observation).all()
    assert (np.abs(rollout.privileged) <= ranges.privileged).all()


def test_outside_sensor_is_a_field_of_queries(episode):
    """Switches change the answer, and those of an unknown name are refused."""
    first, _ = episode
    start = first.reset_state
    heading = first.goal["heading"]
    policy = LocalPolicy(untrained(RUN))
    request = GraspRequest(
        {"heading": {name: np.asarray(rows[0]) for name, rows in heading._asdict().items()}},
        surface=np.asarray(first.surface.points[0]),
        q=np.asarray(start.q[0]),
        wrist=(np.asarray(start.base_position[0]), np.asarray(start.base_quaternion[0])),
        object_pose=(np.asarray(start.object_position[0]), np.asarray(start.object_quaternion[0])),
    )
    policy.reset(request)
    state = {
        "q": request.q,
        "u": np.zeros(6),
        "object_position": request.object_pose[0],
        "object_quaternion": request.object_pose[1],
    }
    assert policy.metadata()["observation"] == "tactile"
    closed = {**state, "touching": np.ones(len(HAND.links))}
    opened, pressed = policy.act_each([state, closed])
    assert np.abs(opened.action - pressed.action).max() > 1e-6
    with pytest.raises(CongraspError, match="pressing"):
        policy.act({**state, "pressing": np.ones(len(HAND.links))})


def test_outside_sensor_is_named_by_errors():
    assert get_sensor(TASK) is SENSORS["tactile"]
    with pytest.raises(CongraspError, match="full, tracked, camera, tactile"):
        get_sensor(dataclasses.replace(TASK, observation="sonar"))
