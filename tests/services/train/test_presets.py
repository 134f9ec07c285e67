"""Presets: they can be had by name, they travel, and they say how they differ from the full task."""

import dataclasses

import pytest

from congrasp.common.config import run_config_from_json, to_json
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.objects import procedural
from congrasp.services.cli.train import defaults
from congrasp.services.train.presets import PRESETS, easier, get_preset, with_hand


def test_an_unknown_preset_lists_those_that_exist():
    with pytest.raises(CongraspError, match=r"no preset 'nonsense'. Choose one of: .*quickstart.*full.*human"):
        get_preset("nonsense")


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_travels_and_its_batch_can_be_cut(name):
    config = get_preset(name)
    assert config.name == (name if name != "full" else "human") and run_config_from_json(to_json(config)) == config
    get_hand(config.task.hand)
    procedural.family_turns(1, 0, config.objects.families)  # a CongraspError where one is unknown
    transitions = config.environments * config.rollout_steps * config.ppo.rollouts_per_update
    assert transitions % config.ppo.minibatches == 0


def test_the_full_task_is_that_of_the_hand_that_a_command_line_names(claw):
    assert get_preset("full") == get_preset("human") == get_preset("allegro", "human")
    assert get_preset("full", "allegro") == get_preset("allegro") == get_preset("human", "allegro")
    own = defaults(["--preset", "full", "--hand=claw"])["config"]
    assert own == get_preset("full", "claw") and own.name == "claw" and own.task.hand == claw.text
    assert with_hand(own, "claw") == own and easier(own) == []
    for name in ("full", "human", "quickstart"):
        with pytest.raises(CongraspError, match="no hand 'paw'"):
            get_preset(name, "paw")
    quick = get_preset("quickstart")
    task = dataclasses.replace(quick.task, hand="allegro")
    assert get_preset("quickstart", "allegro") == dataclasses.replace(quick, task=task)


def test_what_was_made_easier_is_said_and_nothing_else():
    assert easier(get_preset("human")) == []
    words = easier(get_preset("quickstart"))
    assert "hands approach from above only" in words
    absent = ("affordance", "reference pose", "wrist trajectory", "fingers", "force limit")
    assert f"no episode has another constraint ({', '.join(absent)})" in words
    human = get_preset("human")
    task = dataclasses.replace(human.task, p_trajectory=0.0)
    assert easier(dataclasses.replace(human, task=task)) == ["no episode has another constraint (wrist trajectory)"]
