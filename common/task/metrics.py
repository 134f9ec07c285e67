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
DIVERGED = "diverged"


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
    return (
        *(f"episode/{name}" for name in metric_names(task)),
        *(f"term/{name}" for name in terms(task)),
    )


def specs(task: TaskSettings) -> tuple[ErrorSpec, ...]:
    """Errors of the constraints supported by a task."""
    return error_specs(known(task))


def errors(scene: Scene) -> dict[str, tuple[Array, Array]]:
    """Numerator and denominator (B,) of every error in one step, whether or not its constraint is
    active.
    """
    found = {
        name: value
        for constraint in known(scene.task)
        for name, value in constraint.measure(scene).items()
    }
    one = jnp.ones_like(scene.state.time)
    return {
        name: value if isinstance(value, tuple) else (value, one) for name, value in found.items()
    }


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
        counts = (approach if spec.window == "approach" else hold).astype(jnp.float32)
        for name, value in zip((spec.name, f"{spec.name}/of"), step[spec.name], strict=True):
            total[name] = sums[name] + value * counts
    return total


def empty_sums(task: TaskSettings, batch: int) -> dict[str, Array]:
    """Sums before the first step."""
    zero = jnp.zeros(batch)
    return {name: zero for spec in specs(task) for name in (spec.name, f"{spec.name}/of")}


def episode_errors(task: TaskSettings, sums: Mapping[str, Array]) -> dict[str, Array]:
    """Errors (B,) of an episode by name: means over the summed steps, or ratios of two sums.

    The value is zero if there were no steps, as for errors of the hold when the table stays.
    """
    return {
        spec.name: sums[spec.name] / jnp.maximum(sums[f"{spec.name}/of"], 1.0)
        for spec in specs(task)
    }
