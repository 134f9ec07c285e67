"""Errors of one control step, with the paper's definitions (section Metrics), and the metrics of an
episode.
"""

from collections.abc import Mapping

import jax.numpy as jnp

from congrasp.common.task.constraints import blocks, error_specs, known
from congrasp.common.task.constraints.specs import ErrorSpec
from congrasp.common.task.reward import terms
from congrasp.common.task.scene import Scene
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array

FORCES = ("force_sum", "force_link_max")
"""Metrics of the contact forces, N."""
DIVERGED = "diverged"
"""Metric of an episode whose simulation became unstable."""


def metric_names(task: TaskSettings) -> tuple[str, ...]:
    """Metrics of a finished episode: outcome, errors of the constraints, forces, and active
    blocks.
    """
    return (
        "success",
        "held",
        "return",
        "length",
        "links_at_removal",
        "moved_at_removal",
        *(spec.name for spec in specs(task)),
        *FORCES,
        DIVERGED,
        *(f"mask_{name}" for name in blocks(task)),
        "object_index",
    )


def episode_fields(task: TaskSettings) -> tuple[str, ...]:
    """Wire names of an actor's report of a finished episode: metrics, then sums of reward terms."""
    metrics = [f"episode/{name}" for name in metric_names(task)]
    reward = [f"term/{name}" for name in terms(task)]
    return (*metrics, *reward)


def specs(task: TaskSettings) -> tuple[ErrorSpec, ...]:
    """Errors of the constraints supported by a task."""
    return error_specs(known(task))


def errors(scene: Scene) -> dict[str, tuple[Array, Array]]:
    """Numerator and denominator (B,) of every error in one step, whether or not its constraint is
    active.
    """
    one = jnp.ones_like(scene.state.time)
    ratios = {}
    for constraint in known(scene.task):
        for name, value in constraint.measure(scene).items():
            ratios[name] = value if isinstance(value, tuple) else (value, one)
    return ratios


def accumulate(
    task: TaskSettings,
    sums: Mapping[str, Array],
    step: Mapping[str, tuple[Array, Array]],
    approach: Array,
    hold: Array,
) -> dict[str, Array]:
    """Adds one step to the sums of an episode.

    Args:
      task: the task, for its errors.
      sums: (B,) sums so far, of numerators and of denominators.
      step: `errors` of the step.
      approach: (B,) bool, True if the step belongs to the approach.
      hold: (B,) bool, True if the step belongs to the paper's hold.
    """
    total = {}
    for spec in specs(task):
        in_window = approach if spec.window == "approach" else hold
        counts = in_window.astype(jnp.float32)
        numerator, denominator = step[spec.name]
        total[spec.name] = sums[spec.name] + numerator * counts
        total[_denominator(spec)] = sums[_denominator(spec)] + denominator * counts
    return total


def empty_sums(task: TaskSettings, batch: int) -> dict[str, Array]:
    """Sums before the first step."""
    zero = jnp.zeros(batch)
    sums = {}
    for spec in specs(task):
        sums[spec.name] = zero
        sums[_denominator(spec)] = zero
    return sums


def _denominator(spec: ErrorSpec) -> str:
    """Name of the sum of an error's denominators."""
    return f"{spec.name}/of"


def episode_errors(task: TaskSettings, sums: Mapping[str, Array]) -> dict[str, Array]:
    """Errors (B,) of an episode by name: means over the summed steps, or ratios of two sums.

    The value is zero if there were no steps, as for errors of the hold when the table stays.
    """
    return {
        spec.name: sums[spec.name] / jnp.maximum(sums[_denominator(spec)], 1.0)
        for spec in specs(task)
    }
