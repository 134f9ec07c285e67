"""Named configurations: the full task for any hand, and short runs.

Differences between hands in the recipe of the full task are computed from the hand.

Three properties of a hand matter. Its size determines the factor s on the size of its objects
(`Hand.object_scale`: the paper's value for the paper's hands, `common.hands.motors.fitting_scale`
for others). Its strength F is the mean force with which its fingertips can press
(`common.hands.motors.tip_forces`: torque limits over lengths). G is the number of its fingers. Its
mass has no effect, because the gains of the virtual wrist are scaled to the mass
(`common.hands.spec.wrist_gains`).

* **Squeeze** k = s^2 5 / G. The fingers together may exert the same pressure on the object as the
  five fingers of the human hand. Their total force therefore grows with the object's surface, s^2,
  and each finger presses more if there are fewer fingers.
* `force_max` = 5 N k, rounded to half a newton: 5 N (human), 12 N (Allegro), 6 N (Sharpa).
* `heading_position` = 12 k: 12, 29, 15. The hand's centre is the mean of its fingertips. That its
  position needs a higher weight in larger hands with fewer fingers is an empirical finding.
* **Weakness** h = (force_max / F - 0.3) / 0.7, between 0 and 1. It is 0 for fingertips that can
  press with three times the required force, such as human ones, and 1 for fingertips that cannot
  press with the required force (Allegro). Weak hands often drop objects that they may hold by one
  part only, so they train affordances more: `p_affordance` = 0.6 + 0.2 h. Because they then touch
  the avoid region more often, `affordance_distance` = 0.15 + 0.05 h and `affordance_force` = 0.30 +
  0.10 h.

Everything else is the same for all hands.
"""

import dataclasses
from typing import Any

from congrasp.common.config import (
    CurriculumConfig,
    NetworkConfig,
    ObjectsConfig,
    PPOConfig,
    RunConfig,
)
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.motors import tip_forces
from congrasp.common.hands.spec import Hand
from congrasp.common.task.config import ControlConfig, RewardWeights, TaskConfig
from congrasp.common.task.constraints import optional

FULL = "full"
"""Preset of the full task for the hand of the command line, the human hand by default."""
FULL_FOR = ("human", "allegro", "sharpa")
"""Hands whose names are presets equal to `FULL`."""
HARD_FAMILIES = ("cross", "compound", "camera", "hammer")
"""Families that are hardest to hold by a part, included twice in training."""
_FORCE = 5.0
"""`force_max` of the human hand, N."""
_HEADING = 12.0
"""Weight `heading_position` of the human hand."""
_AFFORDANCE = 0.6
"""Share of the human hand's episodes with an affordance."""
_STRONG = 0.3
"""Share of its fingertips' strength that the task requires of a strong hand."""


@dataclasses.dataclass(frozen=True)
class Rules:
    """Settings of the recipe that depend on the hand."""

    force_max: float
    """f_max of a link, N."""
    heading_position: float
    """Weight at the end of the ramp, like the following two."""
    affordance_distance: float
    affordance_force: float
    p_affordance: float
    """Probability that an episode has an affordance."""


def rules(hand: Hand) -> Rules:
    """Computes the recipe's rules (see the module) for a hand."""
    squeeze = hand.object_scale**2 * 5 / len(hand.tip_links)
    force_max = max(round(2 * _FORCE * squeeze), 1) / 2
    weakness = min(
        max((force_max / float(tip_forces(hand).mean()) - _STRONG) / (1 - _STRONG), 0.0), 1.0
    )
    return Rules(
        force_max=force_max,
        heading_position=float(max(round(_HEADING * squeeze), 1)),
        affordance_distance=round(0.15 + 0.05 * weakness, 2),
        affordance_force=round(0.3 + 0.1 * weakness, 2),
        p_affordance=round(_AFFORDANCE + 0.2 * weakness, 2),
    )


