"""Presets: they can be had by name, they travel, and they say how they differ from the full task."""

import dataclasses

import pytest

from common.config import run_config_from_json, to_json
from common.errors import CongraspError
from common.hands import get_hand
from services.train.presets import PRESETS, easier, get_preset, with_hand


def test_an_unknown_preset_lists_those_that_exist():
    with pytest.raises(CongraspError, match=r"no preset 'nonsense'. Choose one of: .*quickstart.*human"):
        get_preset("nonsense")


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_travels_and_its_batch_can_be_cut(name):
    config = get_preset(name)
    assert config.name == name and run_config_from_json(to_json(config)) == config
    get_hand(config.task.hand)
    transitions = config.environments * config.rollout_steps * config.ppo.rollouts_per_update
    assert transitions >= config.ppo.minibatches
    # Rollouts hold whole episodes, or success could not be counted from the first of them on.
    assert config.rollout_steps >= config.task.approach_steps + config.task.hold_steps


def test_other_hands_are_trained_by_the_recipe_of_the_human_hand():
    human = get_preset("human")
    for name, scale in (("allegro", 1.4), ("sharpa", 1.1)):
        config = get_preset(name)
        assert get_hand(config.task.hand).object_scale == scale and easier(config) == []
        assert config.ppo == human.ppo and config.curriculum.ramp == human.curriculum.ramp
        assert config.task.reward.force_max == config.curriculum.reward.force_max
    assert with_hand(human, "allegro").task == dataclasses.replace(human.task, hand="allegro")
    with pytest.raises(CongraspError, match="no hand 'paw'"):
        with_hand(human, "paw")


def test_what_was_made_easier_is_said_and_nothing_else():
    assert easier(get_preset("human")) == []
    words = easier(get_preset("quickstart"))
    assert "hands approach from above only" in words
    assert "no episode has an affordance or a reference pose or a wrist trajectory" in words
    human = get_preset("human")
    task = dataclasses.replace(human.task, p_trajectory=0.0)
    assert easier(dataclasses.replace(human, task=task)) == ["no episode has a wrist trajectory"]
