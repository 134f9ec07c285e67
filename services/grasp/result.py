"""Outcome of a grasp of one object, and its summary in a line."""

from typing import Any, NamedTuple

import numpy as np

_ERRORS = {"heading": "heading off by", "pose": "pose off by", "trajectory": "trajectory off by"}
"""Words for the errors of constraints that have an angle and a distance."""


class Result(NamedTuple):
    """The outcome for one object."""

    name: str
    facts: dict[str, Any]
    """Content of the result file; empty if there is an error."""
    error: str = ""
    skipped: bool = False
    """True if the folder was complete before."""

    @property
    def held(self) -> bool:
        """True if the object is held, and its simulated shape is close to the shape in its file."""
        return bool(self.facts.get("success")) and self.facts["shape_reliable"]

    def line(self) -> str:
        """Summary in one line."""
        if self.error:
            return self.error
        facts = self.facts
        parts = [facts["size"], _outcome(facts)]
        if facts.get("cause"):
            parts.append(facts["cause"].rstrip("."))
        if facts["rest"] > 1:
            parts.append(f"in resting pose {facts['rest']}, not the likeliest")
        parts.append(
            f"best of {facts['attempts']} attempts ({facts['attempts_held']} hold the object)"
        )
        parts += _errors(facts)
        parts.append(f"strongest link {facts['force_link_max']:.1f} N")
        return "; ".join(parts)


def _outcome(facts: dict[str, Any]) -> str:
    """Held or not, and what restricts it."""
    outcome = "held" if facts["success"] else "not held"
    if not facts["shape_reliable"]:
        outcome += (
            ", but its shape is unreliable (see its notes; repair the mesh, or set --time-limit)"
        )
    if facts.get("push_survival"):
        outcome += ", also against pushes of 1 N"
    return outcome


def _errors(facts: dict[str, Any]) -> list[str]:
    """Errors of the constraints in words."""
    errors = []
    for stem, words in _ERRORS.items():
        if f"{stem}_m" in facts:
            degrees = np.degrees(facts[f"{stem}_rad"])
            millimetres = 1000 * facts[f"{stem}_m"]
            errors.append(f"{words} {degrees:.0f}° and {millimetres:.0f} mm")
    if "affordance_ratio" in facts:
        percent = 100 * facts["affordance_ratio"]
        errors.append(f"{percent:.0f} % of the contacts in the avoid region")
    return errors
