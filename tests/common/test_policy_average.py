"""Averages of policies, with means worked out by hand."""

import dataclasses

import jax
import numpy as np
import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.average import average
from congrasp.common.policy.bundle import PolicyBundle, without_critic
from congrasp.common.policy.pretrained import packaged_file
from congrasp.services.cli import main
from tests import task

POLICY = task.policy()


def filled(value: float) -> PolicyBundle:
    """The policy with one number in all parameters, and as mean of all observations."""
    params = jax.tree.map(lambda array: np.full_like(array, value), POLICY.params)
    observation = POLICY.observation._replace(
        mean=np.full_like(np.asarray(POLICY.observation.mean), value)
    )
    return dataclasses.replace(POLICY, params=params, observation=observation, version=int(value))


def test_mean_of_three():
    mean = average([filled(8.0), filled(2.0), filled(4.0)], [0.25, 0.5, 0.25])
    for array in jax.tree.leaves((mean.params, mean.observation.mean)):
        np.testing.assert_array_equal(array, 4.0)  # 2 + 1 + 1
    assert mean.params["actor"]["network"]["output"]["kernel"].dtype == np.float32
    assert mean.version == 8  # the first policy's
    assert mean.task == POLICY.task


def test_mean_of_one_policy_acts_as_the_policy():
    assert average([POLICY, POLICY], [0.5, 0.5]).actor_sha256 == POLICY.actor_sha256


def test_mean_has_a_critic_only_if_all_policies_have_one():
    assert average([POLICY, POLICY], [0.5, 0.5]).has_critic
    assert not average([POLICY, without_critic(POLICY)], [0.5, 0.5]).has_critic


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ([0.5, 0.4], "sum of the weights is 0.9"),
        ([1.0], "2 policies and 1 weights"),
    ],
)
def test_weights_must_fit(weights, message):
    with pytest.raises(CongraspError, match=message):
        average([POLICY, POLICY], weights)


def test_policies_of_two_hands_have_no_mean():
    allegro = bundles.load(packaged_file("allegro"))
    with pytest.raises(CongraspError, match=r"'allegro'.*not for hand 'human'"):
        average([bundles.load(packaged_file("human")), allegro], [0.5, 0.5])


def test_command_writes_the_mean_of_a_file_and_a_named_policy(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    human = bundles.load(packaged_file("human"))
    params = jax.tree.map(lambda array: array + np.float32(2.0), human.params)
    bundles.save(dataclasses.replace(human, params=params), tmp_path / "policy.safetensors")
    arguments = [
        "policy.safetensors",
        "human",
        "--weights",
        "0.5",
        "0.5",
        "--out",
        "mean.safetensors",
    ]
    assert main.run(["policies", "average", *arguments]) == 0
    assert "mean.safetensors" in capsys.readouterr().out
    mean = bundles.load(tmp_path / "mean.safetensors")
    for array, expected in zip(
        jax.tree.leaves(mean.params), jax.tree.leaves(human.params), strict=True
    ):
        np.testing.assert_allclose(array, expected + 1.0, atol=1e-5)
