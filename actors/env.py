"""The environment: `reset` and `step` over a batch of hands and objects.

A step consists of `targets`, the physics step, and `advance`. An engine that JAX cannot trace is
called between the two compiled halves (`actors.worker`); for traceable engines `step` combines all
three.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from congrasp.actors import harvest
from congrasp.actors import stress as protocols
from congrasp.actors.harvest import Grasps
from congrasp.actors.initial import InitialConditions
from congrasp.actors.physics.engine import Physics, PhysicsState, ResetState
from congrasp.actors.stress import Frame, Protocol
from congrasp.common.hands.motors import motor_positions
from congrasp.common.hands.spec import Hand
from congrasp.common.task import camera as cameras
from congrasp.common.task import metrics, privileged, sensing
from congrasp.common.task.camera import Camera
from congrasp.common.task.config import ControlConfig, RewardWeights, TaskConfig
from congrasp.common.task.constraints import blocks
from congrasp.common.task.control import decode, track_load, wrist_load
from congrasp.common.task.features import features
from congrasp.common.task.grip import ObjectLoad
from congrasp.common.task.metrics import DIVERGED, FORCES, episode_fields, metric_names
from congrasp.common.task.reward import fallen, reward_terms, terms
from congrasp.common.task.scene import Scene
from congrasp.common.task.sensing import Readings, Tracker
from congrasp.common.task.settings import GRAVITY
from congrasp.common.task.types import Action, Array, Features, Goal, SceneState, Surface


class Success(NamedTuple):
    """Progress of the success protocol in B episodes."""

    removal_height: Array
    """(B,) height of the object when the table was removed, m."""
    links_at_removal: Array
    """(B,) number of links in contact at that time."""
    moved_at_removal: Array
    """(B,) displacement of the object up to that time, m."""
    kept: Array
    """(B,) bool: the object had not fallen `hold_steps` after the removal (the paper's success)."""
    diverged: Array
    """(B,) bool: the physics diverged in this episode."""


def begin_success(height: Array) -> Success:
    """Returns the initial progress of episodes whose objects start at these heights (B,)."""
    zero, no = jnp.zeros_like(height), jnp.zeros(height.shape, bool)
    return Success(height, zero, zero, no, no)


def track_success(
    task: TaskConfig, success: Success, scene: Scene, diverged: Array
) -> tuple[Success, Array]:
    """Advances the protocol by one control step.

    Args:
      task: the task, for the time of the table's removal and the drop height.
      success: progress before the step.
      scene: scene after the step.
      diverged: (B,) bool, True if the physics diverged in this step.

    Returns:
      Progress after the step, and (B,) bool, True if the object is up.
    """
    state = scene.state
    removed_now = state.time == task.approach_steps
    height = state.object_position[:, 2]
    links = jnp.sum(scene.features.touching, -1).astype(jnp.float32)
    moved = jnp.linalg.norm(state.object_position - state.object_position_initial, axis=-1)
    success = success._replace(
        removal_height=jnp.where(removed_now, height, success.removal_height),
        links_at_removal=jnp.where(removed_now, links, success.links_at_removal),
        moved_at_removal=jnp.where(removed_now, moved, success.moved_at_removal),
        diverged=success.diverged | diverged,
    )
    up = (
        (height > success.removal_height - task.drop_height)
        & ~fallen(task, state)
        & ~success.diverged
    )
    up &= success.links_at_removal > 0
    return success._replace(
        kept=jnp.where(state.time == task.approach_steps + task.hold_steps, up, success.kept)
    ), up


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
    tracker: Tracker | None
    """Trackers of the objects' poses; None if the policy observes the true ones."""
    camera: Camera | None
    """Cameras, which replace the trackers; None if the policy has none."""
    readings: Readings | None
    """Latest readings of the sensors; None if the policy observes the true state."""
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


class GraspEnv:
    """The grasping task on a physics engine."""

    def __init__(self, hand: Hand, task: TaskConfig, engine: Physics | None):
        """Creates the environment; nothing is allocated yet.

        Args:
          hand: the hand.
          task: the task.
          engine: an engine that JAX can trace, with the objects that initial conditions refer to by
            index; None for one that is stepped outside, between `targets` and `advance`.
        """
        self.hand, self.task, self._engine = hand, task, engine
        self.settings = Settings(task.reward, task.control)

    @property
    def _traced(self) -> Physics:
        """The engine, for the methods that call it."""
        assert self._engine is not None, "the engine is stepped outside"
        return self._engine

    def reset(self, initial: InitialConditions) -> EnvState:
        """Starts episodes from initial conditions, in every environment."""
        return self.state_of(initial, self._traced.start(initial.reset_state))

    def state_of(self, initial: InitialConditions, physics: Any) -> EnvState:
        """Returns the state of episodes whose engine was just started from their `reset_state`."""
        state = self._begun(initial)._replace(physics=physics)
        return state if self._engine is None else self.with_scene(state, self._engine.read(physics))

    def _begun(self, initial: InitialConditions) -> EnvState:
        """State of episodes that begin, without their engine and their scene."""
        batch = initial.reset_state.q.shape[0]
        zero, no, index = jnp.zeros(batch), jnp.zeros(batch, bool), jnp.zeros(batch, jnp.int32)
        reset_state = initial.reset_state
        sums = {**metrics.empty_sums(self.task, batch), **dict.fromkeys(("return", *FORCES), zero)}
        return EnvState(
            physics=None,
            views=None,
            reset_state=reset_state,
            goal=initial.goal,
            surface=initial.surface,
            region=initial.region,
            hold=initial.hold,
            after=index,
            frame=Frame(zero, zero, zero),
            time=index,
            q_target=reset_state.q,
            u_target=jnp.zeros((batch, 6)),
            momentum=jnp.zeros((batch, 6)),
            **self._first_readings(initial),
            success=begin_success(reset_state.object_position[:, 2]),
            sums=sums,
            terms=jnp.zeros((batch, len(terms(self.task)))),
            grasps=Grasps(
                no,
                index,
                index,
                reset_state.q,
                reset_state.base_position,
                reset_state.base_quaternion,
            ),
            finished=jnp.zeros((batch, len(episode_fields(self.task)))),
            has_finished=no,
        )

    def restart(self, state: EnvState, rows: Array, initial: InitialConditions) -> EnvState:
        """Starts K new episodes; the other environments continue, with their contacts.

        Only the episodes that start are computed: sampling them and their scene cost several times
        a step of the task.

        Args:
          state: the environments; an engine that is stepped outside is reset separately, to the new
            `reset_state`.
          rows: (K,) int, environments in which the episodes start; numbers from B on are ignored.
          initial: the episodes (K,).
        """

        def placed(new: Any, old: Any) -> Any:
            return jax.tree.map(lambda some, every: every.at[rows].set(some, mode="drop"), new, old)

        fresh, names = (
            self._begun(initial),
            ("physics", "views", "grasps", "finished", "has_finished"),
        )
        kept: dict[str, Any] = {name: getattr(state, name) for name in names}
        without: dict[str, Any] = dict.fromkeys(names)
        merged: EnvState = placed(fresh._replace(**without), state._replace(**without))._replace(
            **kept
        )
        if self._engine is None:
            return merged
        started = jnp.zeros(len(state.time), bool).at[rows].set(True, mode="drop")
        physics = self._engine.reset(state.physics, started, merged.reset_state)
        seen = self._engine.read(physics)
        some: dict[str, Any] = {
            name: array[rows] for name, array in seen._asdict().items() if name != "occupancy"
        }
        scene = self.with_scene(fresh, seen._replace(**some))
        return merged._replace(physics=physics, views=placed(scene.views, state.views))

    def step(
        self, state: EnvState, action: Array, settings: Settings | None = None
    ) -> tuple[EnvState, Transition]:
        """Simulates one control step of a traceable engine; finished episodes are not restarted.

        Args:
          state: the environments.
          action: (B, M + 6) residual action.
          settings: reward weights and control, possibly traced; those of the task by default.
        """
        settings = settings or self.settings
        target, command = self.targets(state, action, settings)
        physics, physics_state = self._traced.step(state.physics, *command)
        return self.advance(state._replace(physics=physics), target, physics_state, settings)

    def targets(
        self, state: EnvState, action: Array, settings: Settings
    ) -> tuple[Action, tuple[Array, ...]]:
        """Returns the joint targets of an action, and the inputs of the engine's step
        (`Physics.step`).
        """
        target, table = (
            decode(self.seen(state), settings.control, action),
            self.table_present(state),
        )
        followed = self._followed(state, target)
        motors = motor_positions(self.hand, followed.q_target)
        if settings.protocol is None:
            return target, (jnp.concatenate([followed.u_target, motors], -1), table)
        start, time = state.reset_state, state.time
        frame = protocols.frame(settings.protocol, self.task, time + 0.5)
        table = table | settings.protocol.table
        u_target = protocols.carried_targets(
            followed.u_target, self.hand, start.base_quaternion, frame
        )
        force = protocols.push(
            settings.protocol, self.task, time, start.object_index, start.mass_scale
        )
        return target, (jnp.concatenate([u_target, motors], -1), table, force)

    def advance(
        self, state: EnvState, target: Action, physics_state: PhysicsState, settings: Settings
    ) -> tuple[EnvState, Transition]:
        """Completes a control step after the engine has simulated it.

        Args:
          state: state before the step, except for `physics`, which is after it.
          target: joint targets of the step.
          physics_state: state of the engine after the step.
          settings: see `step`.
        """
        task, had_table = self.task, self.table_present(state)
        state = state._replace(
            time=state.time + 1,
            q_target=jnp.where(
                physics_state.diverged[:, None], state.reset_state.q, target.q_target
            ),
            u_target=jnp.where(physics_state.diverged[:, None], 0.0, target.u_target),
        )
        if settings.protocol is not None:
            state = state._replace(frame=protocols.frame(settings.protocol, task, state.time))
        moved = protocols.carried(physics_state, state.reset_state.base_quaternion, state.frame)
        followed = self._followed(state, Action(state.q_target, state.u_target))
        momentum = track_load(
            self.hand, task, state.momentum, moved.u, moved.u_velocity, followed.u_target
        )
        state = state._replace(momentum=jnp.where(physics_state.diverged[:, None], 0.0, momentum))
        state = self._viewed(self._sense(state, physics_state, moved), moved, followed)
        scene = self.scene_of(state)
        tracked, up = track_success(task, state.success, scene, physics_state.diverged)
        scene = scene._replace(load=self._object_load(state, settings))
        found = reward_terms(scene, settings.weights)
        found["drop"] = jnp.where(tracked.diverged, -settings.weights.drop, found["drop"])
        stacked = jnp.stack([found[name] for name in terms(task)], -1)
        reward = jnp.sum(stacked, -1)
        error = metrics.errors(scene)
        # The paper's window ends `hold_steps` after the removal, however long the episode
        # continues.
        window = ~had_table & (state.time <= task.approach_steps + task.hold_steps)
        force = jnp.linalg.norm(scene.features.force, axis=-1)
        state = state._replace(
            success=tracked,
            grasps=harvest.collect(
                scene, state.grasps, error, up, state.reset_state.object_index, state.region
            ),
            sums={
                **metrics.accumulate(task, state.sums, error, had_table, window),
                "return": state.sums["return"] + reward,
                "force_sum": state.sums["force_sum"] + jnp.sum(force, -1) * window,
                "force_link_max": state.sums["force_link_max"] + jnp.max(force, -1) * window,
            },
            terms=state.terms + stacked,
        )
        counts, terminal = self._ends(state, up)
        finished = jnp.where(counts[:, None], self._episode(state, up), state.finished)
        state = state._replace(finished=finished, has_finished=state.has_finished | counts)
        # If the object is not held, any end is final: the reward already contains the fall.
        transition = Transition(
            reward=reward,
            terminal=terminal,
            truncated=terminal & up,
            terms=stacked,
            errors=error,
            occupancy=physics_state.occupancy,
        )
        return state, transition

    def _ends(self, state: EnvState, up: Array) -> tuple[Array, Array]:
        """(B,) bool each: the episode's metrics are complete with this step, and the episode ends
        with it.
        """
        task = self.task
        over = state.time - state.hold - task.approach_steps
        counts, terminal = over == 0, over >= state.after
        if task.end_when_fallen:
            fell = (state.time >= task.approach_steps + task.hold_steps) & ~up & (over < 0)
            counts, terminal = counts | fell, terminal | fell
        return counts, terminal

    def with_scene(self, state: EnvState, physics_state: PhysicsState) -> EnvState:
        """Returns the environments with the scene of an engine that has simulated no step since the
        last `advance`.
        """
        moved = protocols.carried(physics_state, state.reset_state.base_quaternion, state.frame)
        return self._viewed(state, moved, self._followed(state))

    def _viewed(self, state: EnvState, moved: PhysicsState, followed: Action) -> EnvState:
        """Returns the environments with their views of a scene in the carried frame, and these
        followed targets.
        """
        reset_state = state.reset_state
        physical = {
            name: value for name, value in moved._asdict().items() if name in SceneState._fields
        }
        scene = SceneState(
            **physical,
            q_target=followed.q_target,
            u_target=followed.u_target,
            base_position=reset_state.base_position,
            base_quaternion=reset_state.base_quaternion,
            q_initial=reset_state.q,
            object_position_initial=reset_state.object_position,
            object_quaternion_initial=reset_state.object_quaternion,
            wrist_load=wrist_load(self.hand, self.task, state.momentum, moved.u, moved.u_velocity),
            time=state.time.astype(jnp.float32),
            table=self.table_present(state),
        )
        sensed = None
        if state.readings is not None:
            first = state.tracker.first if state.tracker else cameras.world(len(scene.q))
            begun = scene._replace(
                object_position_initial=first[:, :3], object_quaternion_initial=first[:, 3:]
            )
            shown = (
                (state.camera.cloud, state.camera.goal)
                if state.camera
                else (state.surface, state.goal)
            )
            sensed = self._view(sensing.seen_by(self.task, begun, state.readings), *shown)
        return state._replace(views=Views(self._view(scene, state.surface, state.goal), sensed))

    def _view(self, scene: SceneState, surface: Surface, goal: Goal) -> View:
        """Returns a control step with its features."""
        return View(scene, features(self.hand, self.task, scene, surface, goal))

    def scene_of(self, state: EnvState) -> Scene:
        """Scene of the current control step, as input of the task's terms."""
        assert state.views is not None, "call `with_scene` first"
        return Scene(self.hand, self.task, *state.views.true, state.goal)

    def seen(self, state: EnvState) -> Scene:
        """Scene of the current control step as observed by the policy."""
        assert state.views is not None, "call `with_scene` first"
        view = state.views.sensed or state.views.true
        cloud, goal = (
            (state.camera.cloud, state.camera.goal) if state.camera else (None, state.goal)
        )
        return Scene(self.hand, self.task, *view, goal, state.readings, cloud)

    def privileged(self, state: EnvState) -> Scene:
        """Scene of the current control step as observed by a policy of the full state."""
        return self.scene_of(state)._replace(
            task=dataclasses.replace(self.task, observation="full")
        )

    def _object_load(self, state: EnvState, settings: Settings) -> ObjectLoad | None:
        """Weight and friction of the objects; None where the masses are not recorded."""
        if settings.masses is None:
            return None
        start = state.reset_state
        mass = settings.masses[start.object_index] * start.mass_scale
        return ObjectLoad(weight=GRAVITY * mass, friction=start.friction)

    def critic_inputs(self, state: EnvState, masses: Array) -> Array:
        """Privileged inputs (B, P) of the critic; `masses` are those of `Settings`."""
        start = state.reset_state
        sensor = state.camera or state.tracker
        parameters = privileged.Parameters(
            mass=masses[start.object_index] * start.mass_scale,
            friction=start.friction,
            gain_scale=start.gain_scale,
            stationary=start.stationary,
            hold=state.hold,
            sensors=None if sensor is None else sensor.sensors,
        )
        return privileged.observe(self.scene_of(state), parameters)

    def _first_readings(self, initial: InitialConditions) -> dict[str, Any]:
        """Initial tracker or camera, and readings, of episodes; None if the policy needs none."""
        found: dict[str, Any] = {"tracker": None, "camera": None, "readings": None}
        if not self.task.sensed:
            return found
        start, task = initial.reset_state, self.task
        steps = sensing.longest(task.sensing, task.control_dt)
        if task.observation == "camera":
            pose = jnp.concatenate([start.object_position, start.object_quaternion], -1)
            found["camera"] = cameras.begin(
                task, initial.sensors, steps, pose, initial.surface, initial.goal
            )
            shown = cameras.world(len(pose))
        else:
            found["tracker"] = sensing.begin(
                initial.sensors, steps, start.object_position, start.object_quaternion
            )
            shown = found["tracker"].shown
        wrist = jnp.zeros((len(start.q), 6))
        first = Readings(start.q, wrist, start.q, wrist, shown[:, :3], shown[:, 3:])
        return {**found, "readings": sensing.still(first, task.history)}

    def _sense(self, state: EnvState, physics_state: PhysicsState, moved: PhysicsState) -> EnvState:
        """Returns the environments with the sensors' readings after a control step, in the carried
        frame.

        Args:
          state: the environments.
          physics_state: state of the engine after the step.
          moved: the same in the carried frame.
        """
        if state.readings is None:
            return state
        tracker, camera, pose = state.tracker, state.camera, cameras.world(len(moved.q))
        if tracker is not None:
            true = physics_state.object_position, physics_state.object_quaternion
            tracker = sensing.track(
                tracker, state.time, *true, self.table_present(state), self.task.sensing.settle
            )
            pose = tracker.shown - jnp.pad(protocols.up(state.frame.height), ((0, 0), (0, 4)))
        if camera is not None:
            camera = cameras.look(
                self.hand, camera, state.time, moved, state.reset_state, state.surface
            )
        newest = Readings(
            moved.q, moved.u, state.q_target, state.u_target, pose[:, :3], pose[:, 3:]
        )
        return state._replace(
            tracker=tracker, camera=camera, readings=sensing.push(state.readings, newest)
        )

    def _followed(self, state: EnvState, newest: Action | None = None) -> Action:
        """Returns the targets that the servos follow in a step with its `newest` targets, or
        followed in the last.
        """
        if state.readings is None or not self.task.sensing.latency[1]:
            return newest or Action(state.q_target, state.u_target)
        sensor = state.camera or state.tracker
        assert sensor is not None, "readings are of a sensor"
        past = Action(state.readings.q_target, state.readings.u_target)
        if newest is not None:
            past = Action(
                *(
                    jnp.concatenate([new[:, None], old], 1)
                    for new, old in zip(newest, past, strict=True)
                )
            )
        steps = sensor.sensors.latency[:, None, None]
        return Action(*(jnp.take_along_axis(targets, steps, 1)[:, 0] for targets in past))

    def table_present(self, state: EnvState) -> Array:
        """(B,) bool: the table is present in the coming control step."""
        return (state.time < self.task.approach_steps) | state.reset_state.stationary

    def _episode(self, state: EnvState, up: Array) -> Array:
        """Metrics (B, fields) of the current episodes, as if they ended now."""
        task, sums, known = self.task, state.sums, state.success
        after = max(task.hold_steps, 1)
        values = {
            "success": known.kept,
            "held": known.kept & up,
            "return": sums["return"],
            "length": state.time,
            "links_at_removal": known.links_at_removal,
            "moved_at_removal": known.moved_at_removal,
            **metrics.episode_errors(task, sums),
            **{name: sums[name] / after for name in FORCES},
            DIVERGED: known.diverged,
            **{f"mask_{name}": state.goal.active[name] for name in blocks(task)},
            "object_index": state.reset_state.object_index,
        }
        columns = [jnp.asarray(values[name], jnp.float32) for name in metric_names(task)]
        return jnp.concatenate([jnp.stack(columns, -1), state.terms], -1)
