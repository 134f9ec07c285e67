"""The constraints, weakest first; layouts, masks, tables and the priority rules use this order."""

import functools
import operator
from collections.abc import Iterable

import numpy as np

from congrasp.common.errors import CongraspError, UnknownConstraintError
from congrasp.common.hands.spec import Hand
from congrasp.common.request import GraspRequest
from congrasp.common.task.constraints.affordance import Affordance
from congrasp.common.task.constraints.base import Constraint, unknown_constraint
from congrasp.common.task.constraints.fingers import Fingers
from congrasp.common.task.constraints.force import Force
from congrasp.common.task.constraints.heading import Heading
from congrasp.common.task.constraints.pose import Pose
from congrasp.common.task.constraints.specs import ErrorSpec
from congrasp.common.task.constraints.trajectory import Trajectory
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array, Goal

CONSTRAINTS: tuple[Constraint, ...] = (
    Heading(),
    Affordance(),
    Pose(),
    Trajectory(),
    Fingers(),
    Force(),
)
PAPER = ("heading", "affordance", "pose", "trajectory")
"""Names of the paper's constraints."""
OURS = (*PAPER, "fingers", "force")
"""Names of the constraints that a policy supports by default."""


def get_constraint(name: str) -> Constraint:
    """Returns a constraint by its name.

    Raises:
      UnknownConstraintError: there is no such constraint.
    """
    for constraint in CONSTRAINTS:
        if constraint.name == name:
            return constraint
    raise unknown_constraint(name, [constraint.name for constraint in CONSTRAINTS])


def known(task: TaskSettings) -> tuple[Constraint, ...]:
    """Returns the constraints supported by the task's policy, weakest first.

    Raises:
      CongraspError: the task names an unknown one, or omits the heading.
    """
    for name in task.constraints:
        get_constraint(name)
    if "heading" not in task.constraints:
        raise CongraspError(
            "The task's constraints lack the heading, which is always active.",
            "Add 'heading' to them.",
        )
    return tuple(constraint for constraint in CONSTRAINTS if constraint.name in task.constraints)


def optional(task: TaskSettings) -> tuple[Constraint, ...]:
    """Supported constraints that may be inactive in an episode."""
    return tuple(constraint for constraint in known(task) if constraint.optional)


def draws_references(task: TaskSettings) -> bool:
    """True if a constraint of the task is drawn from reference poses or trajectories."""
    return any(constraint.from_reference for constraint in known(task))


def blocks(task: TaskSettings) -> tuple[str, ...]:
    """Names of the gated blocks of the observation, in order; each is a bit of the mask."""
    names: list[str] = []
    for constraint in known(task):
        names += constraint.blocks
    return tuple(names)


def center_fingers(task: TaskSettings, goal: Goal) -> Array | None:
    """(B, G) bool: fingers that define the hand centre and the distance reward; None if no
    constraint selects them.
    """
    selections = []
    for constraint in known(task):
        fingers = constraint.center_fingers(goal)
        if fingers is not None:
            selections.append(fingers)
    if not selections:
        return None
    return functools.reduce(operator.and_, selections)


def requested_fingers(task: TaskSettings, goal: Goal) -> Array | None:
    """(B,) bool: an active constraint requests the angles of all finger joints; None if none of the
    task's constraints does.
    """
    requests = [
        goal.active[constraint.finger_pose] for constraint in known(task) if constraint.finger_pose
    ]
    if not requests:
        return None
    return functools.reduce(operator.or_, requests)


def error_specs(constraints: Iterable[Constraint]) -> tuple[ErrorSpec, ...]:
    """Errors of several constraints, in order."""
    errors: list[ErrorSpec] = []
    for constraint in constraints:
        errors += constraint.errors
    return tuple(errors)


def goal_of(hand: Hand, task: TaskSettings, request: GraspRequest) -> Goal:
    """Goal arrays of a request, without batch axis, before the priority rules; neutral where the
    request has none.
    """
    values = {}
    for constraint in known(task):
        neutral = constraint.neutral(hand, task)
        requested = {}
        for name, value in request.constraints.get(constraint.name, {}).items():
            requested[name] = np.asarray(value, getattr(neutral, name).dtype)
        values[constraint.name] = neutral._replace(**requested)
    return Goal(values, {})


def require_known(names: Iterable[str], task: TaskSettings) -> None:
    """Raises an `UnknownConstraintError` if a requested constraint is not supported by the task's
    policy.
    """
    for name in names:
        get_constraint(name)
        if name not in task.constraints:
            raise UnknownConstraintError(
                f"The policy does not support the constraint '{name}'.",
                f"It supports {', '.join(task.constraints)}; train one with --task.constraints … "
                f"{name}.",
            )


__all__ = [
    "CONSTRAINTS",
    "OURS",
    "PAPER",
    "Constraint",
    "blocks",
    "center_fingers",
    "draws_references",
    "error_specs",
    "get_constraint",
    "goal_of",
    "known",
    "optional",
    "requested_fingers",
    "require_known",
]
