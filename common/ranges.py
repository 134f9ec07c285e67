"""Limits of runs, tasks and networks that come from options, files or messages, and limits of a
simulation.
"""

import dataclasses
import math
import operator
from collections.abc import Iterator, Sequence
from typing import Any

from congrasp.common.config import NetworkConfig, RunConfig
from congrasp.common.objects.spec import SURFACE_POINTS
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.sensors import SENSORS

MAX_SPEED = 400.0
"""A joint speed above this (m/s or rad/s) marks a diverged environment."""
MAX_DISTANCE = 25.0
"""A joint position beyond this (m or rad) marks a diverged environment; a free fall of 2 s stays
below it.
"""
MAX_NUMBER = 1e6
"""Largest absolute value of any field."""
MAX_INPUTS = 16_384
"""Largest size of a policy's observation."""
MAX_ACTIONS = 256
"""Largest size of a policy's action."""
_TASK_LIMITS: dict[str, tuple[float, float]] = {
    "object_scale": (0.0, 100.0),
    "control_dt": (1e-4, 1.0),
    "substeps": (1, 100),
    "impratio": (0.1, 10_000.0),
    "approach_steps": (1, 10_000),
    "hold_steps": (1, 10_000),
    "hold_steps_max": (1, 10_000),
    "surface_points": (1, SURFACE_POINTS),
    "trajectory_points": (2, 1000),
    "history": (2, 64),
}
_COUNT = (1, math.inf)
_NOT_NEGATIVE = (0.0, math.inf)
_POSITIVE = (math.ulp(0.0), math.inf)
_SHARE = (0.0, 1.0)
_RUN_LIMITS: dict[str, tuple[float, float]] = {
    "environments": _COUNT,
    "rollout_steps": _COUNT,
    "rollouts_per_update": _COUNT,
    "max_staleness": _NOT_NEGATIVE,
    "updates": _COUNT,
    "checkpoint_every": _COUNT,
    "collapse_patience": _NOT_NEGATIVE,
    "episode_every": _COUNT,
    "log_rollout_every": _NOT_NEGATIVE,
    "log_rollout_worlds": _NOT_NEGATIVE,
    "objects.procedural": _NOT_NEGATIVE,
    "objects.folder_share": _SHARE,
    "objects.renew_every": _NOT_NEGATIVE,
    "network.initial_std": _POSITIVE,
    "ppo.epochs": _COUNT,
    "ppo.minibatches": _COUNT,
    "ppo.clip": _POSITIVE,
    "ppo.importance_max": _POSITIVE,
    "ppo.gamma": _SHARE,
    "ppo.gae_lambda": _SHARE,
    "ppo.learning_rate": _POSITIVE,
    "ppo.kl_target": _POSITIVE,
    "ppo.settling": _SHARE,
    "ppo.final_std": _NOT_NEGATIVE,
    "ppo.least_std": _NOT_NEGATIVE,
    "ppo.value_coefficient": _NOT_NEGATIVE,
    "ppo.max_grad_norm": _POSITIVE,
    "ppo.reward_scale": _POSITIVE,
    "distill.epochs": _COUNT,
    "distill.minibatches": _COUNT,
    "distill.learning_rate": _POSITIVE,
    "distill.max_grad_norm": _POSITIVE,
    "curriculum.stationary_updates": _NOT_NEGATIVE,
}
"""Limits of a run's settings."""
_ORDERED = ("ppo.learning_rate_range", "curriculum.ramp")
"""Settings of a run with a first and a last value, neither below zero."""
_SENSING_LIMITS = {
    "period": 10.0,
    "delay": 1.0,
    "position_noise": 1.0,
    "rotation_noise": 3.2,
    "dropout": 1.0,
    "camera_distance": 10.0,
    "camera_elevation": 1.5,
}
"""Upper bounds of the ranges of a task's tracker or camera."""
_MAX_LAYERS = 16
"""Most layers of a network."""
_MAX_UNITS = 8192
"""Most units of a layer."""


