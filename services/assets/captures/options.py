"""Options for building constraint sets from captures."""

import dataclasses
from typing import Literal

from congrasp.services.assets.captures.extract import LIMIT_TOLERANCE_RAD
from congrasp.services.assets.captures.regions import Affordance


@dataclasses.dataclass(frozen=True)
class Options:
    """Options for building sets."""

    headings: Literal["sampled", "demonstrated"] = "sampled"
    """sampled: 256 per object by the paper's rules; demonstrated: those of the captured grasps."""
    affordance: Affordance = "auto"
    """parts: labelled parts touched by fingers are graspable; contacts: the touched points; auto:
    parts if labelled.
    """
    beyond: float = LIMIT_TOLERANCE_RAD
    """Tolerance in rad of a captured joint beyond its limits; it is then clamped. Only for
    `human`.
    """
    waypoints: int = 15
    seed: int = 0
    """Seed of headings, and of the split of all sequences into training and held-out."""
