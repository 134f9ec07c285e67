"""Limits of tasks and networks that come from files or messages, and limits of a simulation."""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Any

from congrasp.common.config import NetworkConfig
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
MAX_INPUTS, MAX_ACTIONS = 16_384, 256
"""Largest sizes of a policy's observation and action."""
_TASK: dict[str, tuple[float, float]] = {
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
_SENSING = {
    "period": 10.0,
    "delay": 1.0,
    "position_noise": 1.0,
    "rotation_noise": 3.2,
    "dropout": 1.0,
    "camera_distance": 10.0,
    "camera_elevation": 1.5,
}
"""Upper bounds of the ranges of a task's tracker or camera."""
_LAYERS, _UNITS = 16, 8192


def task_faults(task: TaskConfig) -> Iterator[str]:
    """Yields the fields of a task that are out of range, one phrase each."""
    yield from _numbers(task)
    if task.observation not in SENSORS:
        yield f"observation is '{task.observation[:60]}', not one of {', '.join(SENSORS)}"
    for name, (low, high) in _TASK.items():
        value = getattr(task, name)
        if not low <= value <= high:
            yield f"{name} is {value:g}, not {low:g} to {high:g}"
    for name in ("mass_range", "friction_range", "gain_range"):
        low, high = getattr(task, name)
        if not 0 <= low <= high:
            yield f"{name} is {low:g} to {high:g}"
    for name, most in {**_SENSING, "latency": (task.history - 1) * task.control_dt}.items():
        low, high = getattr(task.sensing, name)
        if not 0 <= low <= high <= most:
            yield f"{name} is {low:g} to {high:g}, not within 0 and {most:g}"


def network_faults(
    network: NetworkConfig, layout: Sequence[tuple[str, int]], action_size: int
) -> Iterator[str]:
    """Yields the sizes of a policy's networks, observation and action that are out of range, one
    phrase each.
    """
    yield from _numbers(network)
    if not 1 <= len(network.hidden) <= _LAYERS or not all(
        1 <= units <= _UNITS for units in network.hidden
    ):
        yield (
            f"hidden is {str(network.hidden)[:60]}, not 1 to {_LAYERS} layers of 1 to {_UNITS} "
            f"units"
        )
    if not 1 <= len(network.points) <= _LAYERS or not all(
        1 <= units <= _UNITS for units in network.points
    ):
        yield (
            f"points is {str(network.points)[:60]}, not 1 to {_LAYERS} layers of 1 to {_UNITS} "
            f"units"
        )
    if not 1 <= network.encoder <= _UNITS:
        yield f"encoder is {network.encoder}, not 1 to {_UNITS}"
    sizes = [size for _, size in layout]  # a policy of headings only has no mask
    if (
        not all(size >= (name != "mask") for name, size in layout)
        or not 1 <= sum(sizes) <= MAX_INPUTS
    ):
        yield f"the observation has {str(sizes)[:60]} values, not 1 to {MAX_INPUTS}"
    if not 1 <= action_size <= MAX_ACTIONS:
        yield f"the action has {action_size} values, not 1 to {MAX_ACTIONS}"


def _numbers(config: Any) -> Iterator[str]:
    """Yields numbers of a configuration, at any depth, that are not finite or too large."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from _numbers(value)
            continue
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, (int, float)) and not (
                math.isfinite(number) and abs(number) <= MAX_NUMBER
            ):
                yield f"{field.name} is not a finite number of at most {MAX_NUMBER:g}"
