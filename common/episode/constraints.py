"""Active constraints of an episode, and their markers.

A constraint gates one or more blocks of the observation. Messages store the activity of each block
(`active/BLOCK`), while users and motion files name constraints. The functions convert one into the
other.
"""

from collections.abc import Iterator, Mapping

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.constraints.base import Constraint
from congrasp.common.task.constraints.markers import Marker

_MASK = "goal/mask"
"""Vector in older recordings, in place of `active/BLOCK`; one number for each of `_MASK_BLOCKS`."""
_MASK_BLOCKS = ("affordance", "pose_finger", "pose_wrist", "trajectory")


def block_activity(arrays: Mapping[str, np.ndarray]) -> dict[str, bool]:
    """Returns the activity of each block of the observation, by name of the block.

    Args:
      arrays: arrays of a message.

    Raises:
      CongraspError: an older message has another number of blocks.
    """
    if _MASK in arrays:
        mask = arrays[_MASK]
        if mask.shape != (len(_MASK_BLOCKS),):
            raise CongraspError(
                f"The episode's {_MASK} has shape {mask.shape}, not ({len(_MASK_BLOCKS)},)."
            )
        return dict(zip(_MASK_BLOCKS, (mask > 0).tolist(), strict=True))
    activity = {}
    for name, value in arrays.items():
        if name.startswith("active/"):
            activity[name.removeprefix("active/")] = bool(value)
    return activity


def goal_arrays(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Returns the goal arrays by `CONSTRAINT_FIELD`, such as `heading_direction`.

    Args:
      arrays: arrays of a message.
    """
    goals = {}
    for name, value in arrays.items():
        if name.startswith("goal/") and name != _MASK:
            goals[name.removeprefix("goal/")] = value
    return goals


def active_constraints(activity: Mapping[str, bool]) -> tuple[str, ...]:
    """Returns the names of the active constraints in the order of priority, lowest first. The
    constraint `heading` is always active.

    Args:
      activity: activity of each block of the observation, by name of the block.
    """
    return tuple(c.name for c in CONSTRAINTS if _is_active(c, activity))


def activity_of_constraints(constraints: tuple[str, ...]) -> dict[str, bool]:
    """Returns the activity of each block of the observation, by name of the block.

    A motion file stores only names of constraints: all of their blocks count as active, the other
    blocks as inactive.
    """
    activity = {}
    for constraint in CONSTRAINTS:
        for block in constraint.blocks:
            activity[block] = constraint.name in constraints
    return activity


def markers(
    goals: Mapping[str, np.ndarray], activity: Mapping[str, bool]
) -> Iterator[tuple[str, Marker]]:
    """Yields pairs of the name of an active constraint and one of its markers.

    Args:
      goals: goal arrays by `CONSTRAINT_FIELD`, see `goal_arrays`.
      activity: activity of each block of the observation, by name of the block.

    Raises:
      LookupError: a goal array of an active constraint is missing.
    """
    active_blocks = [block for block, is_active in activity.items() if is_active]
    for constraint in CONSTRAINTS:
        if not _is_active(constraint, activity):
            continue
        values = {field: goals[f"{constraint.name}_{field}"] for field in constraint.arrays}
        goal_type = constraint.goal
        for marker in constraint.markers(goal_type(**values), active_blocks):
            yield constraint.name, marker


def _is_active(constraint: Constraint, activity: Mapping[str, bool]) -> bool:
    """Returns True if a constraint is not optional, or one of its blocks is active."""
    if not constraint.optional:
        return True
    return any(activity.get(block) for block in constraint.blocks)
