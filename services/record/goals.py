"""Constraints and phases of an episode's message."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.constraints.base import Marker

_LATEST = 1e4  # s
_OLDER = ("affordance", "pose_finger", "pose_wrist", "trajectory")
"""Default blocks of the `goal/mask` of recordings without names."""


def active_blocks(arrays: Mapping[str, np.ndarray]) -> dict[str, bool]:
    """Activity of each block of the observation, by name."""
    if "goal/mask" in arrays:
        return dict(zip(_OLDER, (np.asarray(arrays["goal/mask"]) > 0).tolist(), strict=True))
    found = {name.removeprefix("active/"): value for name, value in arrays.items() if name.startswith("active/")}
    return {name: bool(np.asarray(value)) for name, value in found.items()}


def active_constraints(arrays: Mapping[str, np.ndarray]) -> tuple[str, ...]:
    """Names of the active constraints, weakest first; the heading is always included."""
    blocks = active_blocks(arrays)
    return tuple(c.name for c in CONSTRAINTS if not c.optional or any(blocks.get(block) for block in c.blocks))


def markers(arrays: Mapping[str, np.ndarray]) -> Iterator[tuple[str, Marker]]:
    """Yields the markers of each active constraint, with its name."""
    blocks = [name for name, active in active_blocks(arrays).items() if active]
    for constraint in CONSTRAINTS:
        if not constraint.optional or set(constraint.blocks) & set(blocks):
            own = constraint.goal(*(arrays[f"goal/{constraint.name}_{field}"] for field in constraint.arrays))
            yield from ((constraint.name, marker) for marker in constraint.markers(own, blocks))


def grasp_span(meta: Mapping[str, Any], control_dt: float, table: np.ndarray) -> tuple[int, int]:
    """First step of the grasp, and first step after it: that of the lift, or without the table.

    Args:
      meta: metadata of the episode or motion.
      control_dt: length of a control step, s.
      table: (T,) bool, True where the table is present.
    """
    phases, steps = phases_of(meta), len(table)
    end = round(min(phases["lift"] / control_dt, steps)) if "lift" in phases else int(np.sum(table))
    return min(round(min(phases.get("grasp", 0.0) / control_dt, steps)), end), end


def phases_of(meta: Mapping[str, Any]) -> dict[str, float]:
    """Start times of the phases of an episode or a motion (approach, grasp, lift, hold), s, without invalid times."""
    found = meta.get("phases")
    times = found.items() if isinstance(found, dict) else ()
    return {str(name): float(time) for name, time in times if isinstance(time, int | float) and 0 <= time < _LATEST}
