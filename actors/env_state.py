"""State of the environments between two control steps, and the result of a step."""

from typing import Any, NamedTuple

from congrasp.actors.harvest import Grasps
from congrasp.actors.physics.engine import ResetState
from congrasp.actors.sensing import Sensing
from congrasp.actors.stress import Frame, Protocol
from congrasp.actors.success import Success
from congrasp.common.task.traced_settings import ControlConfig, RewardWeights
from congrasp.common.task.types import Array, Features, Goal, SceneState, Surface


class Settings(NamedTuple):
    """Settings that may change between steps without recompilation."""

    weights: RewardWeights
    control: ControlConfig
    protocol: Protocol | None = None
    """Lift and pushes after the table's removal; none by default."""
    probe_data: Any = None
    """Additional arrays for the probe of a rollout."""
    masses: Array | None = None
    """(N,) masses of the engine's objects, kg, if the critic's privileged inputs are recorded."""


class View(NamedTuple):
    """One control step and the geometry that the task's terms share."""

    state: SceneState
    features: Features


class Views(NamedTuple):
    """A control step in the true state, and as observed by the policy."""

    true: View
    sensed: View | None
    """Scene from the sensors; None if the policy observes the true state."""


class EnvState(NamedTuple):
    """A batch of B environments between two control steps."""

    physics: Any
    """State of the engine; None for an engine that keeps it internally."""
    views: Views | None
    """Scene after the step; None inside a loop around an engine that is not compiled."""
    reset_state: ResetState
    """Initial states of the current episodes."""
    goal: Goal
    """Active constraints."""
    surface: Surface
    """Surface points of the objects."""
    region: Array
    """(B,) int: region of the constraint bank from which the episodes were drawn."""
    hold: Array
    """(B,) control steps without the table that the episode's metrics cover."""
    after: Array
    """(B,) control steps after those, before the episode ends."""
    frame: Frame
    """The carried frame in which the episode is observed; the world frame without a protocol."""
    time: Array
    """(B,) control steps since the start of the episode."""
    q_target: Array
    """(B, F) targets of the previous step."""
    u_target: Array
    """(B, 6)."""
    momentum: Array
    """(B, 6) momentum of the observer of the wrist's load (`common.task.control.track_load`)."""
    sensing: Sensing | None
    """Sensors and their latest readings; None if the policy observes the true state."""
    success: Success
    """Progress of the success protocol."""
    sums: dict[str, Array]
    """Sums (B,) of errors, forces and reward over the episode."""
    terms: Array
    """(B, terms) sums of the reward terms over the episode."""
    grasps: Grasps
    """Grasps of successful episodes that may become references."""
    finished: Array
    """(B, fields) metrics of the last finished episode, in the order of `episode_fields`."""
    has_finished: Array
    """(B,) bool: an episode has ended since the flag was cleared."""


class Transition(NamedTuple):
    """Result of one control step."""

    reward: Array
    """(B,)."""
    terminal: Array
    """(B,) bool: the episode ended with this step."""
    truncated: Array
    """(B,) bool: it ended by the time limit while the object was held, in a state that has a
    value.
    """
    terms: Array
    """(B, terms) weighted reward terms."""
    errors: dict[str, tuple[Array, Array]]
    """Numerator and denominator (B,) of every error of the constraints."""
    occupancy: Array
    """(3,) occupancy of the engine's buffers, see `actors.physics.engine.PhysicsState`."""
