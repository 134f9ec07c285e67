"""Costs that choose among attempts."""

import numpy as np

from congrasp.actors.attempts import Outcome
from congrasp.actors.stress import SURVIVAL_NAMES
from congrasp.common.objects.resting import upright_rest
from congrasp.common.objects.spec import GraspObject
from congrasp.common.request import GraspRequest
from congrasp.common.task.constraints import CONSTRAINTS

_STRESS_SCALES = {
    "moved_at_removal": 0.01,
    "force_link_max": 10.0,
    "slip": 0.02,
    "posture_rad": 0.1,
}
"""Scales of displacement of the object before table removal (m), force of the strongest link (N),
displacement after removal (m), and deviation from natural postures (rad)."""
_MAX_COST = 10.0
"""Largest cost of one metric."""
_FIRM = ("clean", *SURVIVAL_NAMES)
"""Metrics that add a cost of 1 where they are zero."""
_NO_SUCCESS = 1e3
_NOT_HELD = 1e4


def error_scales() -> dict[str, float]:
    """Scales that make costs of grasps that hold comparable, by metric."""
    scales = dict(_STRESS_SCALES)
    for constraint in CONSTRAINTS:
        for spec in constraint.errors:
            scales[spec.name] = spec.scale
    return scales


def errors_of(constraints: tuple[str, ...]) -> list[str]:
    """Names of the metrics that count under these constraints."""
    names = []
    for constraint in CONSTRAINTS:
        if not constraint.optional or constraint.name in constraints:
            names += [spec.name for spec in constraint.errors]
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
    position = outcome.trace.object_position
    displacement = position[-1] - position[removal] - [0.0, 0.0, lift]
    values = {**outcome.metrics, "slip": np.linalg.norm(displacement, axis=-1)}
    scales = error_scales()
    names = [*errors_of(constraints), "slip", "posture_rad"]
    cost = sum(np.minimum(values[name] / scales[name], _MAX_COST) for name in names)
    cost += sum(values[name] == 0 for name in _FIRM)
    no_success = values["success"] == 0
    not_held = values["held"] == 0
    return np.asarray(cost) + _NO_SUCCESS * no_success + _NOT_HELD * not_held


def rest_ranks(obj: GraspObject, rests: np.ndarray, request: GraspRequest) -> np.ndarray:
    """(B,) ranks of the resting poses: upright first, then by likelihood; zeros if the request
    names one.
    """
    if request.rest is not None:
        return np.zeros_like(rests)
    upright = upright_rest(obj)
    if upright is None:
        return rests
    return np.where(rests == upright, 0, rests + (rests < upright))
