"""Presets: they can be had by name, they travel, and they say how they differ from the full
task.
"""

import dataclasses

import pytest

from congrasp.common.config import run_config_from_json, to_json
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.motors import fitting_scale, tip_forces
from congrasp.common.objects import procedural
from congrasp.services.cli.train import defaults
from congrasp.services.train.presets import (
    PRESETS,
    Rules,
    easier,
    get_preset,
    recipe,
    rules,
    with_hand,
)


def test_an_unknown_preset_lists_those_that_exist():
    with pytest.raises(
        CongraspError, match=r"no preset 'nonsense'. Choose one of: .*quickstart.*full.*human"
    ):
        get_preset("nonsense")


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_travels_and_its_batch_can_be_cut(name):
    config = get_preset(name)
    assert config.name == (name if name != "full" else "human")
    assert run_config_from_json(to_json(config)) == config
    get_hand(config.task.hand)
    procedural.family_turns(1, 0, config.objects.families)  # a CongraspError where one is unknown
    transitions = config.environments * config.rollout_steps * config.rollouts_per_update
    assert transitions % config.ppo.minibatches == 0


def test_the_full_task_is_that_of_the_hand_that_a_command_line_names(claw):
    assert get_preset("full") == get_preset("human") == get_preset("allegro", "human")
    assert get_preset("full", "allegro") == get_preset("allegro") == get_preset("human", "allegro")
    config = defaults(["--preset", "full", "--hand=claw"])["config"]
    assert config == get_preset("full", "claw")
    assert config.name == "claw"
    assert config.task.hand == claw.text
    assert with_hand(config, "claw") == config
    assert easier(config) == []
    for name in ("full", "human", "quickstart"):
        with pytest.raises(CongraspError, match="no hand 'paw'"):
            get_preset(name, "paw")
    quick = get_preset("quickstart")
    task = dataclasses.replace(quick.task, hand="allegro")
    assert get_preset("quickstart", "allegro") == dataclasses.replace(quick, task=task)


def test_easier_settings_alone_are_listed():
    assert easier(get_preset("human")) == []
    words = easier(get_preset("quickstart"))
    assert {"hands approach from above only", "friction is soft"} <= set(words)
    absent = ("affordance", "reference pose", "wrist trajectory", "fingers", "force limit")
    assert f"no episode has another constraint ({', '.join(absent)})" in words
    human = get_preset("human")
    task = dataclasses.replace(human.task, p_trajectory=0.0)
    assert easier(dataclasses.replace(human, task=task)) == [
        "no episode has another constraint (wrist trajectory)"
    ]


RULES = {
    # By hand: k = s^2 5/G is 1, 1.96 x 5/4 = 2.45 and 1.21.
    "human": Rules(5.0, 12.0, 0.15, 0.30, 0.60),
    "allegro": Rules(12.0, 29.0, 0.20, 0.40, 0.80),
    "sharpa": Rules(6.0, 15.0, 0.16, 0.32, 0.64),
}


@pytest.mark.parametrize("name", RULES)
def test_hands_of_the_package_follow_the_rules(name):
    hand = get_hand(name)
    assert rules(hand) == RULES[name]
    assert fitting_scale(grasp_frame(hand).opening) == hand.object_scale


@pytest.mark.parametrize("name", RULES)
def test_hands_differ_in_what_has_a_rule_and_in_nothing_else(name):
    config = recipe(get_hand(name))
    human = recipe(get_hand("human"))
    ruled = dataclasses.asdict(rules(get_hand(name)))
    share = ruled.pop("p_affordance")
    weights = dataclasses.replace(human.curriculum.reward, **ruled)
    assert config.curriculum == dataclasses.replace(human.curriculum, reward=weights)
    assert config.task.reward == dataclasses.replace(
        human.task.reward, force_max=ruled["force_max"]
    )
    task = dataclasses.replace(
        human.task, hand=name, reward=config.task.reward, **{"p_affordance": share}
    )
    assert config == dataclasses.replace(human, name=name, task=task, curriculum=config.curriculum)


def with_torques(hand, factor):
    """A hand whose torque limits are `factor` times as large."""
    links = []
    for link in hand.links:
        joints = [
            dataclasses.replace(joint, torque_limit=factor * joint.torque_limit)
            for joint in link.joints
        ]
        links.append(dataclasses.replace(link, joints=tuple(joints)))
    return dataclasses.replace(hand, links=tuple(links))


def test_a_fingertip_presses_with_the_torque_of_the_weakest_joint_over_its_lever():
    # Allegro's straight finger: the second joint is 119 mm from the tip, its 0.7 N.m make 5.9 N
    # there, less than the next ones' on shorter levers; the thumb's first joint is 151 mm from its
    # tip and makes 4.6 N.
    allegro = get_hand("allegro")
    assert tip_forces(allegro) == pytest.approx([0.7 / 0.151, *3 * [0.7 / 0.119]], rel=0.01)
    assert tip_forces(with_torques(allegro, 2.0)) == pytest.approx(2 * tip_forces(allegro))


def test_weaker_hands_train_more_on_parts_and_strong_ones_as_the_human_hand():
    allegro = get_hand("allegro")

    configs = [rules(with_torques(allegro, factor)) for factor in (0.5, 1, 4, 20)]
    assert [one.p_affordance for one in configs] == sorted(
        (one.p_affordance for one in configs), reverse=True
    )
    assert configs[0].p_affordance == 0.8
    assert configs[-1].p_affordance == 0.6
    assert len({one.force_max for one in configs}) == 1
