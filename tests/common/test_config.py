"""The run's configuration: JSON and back, and the curriculum."""

import dataclasses
import json
import pathlib

import pytest

from congrasp.common.config import CurriculumConfig, run_config_from_json, to_json
from congrasp.common.errors import CongraspError
from congrasp.common.task.config import RewardWeights
from congrasp.services.train.presets import PRESETS, get_preset

CONFIGS = pathlib.Path(__file__).with_name("configs")
"""Configurations as earlier versions wrote them."""


@pytest.mark.parametrize("name", PRESETS)
def test_json_round_trip(name):
    assert run_config_from_json(to_json(get_preset(name))) == get_preset(name)


@pytest.mark.parametrize("file", sorted(CONFIGS.glob("*.json")), ids=lambda file: file.stem)
def test_earlier_configurations_keep_their_batch(file):
    written = json.loads(file.read_text())
    earlier = {**written, **written["ppo"]}  # where they were until they belonged to the run
    config = run_config_from_json(file.read_text())
    assert config.rollouts_per_update == earlier["rollouts_per_update"]
    assert config.max_staleness == earlier["max_staleness"]


@pytest.mark.parametrize("task", [None, 3, [], "task", {"control": None}, {"control": [1]}])
def test_invalid_task_is_refused(task):
    with pytest.raises(CongraspError, match="does not match this version"):
        run_config_from_json(json.dumps({"task": task}))


@pytest.mark.parametrize(
    ("section", "field", "value", "quoted"),
    [
        ("ppo", "clip", "0.1", "'0.1'"),
        ("ppo", "clip", True, "True"),
        ("ppo", "clip", 10**400, "10000"),
        ("ppo", "epochs", True, "True"),
        ("ppo", "epochs", 4.5, "4.5"),
        ("ppo", "decoupled", 1, "not 1"),
        ("ppo", "learning_rate_range", [1e-5, "1e-3"], "'1e-3'"),
        ("ppo", "learning_rate_range", [1e-5, 1e-4, 1e-3], "list of 2 values"),
        ("curriculum", "ramp", [True, 3], "True"),
        ("objects", "families", "mug", "'mug'"),
        ("network", "hidden", {"units": 4}, "{'units': 4}"),
    ],
)
def test_value_of_another_type_is_named(section, field, value, quoted):
    fields = json.loads(to_json(get_preset("quickstart")))
    fields[section][field] = value
    with pytest.raises(CongraspError) as caught:
        run_config_from_json(json.dumps(fields))
    message = str(caught.value)
    assert f"'{section}.{field}' must be" in message
    assert quoted in message
    assert "\n" not in message


def test_weights_follow_the_ramp():
    first = RewardWeights(contact=1.0, heading_position=2.0)
    last = dataclasses.replace(first, heading_position=6.0)
    curriculum = CurriculumConfig(stationary_updates=5, ramp=(10, 20), reward=last)
    assert curriculum.weights(first, 3) == first
    assert curriculum.weights(first, 15).heading_position == pytest.approx(4.0)
    assert curriculum.weights(first, 15).contact == pytest.approx(1.0)
    assert curriculum.weights(first, 100) == last
    assert [curriculum.stationary(version) for version in (4, 5)] == [True, False]
    assert CurriculumConfig(reward=last).weights(first, 100) == first  # no ramp
