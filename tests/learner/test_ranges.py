"""Ranges of a task: wide enough for whatever an engine produces, narrow enough to be worth a
check.
"""

import dataclasses

import jax
import numpy as np
import pytest

from congrasp.actors.rollout import finished_episodes
from congrasp.common.config import CurriculumConfig
from congrasp.common.errors import CongraspError
from congrasp.common.task.config import RewardWeights, TaskConfig
from congrasp.common.task.constraints import PAPER
from congrasp.common.task.metrics import episode_fields
from congrasp.common.task.reward import terms
from congrasp.common.wire.codec import Message
from congrasp.common.wire.messages import RECORDED
from congrasp.learner.hub.admission import Admission
from congrasp.learner.hub.task_ranges import task_ranges
from tests import task as suite

TASK = TaskConfig(
    constraints=PAPER, surface_points=32, trajectory_points=4, approach_steps=50, hold_steps_max=40
)


def _rollouts(*spreads):
    """Rollouts of one step each of the native engine, of whole episodes, whose actions have these
    deviations.
    """
    worker = suite.worker()
    masses = np.array([obj.mass for obj in suite.OBJECTS], np.float32)
    privileged = jax.jit(worker.env.critic_inputs)
    for spread in spreads:
        each = 0.5 * np.log(2 * np.pi) + np.log(spread)  # of one entry of an action, in nats
        for _ in range(suite.TASK.approach_steps + suite.TASK.hold_steps):
            rollout = worker.collect(suite.command(noise=spread), 1)
            arrays = {name: np.asarray(getattr(rollout, name)) for name in RECORDED}
            arrays["log_probability"] = arrays["log_probability"] - np.float32(
                each * rollout.action.shape[-1]
            )
            arrays["privileged"] = np.asarray(privileged(worker.state, masses))[None]
            yield Message(arrays | finished_episodes(rollout, suite.TASK))
    worker.physics.close()


def test_engine_output_is_within_the_ranges():
    """Actions of three units make hands beat about, and of 30 throw objects away."""
    ranges = task_ranges(suite.TASK, CurriculumConfig())
    ended = 0
    admission = Admission(lambda: ranges)
    for rollout in _rollouts(0.3, 3.0, 30.0):
        admission.check(rollout)
        ended += len(rollout.arrays["episode/return"])
    assert ended == 3 * suite.BATCH
    for name, array in (
        ("reward", rollout.arrays["reward"] * np.float32(1e15)),
        ("privileged", np.full((1, 1), 3e3)),
    ):
        with pytest.raises(CongraspError, match=f"'{name}.*holds"):
            admission.check(Message({**rollout.arrays, name: array.astype(np.float32)}))


@pytest.fixture(scope="module")
def ranges():
    return task_ranges(TASK, CurriculumConfig())


def test_names_and_bounds_follow_from_the_task(ranges):
    assert set(ranges.episodes) == set(episode_fields(TASK))
    assert (
        ranges.episodes["episode/success"]
        == ranges.episodes["episode/mask_trajectory"]
        == (0.0, 1.0)
    )
    assert ranges.episodes["episode/length"] == (0.0, 90.0)
    # An action's contact earns at most 1, everywhere, and is given twice the room: 90 steps of 2.
    assert ranges.episodes["term/contact"][1] == pytest.approx(180.0, rel=1e-3)
    assert ranges.episodes["term/drop"] == (-180.0, 180.0)
    assert 30.0 < ranges.reward < 300.0
    assert ranges.observation.max() < 1500.0
    assert np.isfinite(ranges.observation).all()


def test_a_curriculum_widens_the_reward_by_its_weights(ranges):
    heavy = CurriculumConfig(ramp=(0, 10), reward=RewardWeights(contact=11.0))
    assert task_ranges(TASK, heavy).reward == pytest.approx(ranges.reward + 2.0 * 10.0, rel=1e-3)


@pytest.mark.parametrize("hand", ["human", "allegro", "sharpa"])
def test_every_weighted_term_has_a_range(hand):
    """Also terms that only idle fingers earn, in a hand without coupled joints."""
    names = [field.name for field in dataclasses.fields(RewardWeights)]
    weights = RewardWeights(**{**dict.fromkeys(names, 1.0), "force_max": 5.0})
    task = dataclasses.replace(TASK, hand=hand, reward=weights)
    ranges = task_ranges(task, CurriculumConfig(ramp=(0, 0))).episodes
    unreachable = [name for name in terms(task) if not ranges[f"term/{name}"][1] > 0.0]
    assert unreachable == []