def run_faults(config: RunConfig) -> Iterator[str]:
    """Yields the options of a run and of its task that are out of range, one phrase each."""
    for name, (low, high) in _RUN_LIMITS.items():
        value = operator.attrgetter(name)(config)
        if low <= value <= high and math.isfinite(value):
            continue
        yield option_fault("", f"{name} is {value:g}, not {_limits_in_words(low, high)}")
    for name in _ORDERED:
        first, last = operator.attrgetter(name)(config)
        if not 0 <= first <= last < math.inf:
            yield option_fault("", f"{name} is {first:g} to {last:g}")
    transitions = config.rollouts_per_update * config.environments * config.rollout_steps
    if config.algorithm == "ppo" and config.ppo.minibatches > transitions:
        yield (
            f"--ppo.minibatches is {config.ppo.minibatches}, more than the {transitions} "
            "transitions of an update"
        )
    for fault in task_faults(config.task):
        yield option_fault("task.", fault)


def _limits_in_words(low: float, high: float) -> str:
    """Limits of a number in an error."""
    if (low, high) == _POSITIVE:
        return "above 0"
    if high == math.inf:
        return f"{low:g} or more"
    return f"{low:g} to {high:g}"


def option_fault(group: str, fault: str) -> str:
    """Returns a phrase that begins with a setting as one that begins with its option.

    Args:
      group: group of the option, with a dot at its end.
      fault: the phrase.
    """
    name, _, rest = fault.partition(" ")
    return f"--{group}{name.replace('_', '-')} {rest}"


def task_faults(task: TaskConfig) -> Iterator[str]:
    """Yields the fields of a task that are out of range, one phrase each."""
    yield from _numbers(task)
    if task.observation not in SENSORS:
        yield f"observation is '{task.observation[:60]}', not one of {', '.join(SENSORS)}"
    for name, (low, high) in _TASK_LIMITS.items():
        value = getattr(task, name)
        if not low <= value <= high:
            yield f"{name} is {value:g}, not {low:g} to {high:g}"
    for name in ("mass_range", "friction_range", "gain_range"):
        low, high = getattr(task, name)
        if not 0 <= low <= high:
            yield f"{name} is {low:g} to {high:g}"
    max_latency = (task.history - 1) * task.control_dt
    for name, limit in {**_SENSING_LIMITS, "latency": max_latency}.items():
        low, high = getattr(task.sensing, name)
        if not 0 <= low <= high <= limit:
            yield f"{name} is {low:g} to {high:g}, not within 0 and {limit:g}"


def network_faults(
    network: NetworkConfig, layout: Sequence[tuple[str, int]], action_size: int
) -> Iterator[str]:
    """Yields the sizes of a policy's networks, observation and action that are out of range, one
    phrase each.
    """
    yield from _numbers(network)
    yield from _layer_faults("hidden", network.hidden)
    yield from _layer_faults("points", network.points)
    if not 1 <= network.encoder <= _MAX_UNITS:
        yield f"encoder is {network.encoder}, not 1 to {_MAX_UNITS}"
    sizes = [size for _, size in layout]
    has_sizes = all(size >= _min_size(block) for block, size in layout)
    if not has_sizes or not 1 <= sum(sizes) <= MAX_INPUTS:
        yield f"the observation has {str(sizes)[:60]} values, not 1 to {MAX_INPUTS}"
    if not 1 <= action_size <= MAX_ACTIONS:
        yield f"the action has {action_size} values, not 1 to {MAX_ACTIONS}"


def _layer_faults(name: str, units: Sequence[int]) -> Iterator[str]:
    """Yields a phrase if the number of layers, or the units of one, are out of range."""
    has_layers = 1 <= len(units) <= _MAX_LAYERS
    if not has_layers or not all(1 <= count <= _MAX_UNITS for count in units):
        yield (
            f"{name} is {str(units)[:60]}, not 1 to {_MAX_LAYERS} layers of 1 to {_MAX_UNITS} units"
        )


def _min_size(block: str) -> int:
    """Smallest size of a block of the observation: a policy of headings only has no mask."""
    return 0 if block == "mask" else 1


def _numbers(config: Any) -> Iterator[str]:
    """Yields numbers of a configuration, at any depth, that are not finite or too large."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from _numbers(value)
            continue
        numbers = value if isinstance(value, tuple) else (value,)
        for number in numbers:
            if not isinstance(number, (int, float)):
                continue
            if not math.isfinite(number) or abs(number) > MAX_NUMBER:
                yield f"{field.name} is not a finite number of at most {MAX_NUMBER:g}"
