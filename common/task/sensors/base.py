"""Interface of a sensor: everything that the rest of the project derives from its file.

A sensor's module defines a subclass of `Sensor`, and `common.task.sensors.SENSORS` contains an
instance under its name, the value of `TaskSettings.observation`. The methods are hooks, in the
order of an episode:

* draw: random parameters of the episode
* begin, step: state of the sensor at the start and after each control step
* frame: pose of the object as shown, which is the frame of the constraints
* view: surface, goal and state of the control step as the policy observes them
* measurements and fields: further numbers of the observation, and of a query to a live policy

Joint angles, targets and the shown pose of the last `TaskSettings.history` control steps are
recorded for every sensor (`common.task.readings`).

Hooks that take batched arrays (leading axis B) are pure functions that may be traced.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

from congrasp.common.hands.spec import Hand
from congrasp.common.runtime.lazy_jax import jnp
from congrasp.common.task.constraints.specs import ObservationField
from congrasp.common.task.readings import Readings, with_readings, without_privileged
from congrasp.common.task.scene import Scene
from congrasp.common.task.sensors.parameters import SensorParameters, draw_parameters
from congrasp.common.task.settings import SensingConfig, TaskSettings
from congrasp.common.task.types import Array, Goal, SceneState, Surface


class EpisodeStart(NamedTuple):
    """True start of B episodes, as input of their sensors."""

    hand: Hand
    task: TaskSettings
    pose: Array
    """(B, 7) resting poses of the objects, world frame."""
    surface: Surface
    """Labelled surface points of the objects, object frame."""
    goal: Goal
    """Goals, object frame."""


class Moment(NamedTuple):
    """True state of B environments after a control step, as input of their sensors."""

    hand: Hand
    task: TaskSettings
    time: Array
    """(B,) int control steps since the start of the episodes, including this one."""
    state: SceneState
    """Hand and object in the carried frame: the world frame, except while a stress test lifts the
    hand (`actors.stress`).
    """
    object_position: Array
    """(B, 3) m, world frame."""
    lift: Array
    """(B, 3) m, position of the carried frame in the world frame."""
    surface: Surface
    """Labelled surface points of the objects, object frame."""


class Sensor:
    """A sensor of the object; subclasses override methods as needed."""

    privileged: ClassVar[bool] = False
    """True if the policy also observes what only a simulator knows: forces, contacts and
    velocities.
    """
    shows_pose: ClassVar[bool] = True
    """False if the sensor shows no pose of the object: observations and queries then lack every
    field that depends on it, and the object frame is the world frame.
    """
    points: ClassVar[str] = "surface_points"
    """Name of the object's points in a query."""

    # Draw.

    def draw(
        self, config: SensingConfig, control_dt: float, key: Array, batch: int
    ) -> SensorParameters:
        """Draws the parameters of B episodes.

        Further random numbers of a sensor follow from their `SensorParameters.key`.

        Args:
          config: ranges of the parameters.
          control_dt: seconds of a control step.
          key: random key.
          batch: number B of episodes.
        """
        return draw_parameters(config, control_dt, key, batch)

    # State.

    def begin(self, parameters: SensorParameters, start: EpisodeStart) -> Any:
        """Returns the state of the sensors, a pytree of arrays (B, ...), at episodes' starts."""
        raise NotImplementedError

    def step(self, parameters: SensorParameters, state: Any, moment: Moment) -> Any:
        """Returns the state of the sensors after a control step."""
        raise NotImplementedError

    # Frame.

    def pose(self, state: Any, lift: Array) -> Array:
        """Pose (B, 7) of the object as shown now, in the carried frame.

        Args:
          state: state of the sensors.
          lift: see `Moment`.
        """
        raise NotImplementedError

    def first_pose(self, state: Any) -> Array:
        """Pose (B, 7) of the resting object as shown at the start of the episode."""
        raise NotImplementedError

    # View.

    def view(self, state: Any, surface: Surface, goal: Goal) -> tuple[Surface, Goal]:
        """Points of the object and goal as the policy observes them, in its object frame.

        Args:
          state: state of the sensors.
          surface: true labelled surface points, object frame.
          goal: true goal, object frame.
        """
        return surface, goal

    def seen(self, task: TaskSettings, state: SceneState, readings: Readings) -> SceneState:
        """Returns a control step as observed by the policy: the pose shown and the newest targets.

        Args:
          task: the task.
          state: the true state, except for the object's initial pose, which must be the
            `first_pose`.
          readings: the last control steps.
        """
        state = with_readings(state, readings)
        if self.privileged:
            return state
        return without_privileged(state, readings, task.control_dt)

    # Measurements and fields.

    def measure(self, state: Any) -> Mapping[str, Array]:
        """Further measurements (B, ...), which `Scene.measured` contains in `observe`."""
        return {}

    def query(self, hand: Hand, task: TaskSettings) -> Mapping[str, tuple[int, ...]]:
        """Shapes, without batch axis, of further fields of a query to a live policy.

        They include the fields of `measure`.
        """
        return {}

    def fields(self, hand: Hand, task: TaskSettings) -> Mapping[str, tuple[ObservationField, ...]]:
        """Fields that the observation has in addition, by block: at the end of `state`, or `cloud`,
        points for the network's layers of points.
        """
        return {}

    def observe(self, scene: Scene) -> Mapping[str, Sequence[Array]]:
        """Values (B, ...) of the `fields` of each block."""
        return {}

    # Reports.

    def describe(self, task: TaskSettings) -> str:
        """Returns a sentence on the policy's observation for reports."""
        raise NotImplementedError


def robot_inputs(task: TaskSettings) -> str:
    """Beginning of the sentence that describes a robot's observation."""
    return (
        f"It observes the last {task.history} control steps of joint angles, the wrist, their "
        f"targets"
    )


def world_pose(batch: int) -> Array:
    """Returns the pose (B, 7) of the world frame: position, m, and quaternion."""
    return jnp.broadcast_to(jnp.array((0.0, 0, 0, 1, 0, 0, 0)), (batch, 7))
