"""A policy in this process that observes normals: given ones count, missing ones are estimated from the points."""

import dataclasses

import numpy as np
import pytest

from congrasp.common.config import NetworkConfig, RunConfig
from congrasp.common.objects import procedural
from congrasp.common.task.config import TaskConfig
from congrasp.services.serve.local import LocalPolicy
from congrasp.services.train.command import untrained

TASK = TaskConfig(constraints=("heading",), surface_normals=True)  # the suite's policy observes no normals


@pytest.fixture(scope="module")
def policy():
    return LocalPolicy(untrained(RunConfig(task=TASK, network=NetworkConfig(hidden=(16,), encoder=4))))


def _actions(policy, request, states):
    policy.reset(request)
    return [np.asarray(policy.act(state).action) for state in states]


def test_normals_of_an_episode_are_those_of_its_points(policy, example):
    """Named and packed queries alike, and new points of a state are not given the first ones' normals."""
    episode, obj = example, procedural.generate(1_000_000)
    place = np.linalg.norm(obj.points[:, None] - episode.request.surface, axis=-1).argmin(0)
    exact = dataclasses.replace(episode.request, normals=obj.normals[place].astype(np.float32))
    states = [episode.state, episode.state]
    first, second = _actions(policy, exact, states)
    estimated, packed = _actions(policy, episode.request, states)
    flipped, _ = _actions(policy, dataclasses.replace(exact, normals=-exact.normals), states)
    assert np.abs(first - flipped).max() > 2 * np.abs(first - estimated).max() > 0
    again = {**episode.state, "surface_points": episode.request.surface}
    _, anew = _actions(policy, exact, [episode.state, again])
    np.testing.assert_allclose(anew, packed, atol=1e-4)
    assert np.abs(anew - second).max() > 1e-4
