"""Model card of a policy: purpose, training data, limits, licence and citation."""

from collections.abc import Mapping, Sequence
from typing import Any

from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.task.config import SensingConfig, TaskConfig
from congrasp.common.task.constraints import optional
from congrasp.common.task.plausibility import CLEAN_MM
from congrasp.services.evaluate.scores import Row

_LEAST = 0.8
"""Rates below this are listed as limits."""
_WORST = 6
"""Most objects listed."""
_OVERLAPS = {
    "hand_hand_mm": "Its fingers pass through one another",
    "hand_table_mm": "It passes through the table",
    "hand_object_mm": "It passes through the object",
}
_FAST = 1.0  # m/s of a wrist, above which an arm hardly follows
_SIMULATED = (
    "It was trained and measured in simulation, never on a physical hand: success here implies nothing about the "
    "safety of a robot."
)
_MET = "Its objects were rigid and fit the hand: no soft or articulated ones, no clutter and no obstacles."
_HEADINGS = {
    "all": "all headings",
    "above": "headings within 30° of straight down",
    "center": "headings with the hand's centre above the table",
}
_TRACKER_UNITS = {"period": "s", "delay": "s", "position_noise": "m", "rotation_noise": "rad", "dropout": ""}


def model_card(policy: PolicyBundle, rows: Sequence[Row]) -> Mapping[str, Any]:
    """Returns the sections of a policy's model card.

    Args:
      policy: policy of the card.
      rows: rows of its evaluation.

    Returns:
      `hand`; `constraints`: names; `data`: sentences; `limits`: sentences, those from the rows first. The rest
        of a card is the same for all policies.
    """
    return {
        "hand": policy.spec.hand_name,
        "constraints": policy.task.constraints,
        "data": (
            "It was trained by reinforcement learning in simulation. Objects are procedural, or those of the "
            "run's folder; constraints are sampled, or those of the run's constraint sets.",
            _trained(policy.task),
        ),
        "limits": (*limits(rows), _SIMULATED, _observed(policy.task), _MET),
    }


def limits(rows: Sequence[Row]) -> list[str]:
    """Limits shown by the figures: rows below the paper's or below 80 %, lost objects, implausible motions."""
    found = []
    for row in rows:
        name = f"{row.constraint} ({row.group})" if row.group else row.constraint
        rates = [("success", row.success), ("held for 2 s", row.held_2s)]
        low = [f"{100 * rate:.1f} % {what}" for what, rate in rates if rate is not None and rate < _LEAST]
        if row.paper and row.success < row.paper.success:
            below = 100 * (row.paper.success - row.success)
            low.append(f"success {below:.1f} points below the paper's {100 * row.paper.success:.1f} %")
        if low:
            found.append(f"{name.capitalize()}: {', '.join(low)}.")
    if not found:
        found.append("No row is below the paper's success, or below 80 %.")
    if worst := _worst(rows):
        found.append(f"Objects with the most losses: {', '.join(worst)}.")
    for measure, words in _OVERLAPS.items():
        deepest = max((row.plausibility.get(measure) or 0.0 for row in rows), default=0.0)
        if deepest > CLEAN_MM[measure]:
            found.append(f"{words}: {deepest:.1f} mm at the deepest, mean of the worst row.")
    fastest = max((row.plausibility.get("wrist_speed") or 0.0 for row in rows), default=0.0)
    if fastest > _FAST:
        found.append(f"Its wrist peaks at {fastest:.1f} m/s, in the mean of the fastest row.")
    return found


def _worst(rows: Sequence[Row]) -> list[str]:
    """Objects with a success below 80 % over all rows, the worst first, with their rates."""
    episodes: dict[str, int] = {}
    held: dict[str, float] = {}
    for row in rows:
        for of in row.objects:
            episodes[of["name"]] = episodes.get(of["name"], 0) + of["episodes"]
            held[of["name"]] = held.get(of["name"], 0.0) + of["episodes"] * of["success"]
    rates = sorted((held[name] / count, name) for name, count in episodes.items())
    return [f"{name} ({100 * rate:.0f} % of {episodes[name]})" for rate, name in rates if rate < _LEAST][:_WORST]


def _trained(task: TaskConfig) -> str:
    """Describes the distribution of the episodes in training."""
    parts = [f"{part.title} in {100 * getattr(task, f'p_{part.name}'):.0f} %" for part in optional(task)]
    ranges = [f"mass x {_range(task.mass_range)}", f"sliding friction {_range(task.friction_range)}"]
    if task.gain_range != (1.0, 1.0):
        ranges.append(f"servo gains x {_range(task.gain_range)}")
    ranges += _tracker(task.sensing)
    return f"In training: {_HEADINGS[task.headings]}; {', '.join(parts) or 'no other constraint'}; {', '.join(ranges)}."


def _tracker(sensing: SensingConfig) -> list[str]:
    """Describes the tracker's ranges in training, with units, omitting those that were always zero."""
    ranges = {name: (getattr(sensing, name), unit) for name, unit in _TRACKER_UNITS.items()}
    return [
        f"tracker's {name.replace('_', ' ')} {_range(limits)} {unit}".rstrip()
        for name, (limits, unit) in ranges.items()
        if any(limits)
    ]


def _range(limits: tuple[float, float]) -> str:
    """Formats a range such as "0.8 to 1.2"; one number if both are equal."""
    low, high = limits
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _observed(task: TaskConfig) -> str:
    """Describes the observation of the policy."""
    robot = f"It observes the last {task.history} control steps of joint angles, the wrist, their targets"
    if task.observation == "camera":
        return f"{robot}, and a partial cloud of the object from a depth camera; no pose, velocities or contact forces."
    if task.observation == "tracked":
        return f"{robot} and the object's pose from a tracker; no velocities and no contact forces."
    pose = "exact poses" if task.sensing == SensingConfig() else "the object's pose from a tracker"
    return f"It observes {pose}, velocities and contact forces."
