"""One control step of B environments, as input of observation, reward and errors."""

from collections.abc import Mapping
from typing import NamedTuple

from congrasp.common.hands.spec import Hand
from congrasp.common.runtime.lazy_jax import jnp
from congrasp.common.task.grip import ObjectLoad
from congrasp.common.task.readings import Readings
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array, Features, Goal, SceneState, Surface

_NOTHING_MEASURED: Mapping[str, Array] = {}
"""A dictionary, since JAX knows no read-only one."""


class Scene(NamedTuple):
    """State, derived geometry and goal of a control step, with the hand and the task."""

    hand: Hand
    task: TaskSettings
    state: SceneState
    features: Features
    goal: Goal
    surface: Surface
    """Points of the object that the features are of: those of its surface, object frame, or of a
    camera's cloud, world frame."""
    readings: Readings | None = None
    """Last control steps, if the policy observes them."""
    measured: Mapping[str, Array] = _NOTHING_MEASURED
    """Further measurements (B, ...) of the policy's sensor (`common.task.sensors.base`)."""
    load: ObjectLoad | None = None
    """Weight and friction of the objects, for the reward; None where they are not recorded."""

    def gate(self, block: str) -> Array:
        """(B,) 1 if a block is active, else 0."""
        return self.goal.active[block].astype(jnp.float32)
