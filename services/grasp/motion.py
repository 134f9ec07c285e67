"""A grasp: the best of several attempts as a motion, and its facts."""

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

from congrasp.actors.stress import ASSESSED
from congrasp.common.wire.codec import Message
from congrasp.services.export.motion import GraspMotion
from congrasp.services.grasp.costs import errors_of

if TYPE_CHECKING:
    from congrasp.services.arm.planner import ArmMotion


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
        metrics = self.motion.metrics
        facts: dict[str, Any] = {
            "object": self.motion.object,
            "hand": self.motion.hand,
            "success": self.success,
            "held_quarter_second": self.motion.success,
            "attempts": self.attempts,
            "attempts_held": self.held,
        }
        if self.cause:
            facts["cause"] = self.cause
        facts |= {
            "rest": self.rest + 1,
            "phases": self.motion.about.get("phases", {}),
            "constraints": list(self.motion.constraints),
            "sink_mm": 1e3 * self.sink,
            "shove_mm": 1e3 * self.shove,
            "links_at_removal": metrics["links_at_removal"],
        }
        facts |= {name: value for name, value in metrics.items() if name in ASSESSED}
        facts |= {name: metrics[name] for name in errors_of(self.motion.constraints)}
        if self.arm:
            facts |= self.arm.facts()
        return facts
