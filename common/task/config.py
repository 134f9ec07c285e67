"""Configuration of the task: its settings, with a weight for each reward term and a probability for
each constraint.

Weights and probabilities are derived from `common.task.reward.GRASP` and
`common.task.constraints.CONSTRAINTS`.
"""

import dataclasses
from collections.abc import Iterable
from typing import Annotated, Any

import jax
from typing_extensions import Doc

from congrasp.common.task.constraints import CONSTRAINTS, OURS
from congrasp.common.task.reward import GRASP
from congrasp.common.task.settings import ControlConfig, SensingConfig, TaskSettings

__all__ = ["ControlConfig", "RewardWeights", "SensingConfig", "TaskConfig"]


def _declared(fields: Iterable[tuple[str, float, str]]) -> Any:
    """Returns a frozen dataclass of numbers declared elsewhere, from (name, default, help)
    triples.
    """
    made = [
        (name, Annotated[float, Doc(text)], dataclasses.field(default=value))
        for name, value, text in fields
    ]
    return dataclasses.make_dataclass("Declared", made, frozen=True)


_Weights: Any = _declared(
    (
        *(term[:3] for term in GRASP),
        *(weight for constraint in CONSTRAINTS for weight in constraint.weights),
    )
)
_Shares: Any = _declared(
    (
        f"p_{c.name}",
        0.5,
        f"Probability that an episode has the constraint '{c.name}', where the object allows it.",
    )
    for c in CONSTRAINTS
    if c.optional
)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RewardWeights(_Weights):
    """Weights of all reward terms, of the grasp and of each constraint, in units of reward per
    control step.
    """


@dataclasses.dataclass(frozen=True)
class TaskConfig(TaskSettings, _Shares):
    """The task: hand, timing, observation, control, reward and constraint sampling."""

    constraints: tuple[str, ...] = OURS
    """Constraints that the policy supports: it observes them, and requests may contain them."""
    reward: RewardWeights = RewardWeights()
    """Weights of the reward terms."""
