"""Active constraints of an episode, and their markers."""

from collections.abc import Iterator, Mapping

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.constraints.base import Constraint
from congrasp.common.task.constraints.markers import Marker

_MASK = "goal/mask"
"""Array of older recordings with the activity of `_BLOCKS_OF_MASK`."""
_BLOCKS_OF_MASK = ("affordance", "pose_finger", "pose_wrist", "trajectory")


def active_blocks(arrays: Mapping[str, np.ndarray]) -> dict[str, bool]:
    """Activity of each block of the observation by name, from the arrays of a message.

    Raises:
      CongraspError: an older message has another number of blocks.
    """
    if _MASK in arrays:
        mask = arrays[_MASK]
        if mask.shape != (len(_BLOCKS_OF_MASK),):
            raise CongraspError(
                f"The episode's {_MASK} has shape {mask.shape}, not ({len(_BLOCKS_OF_MASK)},)."
            )
        return dict(zip(_BLOCKS_OF_MASK, (mask > 0).tolist(), strict=True))
    blocks = {}
    for name, value in arrays.items():
        if name.startswith("active/"):
            blocks[name.removeprefix("active/")] = bool(value)
    return blocks


def goal_arrays(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Goal arrays by constraint and field, from the arrays of a message."""
    goal = {}
    for name, value in arrays.items():
        if name.startswith("goal/") and name != _MASK:
            goal[name.removeprefix("goal/")] = value
    return goal


def active_constraints(blocks: Mapping[str, bool]) -> tuple[str, ...]:
    """Names of the active constraints, weakest first; the heading is always included.

    Args:
      blocks: activity of each block of the observation, by name.
    """
    return tuple(c.name for c in CONSTRAINTS if _is_active(c, blocks))


def blocks_of(constraints: tuple[str, ...]) -> dict[str, bool]:
    """Activity of each block of the observation by name, if all blocks of these constraints are
    active.
    """
    blocks = {}
    for constraint in CONSTRAINTS:
        for block in constraint.blocks:
            blocks[block] = constraint.name in constraints
    return blocks


def markers(
    goal: Mapping[str, np.ndarray], blocks: Mapping[str, bool]
) -> Iterator[tuple[str, Marker]]:
    """Yields the markers of each active constraint, with its name.

    Args:
      goal: goal arrays by constraint and field.
      blocks: activity of each block of the observation, by name.

    Raises:
      LookupError: a goal array of an active constraint is missing.
    """
    active = [name for name, is_active in blocks.items() if is_active]
    for constraint in CONSTRAINTS:
        if not _is_active(constraint, blocks):
            continue
        fields = [goal[f"{constraint.name}_{field}"] for field in constraint.arrays]
        for marker in constraint.markers(constraint.goal(*fields), active):
            yield constraint.name, marker


def _is_active(constraint: Constraint, blocks: Mapping[str, bool]) -> bool:
    """True if a constraint is not optional, or one of its blocks is active."""
    if not constraint.optional:
        return True
    return any(blocks.get(block) for block in constraint.blocks)
