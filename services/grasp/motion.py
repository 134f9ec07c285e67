"""A grasp: the best of several attempts as an episode, and its facts."""

import dataclasses
import functools
from typing import TYPE_CHECKING, Any

import numpy as np

from congrasp.actors.stress import ASSESSED_NAMES
from congrasp.common.episode.episode import Episode
from congrasp.services.grasp.costs import errors_of

if TYPE_CHECKING:
    from congrasp.services.arm.planner import ArmMotion


@dataclasses.dataclass(frozen=True, eq=False)
class Grasp:
    """The best of several attempts."""

    episode: Episode
    """The whole episode, as in recordings."""
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

    @functools.cached_property
    def motion(self) -> Episode:
        """The episode with normalised quaternions, for motion files and exports."""
        return self.episode.normalised()

    @property
    def success(self) -> bool:
        """True if this attempt held the object to the end."""
        return self.episode.metrics["held"] > 0

    @property
    def sink(self) -> float:
        """Largest drop of the wrist during the hold, m."""
        height = self.episode.wrist_position[self.first("hold") :, 2]
        return float(max(height[0] - height.min(), 0.0))

    @property
    def shove(self) -> float:
        """Largest displacement of the object before it is lifted or the table is removed, m."""
        phase = "lift" if "lift" in self.episode.phases else "hold"
        positions = self.episode.object_position
        moved = positions[: self.first(phase)] - positions[0]
        return float(np.linalg.norm(moved, axis=-1).max())

    def first(self, phase: str) -> int:
        """The first step of a phase."""
        begin = self.episode.phases[phase]
        step = int(np.searchsorted(self.episode.time, begin - 1e-6))
        return min(step, self.episode.steps - 1)

    def facts(self) -> dict[str, Any]:
        """Result, attempts and errors, for tables and files."""
        episode = self.episode
        metrics = episode.metrics
        facts: dict[str, Any] = {
            "object": episode.object,
            "hand": episode.hand,
            "success": self.success,
            "held_quarter_second": episode.success,
            "attempts": self.attempts,
            "attempts_held": self.held,
        }
        if self.cause:
            facts["cause"] = self.cause
        facts |= {
            "rest": self.rest + 1,
            "phases": episode.about.get("phases", {}),
            "constraints": list(episode.constraints),
            "sink_mm": 1e3 * self.sink,
            "shove_mm": 1e3 * self.shove,
            "links_at_removal": metrics["links_at_removal"],
        }
        facts |= {name: value for name, value in metrics.items() if name in ASSESSED_NAMES}
        facts |= {name: metrics[name] for name in errors_of(episode.constraints)}
        if self.arm:
            facts |= self.arm.facts()
        return facts
