"""Model card of a policy: its training data, and its limits as far as its figures show them."""

from collections.abc import Mapping, Sequence
from typing import Any

from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.task.config import SensingConfig, TaskConfig
from congrasp.common.task.constraints import optional
from congrasp.common.task.plausibility import CLEAN_MM
from congrasp.common.task.sensors import get_sensor
from congrasp.services.evaluate.scores import Row

_LOW_RATE = 0.8
"""Rates below this are listed as limits."""
_MAX_OBJECTS = 6
"""Most objects listed."""
_OVERLAPS = {
    "hand_hand_mm": "Its fingers pass through one another",
    "hand_table_mm": "It passes through the table",
    "hand_object_mm": "It passes through the object",
}
_FAST_WRIST = 1.0
"""Wrist speed that an arm hardly follows, m/s."""
_TRAINED_ON = (
    "It was trained by reinforcement learning in simulation. Objects are procedural, or those of "
    "the run's folder; constraints are sampled, or those of the run's constraint sets."
)
_SIMULATED = (
    "It was trained and measured in simulation, never on a physical hand: success here implies "
    "nothing about the safety of a robot."
)
_OBJECTS = (
    "Its objects were rigid and fit the hand: no soft or articulated ones, no clutter and no "
    "obstacles."
)
_HEADINGS = {
    "all": "all headings",
    "above": "headings within 30° of straight down",
    "center": "headings with the hand's centre above the table",
}
_TRACKER_UNITS = {
    "period": "s",
    "delay": "s",
    "position_noise": "m",
    "rotation_noise": "rad",
    "dropout": "",
}


def model_card(policy: PolicyBundle, rows: Sequence[Row]) -> Mapping[str, Any]:
    """Returns the sections of a policy's model card.

    Args:
      policy: policy of the card.
      rows: rows of its evaluation.

    Returns:
      `hand`; `constraints`: names; `data`: sentences; `limits`: sentences, those from the rows
      first. The rest of a card is the same for all policies.
    """
    task = policy.task
    return {
        "hand": policy.spec.hand_name,
        "constraints": task.constraints,
        "data": (_TRAINED_ON, _episodes_in_training(task)),
        "limits": (*limits(rows), _SIMULATED, get_sensor(task).describe(task), _OBJECTS),
    }


def limits(rows: Sequence[Row]) -> list[str]:
    """Limits shown by the figures: rows below the paper's or below 80 %, lost objects, implausible
    motions.
    """
    sentences = [sentence for row in rows if (sentence := _low_rates(row))]
    if not sentences:
        sentences.append("No row is below the paper's success, or below 80 %.")
    objects = _worst_objects(rows)
    if objects:
        sentences.append(f"Objects with the most losses: {', '.join(objects)}.")
    for measure, overlap in _OVERLAPS.items():
        deepest = _largest(rows, measure)
        if deepest > CLEAN_MM[measure]:
            sentences.append(f"{overlap}: {deepest:.1f} mm at the deepest, mean of the worst row.")
    fastest = _largest(rows, "wrist_speed")
    if fastest > _FAST_WRIST:
        sentences.append(f"Its wrist peaks at {fastest:.1f} m/s, in the mean of the fastest row.")
    return sentences


def _low_rates(row: Row) -> str:
    """Sentence on the rates of a row that are low; empty if none is."""
    rates = []
    if row.success < _LOW_RATE:
        rates.append(f"{100 * row.success:.1f} % success")
    if row.held_2s is not None and row.held_2s < _LOW_RATE:
        rates.append(f"{100 * row.held_2s:.1f} % held for 2 s")
    if row.paper and row.success < row.paper.success:
        points = 100 * (row.paper.success - row.success)
        rates.append(
            f"success {points:.1f} points below the paper's {100 * row.paper.success:.1f} %"
        )
    if not rates:
        return ""
    name = f"{row.constraint} ({row.group})" if row.group else row.constraint
    return f"{name.capitalize()}: {', '.join(rates)}."


def _largest(rows: Sequence[Row], measure: str) -> float:
    """Largest mean of a measure of plausibility; 0 if no row has it."""
    return max((row.plausibility.get(measure) or 0.0 for row in rows), default=0.0)


def _worst_objects(rows: Sequence[Row]) -> list[str]:
    """Objects with a success below 80 % over all rows, the worst first, with their rates."""
    episodes: dict[str, int] = {}
    successes: dict[str, float] = {}
    for row in rows:
        for rates in row.objects:
            name = rates["name"]
            episodes[name] = episodes.get(name, 0) + rates["episodes"]
            successes[name] = successes.get(name, 0.0) + rates["episodes"] * rates["success"]
    worst = sorted((successes[name] / count, name) for name, count in episodes.items())
    texts = [
        f"{name} ({100 * rate:.0f} % of {episodes[name]})"
        for rate, name in worst
        if rate < _LOW_RATE
    ]
    return texts[:_MAX_OBJECTS]


def _episodes_in_training(task: TaskConfig) -> str:
    """Describes the distribution of the episodes in training."""
    constraints = []
    for constraint in optional(task):
        share = getattr(task, f"p_{constraint.name}")
        constraints.append(f"{constraint.title} in {100 * share:.0f} %")
    ranges = [
        f"mass x {_range(task.mass_range)}",
        f"sliding friction {_range(task.friction_range)}",
    ]
    if task.gain_range != (1.0, 1.0):
        ranges.append(f"servo gains x {_range(task.gain_range)}")
    ranges += _tracker_ranges(task.sensing)
    return (
        f"In training: {_HEADINGS[task.headings]}; "
        f"{', '.join(constraints) or 'no other constraint'}; {', '.join(ranges)}."
    )


def _tracker_ranges(sensing: SensingConfig) -> list[str]:
    """Describes the tracker's ranges in training, with units, omitting those that were always
    zero.
    """
    texts = []
    for name, unit in _TRACKER_UNITS.items():
        limits_of_range = getattr(sensing, name)
        if any(limits_of_range):
            text = f"tracker's {name.replace('_', ' ')} {_range(limits_of_range)} {unit}"
            texts.append(text.rstrip())
    return texts


def _range(bounds: tuple[float, float]) -> str:
    """Formats a range such as "0.8 to 1.2"; one number if both are equal."""
    low, high = bounds
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"
