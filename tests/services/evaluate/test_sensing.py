"""The table of what sensors and servos do to a policy: its levels, and that its rows have the same episodes."""

import dataclasses
import math
from unittest import mock

import jax
import numpy as np
import pytest

from congrasp.common.task import sensing
from congrasp.common.task.config import TaskConfig
from congrasp.services.evaluate import evaluator as evaluation
from congrasp.services.evaluate.evaluator import Evaluator
from congrasp.services.evaluate.protocol import protocol
from congrasp.services.evaluate.sensing import LEVELS, at_level, sensing_task
from congrasp.services.train.command import untrained
from congrasp.services.train.presets import TRACKERS
from tests import draws, task

OBJECTS = task.OBJECTS[:1]
TASK = TaskConfig(constraints=("heading",))
"""Nothing of the other constraints has a level."""


@pytest.fixture(scope="module")
def bank():
    return jax.tree.map(lambda array: np.asarray(array)[:1], task.bank())


def test_a_level_is_what_it_says(bank):
    """At 10 ms a step: 60 ms are 6 steps, 30 Hz a sample every 10/3 steps, and no rate is more than one a step."""
    sensed = sensing_task(TASK)
    drawn = draws.sample(task.HAND, sensed, bank, jax.random.key(0), 4)
    found = {level.label: jax.device_get(at_level(drawn, level, 0.01)) for level in LEVELS}
    assert len(found) == len(LEVELS)
    true, nominal = (found[level.label] for level in LEVELS[:2])
    errors = set(true.sensors._fields) - {"key", "period", "phase", "eye"}
    assert not any(np.any(getattr(true.sensors, name)) for name in errors) and (true.sensors.period == 1.0).all()
    assert (nominal.sensors.delay == 6).all() and nominal.sensors.delay.dtype == np.int32
    np.testing.assert_allclose(nominal.sensors.period, 10 / 3, rtol=1e-6)
    np.testing.assert_allclose(nominal.sensors.position_noise, 0.005)
    np.testing.assert_allclose(nominal.sensors.rotation_noise, math.pi / 60, rtol=1e-6)
    assert (found["100 ms"].sensors.delay == 10).all()
    assert sensing.longest(sensed.sensing, sensed.control_dt) == 11, "room for the longest delay"
    np.testing.assert_allclose(found["10 Hz"].sensors.period, 10.0)
    np.testing.assert_allclose(found["30 % dropped"].sensors.dropout, 0.3)
    np.testing.assert_allclose(found["friction 0.5"].reset_state.friction, 0.5)
    np.testing.assert_allclose(found["gains -20 %"].reset_state.gain_scale, 0.8)
    for level in LEVELS[2:]:
        changed = [
            name
            for part in ("sensors", "reset_state")
            for name, a, b in zip(
                getattr(nominal, part)._fields, getattr(nominal, part), getattr(found[level.label], part), strict=True
            )
            if not np.array_equal(a, b)
        ]
        assert len(changed) == (2 if "noise" in level.label or "6\N{DEGREE SIGN}" in level.label else 1), level.label


def test_other_tables_have_a_perfect_tracker_and_nominal_gains():
    ranged = dataclasses.replace(TASK, observation="tracked", sensing=TRACKERS, gain_range=(0.8, 1.2))
    found = protocol(ranged, 25)
    assert found.sensing == TaskConfig().sensing and found.gain_range == (1.0, 1.0)
    assert found.observation == "tracked" and found.sensed and not TASK.sensed and sensing_task(TASK).sensed


def test_all_rows_have_the_same_episodes(bank, monkeypatch):
    policy = untrained(dataclasses.replace(task.CONFIG, task=TASK))
    evaluator, seen, told = Evaluator(policy, OBJECTS, bank=bank), [], []

    class Running:
        batch = 4
        stressable = True

        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

        def run(self, begun, stressed):
            assert stressed
            seen.append(jax.device_get(begun))
            return mock.Mock()

    monkeypatch.setattr(evaluator, "_episodes", lambda episodes, task: Running())
    monkeypatch.setattr(evaluation, "joined", lambda samples: None)
    row = lambda constraint, sample, group: mock.Mock(constraint=constraint, group=group, episodes=4)  # noqa: E731
    monkeypatch.setattr(evaluator, "row", row)
    rows = evaluator.rows_under_sensing(told.append, 4)
    assert [(row.constraint, row.group) for row in rows] == [("heading", level.label) for level in LEVELS]
    assert told == [4 * (i + 1) for i in range(len(LEVELS))]
    for begun in seen:
        for name in ("q", "object_position", "mass_scale", "base_position"):
            np.testing.assert_array_equal(getattr(begun.reset_state, name), getattr(seen[0].reset_state, name))
        np.testing.assert_array_equal(begun.sensors.key, seen[0].sensors.key)
