"""Named initial configurations; every field can be overridden on the command line."""

import dataclasses

from congrasp.common.config import NetworkConfig, ObjectsConfig, PPOConfig, RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.task.config import ControlConfig, TaskConfig
from congrasp.common.task.constraints import optional
from congrasp.services.train.recipe import recipe

FULL = "full"
"""Preset of the full task for the hand of the command line, the human hand by default."""
FULL_FOR = ("human", "allegro", "sharpa")
"""Hands whose names are presets equal to `FULL`."""
QUICKSTART = RunConfig(
    name="quickstart",
    environments=64,
    updates=60,
    physics="native",
    task=TaskConfig(
        constraints=("heading",),
        headings="above",
        approach_steps=50,
        back_off_range=(0.15, 0.15),
        initial_speed=0.0,
        # The full task's hands close slowly, which takes several times as many steps to learn.
        control=ControlConfig(approach_position_limit=0.04, closing_position_limit=0.04),
    ),
    objects=ObjectsConfig(count=16),
    network=NetworkConfig(hidden=(256, 128)),
    ppo=PPOConfig(minibatches=8, settling=0.25),
)
"""Takes minutes on two CPU cores; `easier` lists the simplifications."""
CHECK = dataclasses.replace(
    QUICKSTART,
    name="check",
    environments=8,
    rollout_steps=20,
    updates=2,
    objects=ObjectsConfig(count=2),
    network=NetworkConfig(hidden=(16,)),
)
"""Learns nothing: it shows that physics, messages, log, server and pictures of an installation work."""
_SHORT = {run.name: run for run in (QUICKSTART, CHECK)}
PRESETS = (*_SHORT, FULL, *FULL_FOR)
"""Names of the presets."""


def easier(config: RunConfig) -> list[str]:
    """Phrases for the simplifications of a run relative to the full task; empty if there are none."""
    task, full = config.task, get_preset(FULL)
    words = []
    if task.headings == "above" and full.task.headings != "above":
        words.append("hands approach from above only")
    absent = [
        constraint.title
        for constraint in optional(full.task)
        if constraint not in optional(task) or not getattr(task, f"p_{constraint.name}")
    ]
    if absent:
        words.append(f"no episode has another constraint ({', '.join(absent)})")
    if task.control.closing_position_limit > full.task.control.closing_position_limit:
        words.append("hands may close fast")
    if task.approach_steps < full.task.approach_steps:
        words.append(f"the table is removed after {task.approach_steps} control steps, not {full.task.approach_steps}")
    if not config.objects.folder and config.objects.count < full.objects.count:
        words.append(f"an actor has {config.objects.count} objects, not {full.objects.count}")
    if sum(config.network.hidden) < sum(full.network.hidden):
        layers = [" and ".join(map(str, network.hidden)) for network in (config.network, full.network)]
        words.append(f"networks have layers of {layers[0]} units, not {layers[1]}")
    return words


def get_preset(name: str, hand: str | None = None) -> RunConfig:
    """Returns the preset of this name for a hand, or for its default hand.

    Args:
      name: one of `PRESETS`.
      hand: the name, file or text of a hand. A full task depends on the hand (`services.train.recipe`); in the others
        only the hand changes.

    Raises:
      CongraspError: there is no such preset or hand; the message lists the available ones.
    """
    if name not in PRESETS:
        raise CongraspError(f"There is no preset '{name}'.", f"Choose one of: {', '.join(PRESETS)}.")
    if name in _SHORT:
        return with_hand(_SHORT[name], hand)
    return recipe(get_hand(hand or (name if name in FULL_FOR else "human")))


def with_hand(config: RunConfig, hand: str | None) -> RunConfig:
    """Returns the configuration with another hand, or unchanged; a hand's file is included, for remote actors."""
    found = get_hand(hand or config.task.hand)
    return dataclasses.replace(config, task=dataclasses.replace(config.task, hand=found.reference))
