"""Named configurations to start from; every field can be overridden on the command line."""

import dataclasses
from typing import Any

from common.config import (
    ControlConfig,
    CurriculumConfig,
    NetworkConfig,
    ObjectsConfig,
    PPOConfig,
    RewardWeights,
    RunConfig,
    TaskConfig,
)
from common.errors import CongraspError
from common.hands import get_hand
from common.objects.procedural import PRIMITIVE_FAMILIES

HARD_FAMILIES = ("cross", "compound", "camera", "hammer")
"""Families that the human hand fails most often to hold by a part; twice as many of them are trained on."""
SMOOTH_FAMILIES = ("ellipsoid", "teapot", "mug", "cylinder")
"""Families that Allegro fails most often to hold by a part, likewise."""
ARM = ControlConfig(wrist_acceleration=15.0, wrist_angular_acceleration=150.0)
"""The wrist moves as an arm does."""
CONTACT_TIME = 0.006
"""Seconds; the task's default is what the pretrained policies learnt with."""

PRESETS = {
    # Minutes on two CPU cores; `easier` lists what that takes.
    "quickstart": RunConfig(
        name="quickstart",
        environments=64,
        updates=50,
        physics="native",
        task=TaskConfig(
            headings="above", p_affordance=0.0, p_pose=0.0, p_trajectory=0.0, control=ARM, contact_time=CONTACT_TIME
        ),
        objects=ObjectsConfig(count=16),
        network=NetworkConfig(hidden=(256, 128)),
        ppo=PPOConfig(minibatches=8),
    ),
    # The full task of the paper for the human hand, sized for a GPU. Only primitive objects, as it was tuned with.
    "human": RunConfig(
        name="human",
        environments=4096,
        updates=600,
        task=TaskConfig(
            hold_steps_max=200,
            p_affordance=0.6,
            mass_range=(0.8, 1.25),
            friction_range=(0.8, 1.2),
            control=ARM,
            contact_time=CONTACT_TIME,
        ),
        # Grasps first, then the precision with which constraints are met: with the second weights from the beginning
        # trajectories are not learnt.
        curriculum=CurriculumConfig(
            ramp=(80, 160),
            reward=RewardWeights(
                force=0.8,
                force_excess=0.02,
                object_position=80.0,
                object_rotation=6.0,
                drop=5.0,
                heading_direction=2.5,
                heading_position=12.0,
                pose_finger=0.15,
                pose_link=8.0,
                pose_wrist_position=150.0,
                pose_wrist_rotation=3.0,
                trajectory_position=500.0,
                trajectory_rotation=18.0,
                affordance_distance=0.15,
                affordance_force=0.3,
            ),
        ),
        objects=ObjectsConfig(families=PRIMITIVE_FAMILIES + HARD_FAMILIES, count=800),
        ppo=PPOConfig(rollouts_per_update=1, gamma=0.99),
    ),
}


def _robot(
    hand: str, *, force_max: float, p_affordance: float, objects: ObjectsConfig | None = None, **weights: float
) -> RunConfig:
    """The human preset for another hand; what differs is what docs/training.md found to help it.

    `weights` are those of the reward at the end of the ramp.
    """
    human = PRESETS["human"]
    first, ramp = human.task.reward, human.curriculum
    last = dataclasses.replace(ramp.reward, **{"force_max": force_max, **weights})
    task: dict[str, Any] = {"hand": hand, "p_affordance": p_affordance}
    return dataclasses.replace(
        human,
        name=hand,
        task=dataclasses.replace(human.task, **task, reward=dataclasses.replace(first, **{"force_max": force_max})),
        curriculum=dataclasses.replace(ramp, reward=last),
        objects=objects or human.objects,
    )


# At 1.4 times the size an object weighs 2.7 times as much, at 1.1 times 1.3 times.
PRESETS |= {
    "allegro": _robot(
        "allegro",
        force_max=12.0,
        p_affordance=0.8,
        objects=ObjectsConfig(families=PRIMITIVE_FAMILIES + HARD_FAMILIES + SMOOTH_FAMILIES, count=840),
        heading_position=30.0,
        affordance_distance=0.2,
        affordance_force=0.4,
    ),
    "sharpa": _robot("sharpa", force_max=4.5, p_affordance=0.7, heading_position=16.0),
}


def easier(config: RunConfig) -> list[str]:
    """What makes a run easier than the full task, as phrases; empty if nothing does."""
    task, full = config.task, PRESETS["human"]
    words = []
    if task.headings == "above" and full.task.headings != "above":
        words.append("hands approach from above only")
    odds = {
        "an affordance": task.p_affordance,
        "a reference pose": task.p_pose,
        "a wrist trajectory": task.p_trajectory,
    }
    absent = [name for name, probability in odds.items() if not probability]
    if absent:
        words.append(f"no episode has {' or '.join(absent)}")
    if not config.objects.folder and config.objects.count < full.objects.count:
        words.append(f"an actor has {config.objects.count} objects, not {full.objects.count}")
    if sum(config.network.hidden) < sum(full.network.hidden):
        layers = [" and ".join(map(str, network.hidden)) for network in (config.network, full.network)]
        words.append(f"networks have layers of {layers[0]} units, not {layers[1]}")
    return words


def get_preset(name: str) -> RunConfig:
    """The preset of this name; a CongraspError lists those that exist."""
    if name not in PRESETS:
        raise CongraspError(f"There is no preset '{name}'.", f"Choose one of: {', '.join(PRESETS)}.")
    return PRESETS[name]


def with_hand(config: RunConfig, hand: str | None) -> RunConfig:
    """The configuration with another hand, or its own; a hand's file becomes part of it, for actors elsewhere."""
    found = get_hand(hand or config.task.hand)
    return dataclasses.replace(config, task=dataclasses.replace(config.task, hand=found.reference))
