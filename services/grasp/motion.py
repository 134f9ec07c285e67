"""The best of several attempts: the costs that choose it, its motion, and its facts."""

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

from congrasp.actors.attempts import Outcome
from congrasp.actors.stress import ASSESSED, SURVIVAL
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.wire.codec import Message
from congrasp.services.export.motion_file import GraspMotion

if TYPE_CHECKING:
    from congrasp.services.arm.planner import ArmMotion

_SCALES = {spec.name: spec.scale for constraint in CONSTRAINTS for spec in constraint.errors}
_SCALES |= {
    "moved_at_removal": 0.01,
    "force_link_max": 10.0,
    "slip": 0.02,
    "posture_rad": 0.1,
}
"""Scales that make costs of grasps that hold comparable: errors, displacement of the object before
table removal (m), force of the strongest link (N), displacement after removal (m), and deviation
from natural postures (rad)."""
_FIRM = ("clean", *SURVIVAL)
"""Metrics that add a cost of 1 where they are zero."""


@dataclasses.dataclass(frozen=True, eq=False)
class Grasp:
    """The best of several attempts."""

    episode: Message
    """The whole episode, in the format of recordings."""
    motion: GraspMotion
    """Content of the NPZ."""
    attempts: int
    """Number of simulated attempts."""
    held: int
    """Number of those that held the object to the end."""
    rest: int
    """Index of the initial resting pose."""
    active: tuple[str, ...]
    """Active constraints and the reasons, in sentences."""
    arm: "ArmMotion | None" = None
    """The motion of the arm, if there is one."""
    cause: str = ""
    """Sentence on the reason why no attempt holds the object, if it is its weight or width; empty
    otherwise.
    """

    @property
    def success(self) -> bool:
        """True if this attempt held the object to the end."""
        return self.motion.metrics["held"] > 0

    @property
    def sink(self) -> float:
        """Largest drop of the wrist during the hold, m."""
        height = self.motion.wrist_position[self.first("hold") :, 2]
        return float(max(height[0] - height.min(), 0.0))

    @property
    def shove(self) -> float:
        """Largest displacement of the object before it is lifted or the table is removed, m."""
        phase = "lift" if "lift" in self.motion.about["phases"] else "hold"
        moved = self.motion.object_position[: self.first(phase)] - self.motion.object_position[0]
        return float(np.linalg.norm(moved, axis=-1).max())

    def first(self, phase: str) -> int:
        """The first step of a phase."""
        begin = self.motion.about["phases"][phase]
        return min(int(np.searchsorted(self.motion.time, begin - 1e-6)), len(self.motion.time) - 1)

    def facts(self) -> dict[str, Any]:
        """Result, attempts and errors, for tables and files."""
        return {
            "object": self.motion.object,
            "hand": self.motion.hand,
            "success": self.success,
            "held_quarter_second": self.motion.success,
            "attempts": self.attempts,
            "attempts_held": self.held,
            **({"cause": self.cause} if self.cause else {}),
            "rest": self.rest + 1,
            "phases": self.motion.about.get("phases", {}),
            "constraints": list(self.motion.constraints),
            "sink_mm": 1e3 * self.sink,
            "shove_mm": 1e3 * self.shove,
            "links_at_removal": self.motion.metrics["links_at_removal"],
            **{name: value for name, value in self.motion.metrics.items() if name in ASSESSED},
            **{name: self.motion.metrics[name] for name in _errors_of(self.motion.constraints)},
            **(self.arm.facts() if self.arm else {}),
        }


def _errors_of(constraints: tuple[str, ...]) -> list[str]:
    """Names of the metrics that count under these constraints."""
    names = [
        spec.name
        for c in CONSTRAINTS
        if not c.optional or c.name in constraints
        for spec in c.errors
    ]
    return [*names, "moved_at_removal", "force_link_max"]


def costs(
    outcome: Outcome, constraints: tuple[str, ...], removal: int, lift: float = 0.0
) -> np.ndarray:
    """(B,) cost of each attempt: held to the end first, then held for a quarter of a second, then
    everything else.

    Args:
      outcome: outcome of the attempts.
      constraints: names of the requested constraints.
      removal: the last control step of the approach.
      lift: height by which the hand rises after the approach, m.
    """
    place = outcome.trace.object_position
    way = place[-1] - place[removal] - [0.0, 0.0, lift]
    values = {**outcome.metrics, "slip": np.linalg.norm(way, axis=-1)}
    cost = sum(
        np.minimum(values[name] / _SCALES[name], 10.0)
        for name in [*_errors_of(constraints), "slip", "posture_rad"]
    )
    cost += sum(values[name] == 0 for name in _FIRM)
    return np.asarray(cost) + 1e3 * (values["success"] == 0) + 1e4 * (values["held"] == 0)