def recipe(hand: Hand) -> RunConfig:
    """Returns the paper's full task for a hand, sized for a GPU."""
    of_hand = rules(hand)
    return RunConfig(
        name=hand.name,
        environments=32_768,
        rollout_steps=10,
        updates=800,
        task=TaskConfig(
            hand=hand.reference,
            p_affordance=of_hand.p_affordance,
            p_pose=0.35,
            p_trajectory=0.35,
            p_fingers=0.2,
            p_force=0.25,
            # Trajectory and affordance in 15 % of the episodes (Allegro: 17), without
            # it in 8 (9)
            p_together=0.45,
            hold_steps_max=200,
            surface_normals=True,
            disturbed_references=0.5,
            mass_range=(0.6, 2.4),
            friction_range=(0.6, 1.2),
            reward=RewardWeights(force_max=of_hand.force_max),
        ),
        # Grasps first, then the precision of constraints: with the second weights from the
        # beginning, trajectories are not learnt.
        curriculum=CurriculumConfig(
            ramp=(80, 160),
            reward=RewardWeights(
                force=0.8,
                force_max=of_hand.force_max,
                force_excess=0.02,
                object_position=80.0,
                object_rotation=6.0,
                drop=5.0,
                heading_direction=2.5,
                heading_position=of_hand.heading_position,
                pose_finger=0.15,
                pose_link=8.0,
                pose_wrist_position=150.0,
                pose_wrist_rotation=3.0,
                trajectory_position=500.0,
                trajectory_rotation=18.0,
                affordance_distance=of_hand.affordance_distance,
                affordance_force=of_hand.affordance_force,
            ),
        ),
        objects=ObjectsConfig(
            families=("all", "scans", *HARD_FAMILIES), count=1600, by_failure=True
        ),
        rollouts_per_update=1,
        ppo=PPOConfig(gamma=0.99, settling=0.25, least_std=0.35),
    )


QUICKSTART = RunConfig(
    name="quickstart",
    environments=64,
    rollouts_per_update=1,
    updates=120,
    physics="native",
    task=TaskConfig(
        constraints=("heading",),
        headings="above",
        approach_steps=50,
        back_off_range=(0.15, 0.15),
        initial_speed=0.0,
        impratio=1.0,
        # The full task's hands close slowly, which takes several times as many steps to learn.
        control=ControlConfig(approach_position_limit=0.04, closing_position_limit=0.04),
    ),
    objects=ObjectsConfig(count=32),
    network=NetworkConfig(hidden=(256, 128)),
    ppo=PPOConfig(minibatches=4, kl_target=0.03, settling=0.25),
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
"""Learns nothing: it shows that physics, messages, log, server and pictures of an installation
work.
"""
_SHORT = {run.name: run for run in (QUICKSTART, CHECK)}
PRESETS = (*_SHORT, FULL, *FULL_FOR)
"""Names of the presets."""


def easier(config: RunConfig) -> list[str]:
    """Phrases for the simplifications of a run relative to the full task; empty if there are
    none.
    """
    task = config.task
    full = get_preset(FULL)
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
    if task.impratio < full.task.impratio:
        words.append("friction is soft")
    if task.approach_steps < full.task.approach_steps:
        words.append(
            f"the table is removed after {task.approach_steps} control steps, not "
            f"{full.task.approach_steps}"
        )
    if not config.objects.folder and config.objects.count < full.objects.count:
        words.append(f"an actor has {config.objects.count} objects, not {full.objects.count}")
    if sum(config.network.hidden) < sum(full.network.hidden):
        layers = [
            " and ".join(map(str, network.hidden)) for network in (config.network, full.network)
        ]
        words.append(f"networks have layers of {layers[0]} units, not {layers[1]}")
    return words


def get_preset(name: str, hand: str | None = None, **sizes: int) -> RunConfig:
    """Returns the preset of this name for a hand, or for its default hand.

    Args:
      name: one of `PRESETS`.
      hand: the name, file or text of a hand. A full task depends on the hand
        (`services.train.presets`); in the others only the hand changes.
      **sizes: other numbers of `environments` and `rollout_steps`; 0 keeps that of the preset.

    Raises:
      CongraspError: there is no such preset or hand; the message lists the available ones.
    """
    if name not in PRESETS:
        raise CongraspError(
            f"There is no preset '{name}'.", f"Choose one of: {', '.join(PRESETS)}."
        )
    if name in _SHORT:
        config = with_hand(_SHORT[name], hand)
    else:
        config = recipe(get_hand(hand or (name if name in FULL_FOR else "human")))
    changed: dict[str, Any] = {size: value for size, value in sizes.items() if value}
    return dataclasses.replace(config, **changed)


def with_hand(config: RunConfig, hand: str | None) -> RunConfig:
    """Returns the configuration with another hand, or unchanged; a hand's file is included, for
    remote actors.
    """
    reference = get_hand(hand or config.task.hand).reference
    return dataclasses.replace(config, task=dataclasses.replace(config.task, hand=reference))
