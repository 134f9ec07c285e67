"""Training recipe of the full task for any hand; differences between hands are computed from the hand.

The size of a hand determines the factor s on its objects (`Hand.object_scale`; the paper's for its hands,
`common.hands.measures.fitting_scale` for others), its strength is the force F with which its fingertips can press (the
mean of `common.hands.measures.tip_forces`: torque limits over lengths); G is the number of its fingers. Its mass has no
effect, because the virtual wrist is scaled to it (`common.hands.spec.wrist_gains`).

* **Squeeze** k = s^2 5 / G. All fingers together may press so that the pressure on the object is that of the human
  hand's five: their force grows with the object's surface, s^2, and fewer fingers press more each.
* `force_max` = 5 N k, to half a newton: 5 N, 12 N (Allegro), 6 N (Sharpa).
* `heading_position` = 12 k: 12, 29, 15. The hand's centre is the middle of its fingertips; that its position needs more
  weight in larger hands of fewer fingers is empirical.
* **Weakness** h = (force_max / F - 0.3) / 0.7, between 0 and 1: 0 for fingertips that can press three times what is
  required, as human ones can; 1 for those that cannot press that much (Allegro). Weak hands lose what they may hold
  at a part only, so that they train it more: `p_affordance` = 0.6 + 0.2 h, and against what they then touch
  `affordance_distance` = 0.15 + 0.05 h, `affordance_force` = 0.30 + 0.10 h.

Everything else is the same for all hands.
"""

import dataclasses

from congrasp.common.config import CurriculumConfig, ObjectsConfig, PPOConfig, RunConfig
from congrasp.common.hands.measures import tip_forces
from congrasp.common.hands.spec import Hand
from congrasp.common.task.config import RewardWeights, TaskConfig

HARD_FAMILIES = ("cross", "compound", "camera", "hammer")
"""Families that are hardest to hold by a part, included twice in training."""
_FORCE, _HEADING, _AFFORDANCE = 5.0, 12.0, 0.6  # of the human hand: N, weight, share of the episodes
_STRONG = 0.3  # share of its fingertips' strength required of a strong hand


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
    weakness = min(max((force_max / float(tip_forces(hand).mean()) - _STRONG) / (1 - _STRONG), 0.0), 1.0)
    return Rules(
        force_max=force_max,
        heading_position=float(max(round(_HEADING * squeeze), 1)),
        affordance_distance=round(0.15 + 0.05 * weakness, 2),
        affordance_force=round(0.3 + 0.1 * weakness, 2),
        p_affordance=round(_AFFORDANCE + 0.2 * weakness, 2),
    )


def recipe(hand: Hand) -> RunConfig:
    """Returns the paper's full task for a hand, sized for a GPU."""
    own = rules(hand)
    return RunConfig(
        name=hand.name,
        environments=32_768,
        rollout_steps=10,
        updates=800,
        task=TaskConfig(
            hand=hand.reference,
            p_affordance=own.p_affordance,
            p_pose=0.35,
            p_trajectory=0.35,
            p_fingers=0.2,
            p_force=0.25,
            p_together=0.45,  # trajectory and affordance in 15 % of the episodes (Allegro: 17), without it in 8 (9)
            hold_steps_max=200,
            surface_normals=True,
            disturbed_references=0.5,
            mass_range=(0.6, 2.4),
            friction_range=(0.6, 1.2),
            reward=RewardWeights(force_max=own.force_max),
        ),
        # Grasps first, then the precision of constraints: with the second weights from the beginning, trajectories are
        # not learnt.
        curriculum=CurriculumConfig(
            ramp=(80, 160),
            reward=RewardWeights(
                force=0.8,
                force_max=own.force_max,
                force_excess=0.02,
                object_position=80.0,
                object_rotation=6.0,
                drop=5.0,
                heading_direction=2.5,
                heading_position=own.heading_position,
                pose_finger=0.15,
                pose_link=8.0,
                pose_wrist_position=150.0,
                pose_wrist_rotation=3.0,
                trajectory_position=500.0,
                trajectory_rotation=18.0,
                affordance_distance=own.affordance_distance,
                affordance_force=own.affordance_force,
            ),
        ),
        objects=ObjectsConfig(families=("all", "scans", *HARD_FAMILIES), count=1600, by_failure=True),
        ppo=PPOConfig(rollouts_per_update=1, gamma=0.99, settling=0.25, least_std=0.35),
    )
