"""The environment: `reset` and `step` over a batch of hands and objects.

A step consists of `targets`, the physics step, and `advance`. An engine that JAX cannot trace is
called between the two compiled halves (`actors.worker`); for traceable engines `step` combines all
three.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from congrasp.actors import harvest
from congrasp.actors import stress as protocols
from congrasp.actors.env_state import EnvState, Settings, Transition, View, Views
from congrasp.actors.harvest import Grasps
from congrasp.actors.initial import InitialConditions
from congrasp.actors.physics.engine import Physics, PhysicsState
from congrasp.actors.sensing import begin_sensing, sense, targets_followed, targets_last_followed
from congrasp.actors.stress import Frame
from congrasp.actors.success import begin_success, track_success
from congrasp.common.hands.motors import motor_positions
from congrasp.common.hands.spec import Hand
from congrasp.common.task import metrics, privileged
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import blocks
from congrasp.common.task.control import decode, track_load, wrist_load
from congrasp.common.task.features import features
from congrasp.common.task.grip import ObjectLoad
from congrasp.common.task.metrics import DIVERGED, FORCES, episode_fields, metric_names
from congrasp.common.task.reward import reward_terms, terms
from congrasp.common.task.scene import Scene
from congrasp.common.task.sensors import get_sensor
from congrasp.common.task.sensors.base import Moment
from congrasp.common.task.settings import GRAVITY
from congrasp.common.task.types import Action, Array, Goal, SceneState, Surface

_NOT_RESTARTED = ("physics", "views", "grasps", "finished", "has_finished")
"""Fields of `EnvState` that `restart` does not merge: it sets the first two at its end, and the
others outlast an episode."""


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
        self.hand = hand
        self.task = task
        self.settings = Settings(task.reward, task.control)
        self._engine = engine

    @property
    def _traceable_engine(self) -> Physics:
        """The engine, for the methods that call it."""
        assert self._engine is not None, "the engine is stepped outside"
        return self._engine

    # Start of episodes.

    def reset(self, initial: InitialConditions) -> EnvState:
        """Starts episodes from initial conditions, in every environment."""
        return self.state_of(initial, self._traceable_engine.start(initial.reset_state))

    def state_of(self, initial: InitialConditions, physics: Any) -> EnvState:
        """Returns the state of episodes whose engine was just started from their `reset_state`."""
        state = self._first_state(initial)._replace(physics=physics)
        if self._engine is None:
            return state
        return self.with_scene(state, self._engine.read(physics))

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

        def in_rows(new: Any, old: Any) -> Any:
            """Replaces the rows of arrays (B, ...) by arrays (K, ...)."""
            return jax.tree.map(lambda some, every: every.at[rows].set(some, mode="drop"), new, old)

        first = self._first_state(initial)
        not_restarted = {name: getattr(state, name) for name in _NOT_RESTARTED}
        empty: dict[str, Any] = dict.fromkeys(_NOT_RESTARTED)
        merged: EnvState = in_rows(first._replace(**empty), state._replace(**empty))
        merged = merged._replace(**not_restarted)
        if self._engine is None:
            return merged
        started = jnp.zeros(len(state.time), bool).at[rows].set(True, mode="drop")
        physics = self._engine.reset(state.physics, started, merged.reset_state)
        physics_state = self._engine.read(physics)
        of_started: dict[str, Any] = {}
        for name, array in physics_state._asdict().items():
            if name != "occupancy":
                of_started[name] = array[rows]
        scene = self.with_scene(first, physics_state._replace(**of_started))
        return merged._replace(physics=physics, views=in_rows(scene.views, state.views))

    def _first_state(self, initial: InitialConditions) -> EnvState:
        """Initial state of episodes; `physics` and `views` are not set yet."""
        reset_state = initial.reset_state
        batch = reset_state.q.shape[0]
        zero = jnp.zeros(batch)
        zero_steps = jnp.zeros(batch, jnp.int32)
        no = jnp.zeros(batch, bool)
        grasps = Grasps(
            found=no,
            object_index=zero_steps,
            region=zero_steps,
            q=reset_state.q,
            position=reset_state.base_position,
            quaternion=reset_state.base_quaternion,
        )
        return EnvState(
            physics=None,
            views=None,
            reset_state=reset_state,
            goal=initial.goal,
            surface=initial.surface,
            region=initial.region,
            hold=initial.hold,
            after=zero_steps,
            frame=Frame(zero, zero, zero),
            time=zero_steps,
            q_target=reset_state.q,
            u_target=jnp.zeros((batch, 6)),
            momentum=jnp.zeros((batch, 6)),
            sensing=begin_sensing(self.hand, self.task, initial),
            success=begin_success(reset_state.object_position[:, 2]),
            sums={
                **metrics.empty_sums(self.task, batch),
                **dict.fromkeys(("return", *FORCES), zero),
            },
            terms=jnp.zeros((batch, len(terms(self.task)))),
            grasps=grasps,
            finished=jnp.zeros((batch, len(episode_fields(self.task)))),
            has_finished=no,
        )

    # A control step.

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
        physics, physics_state = self._traceable_engine.step(state.physics, *command)
        return self.advance(state._replace(physics=physics), target, physics_state, settings)

    def targets(
        self, state: EnvState, action: Array, settings: Settings
    ) -> tuple[Action, tuple[Array, ...]]:
        """Returns the joint targets of an action, and the inputs of the engine's step
        (`Physics.step`).
        """
        target = decode(self.seen(state), settings.control, action)
        table = self.table_present(state)
        followed = targets_followed(self.task, state.sensing, target)
        motors = motor_positions(self.hand, followed.q_target)
        protocol = settings.protocol
        if protocol is None:
            return target, (jnp.concatenate([followed.u_target, motors], -1), table)
        start = state.reset_state
        frame = protocols.frame(protocol, self.task, state.time + 0.5)
        u_target = protocols.targets_to_world_frame(
            followed.u_target, self.hand, start.base_quaternion, frame
        )
        force = protocols.push(
            protocol, self.task, state.time, start.object_index, start.mass_scale
        )
        servo_targets = jnp.concatenate([u_target, motors], -1)
        return target, (servo_targets, table | protocol.table, force)

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
        had_table = self.table_present(state)
        state = self._after_step(state, target, physics_state, settings)
        scene = self.scene_of(state)
        success, up = track_success(self.task, state.success, scene, physics_state.diverged)
        state = state._replace(success=success)

        scene = scene._replace(load=self._object_load(state, settings))
        term_values = reward_terms(scene, settings.weights)
        term_values["drop"] = jnp.where(
            success.diverged, -settings.weights.drop, term_values["drop"]
        )
        stacked = jnp.stack([term_values[name] for name in terms(self.task)], -1)
        reward = jnp.sum(stacked, -1)
        errors = metrics.errors(scene)

        state = state._replace(
            grasps=harvest.collect(
                scene, state.grasps, errors, up, state.reset_state.object_index, state.region
            ),
            sums=self._sums(state, scene, errors, reward, had_table),
            terms=state.terms + stacked,
        )
        complete, terminal = self._ends(state, up)
        finished = jnp.where(complete[:, None], self._episode(state, up), state.finished)
        state = state._replace(finished=finished, has_finished=state.has_finished | complete)
        # If the object is not held, any end is final: the reward already contains the fall.
        transition = Transition(
            reward=reward,
            terminal=terminal,
            truncated=terminal & up,
            terms=stacked,
            errors=errors,
            occupancy=physics_state.occupancy,
        )
        return state, transition

    def _after_step(
        self, state: EnvState, target: Action, physics_state: PhysicsState, settings: Settings
    ) -> EnvState:
        """Returns the environments with time, targets, sensors and views after a control step; see
        `advance`.

        Environments that diverged continue from their start.
        """
        hand = self.hand
        task = self.task
        diverged = physics_state.diverged[:, None]
        state = state._replace(
            time=state.time + 1,
            q_target=jnp.where(diverged, state.reset_state.q, target.q_target),
            u_target=jnp.where(diverged, 0.0, target.u_target),
        )
        if settings.protocol is not None:
            state = state._replace(frame=protocols.frame(settings.protocol, task, state.time))
        carried = protocols.to_carried_frame(
            physics_state, state.reset_state.base_quaternion, state.frame
        )
        newest = Action(state.q_target, state.u_target)
        followed = targets_followed(task, state.sensing, newest)
        momentum = track_load(
            hand, task, state.momentum, carried.u, carried.u_velocity, followed.u_target
        )
        state = state._replace(momentum=jnp.where(diverged, 0.0, momentum))
        true_state = self._scene_state(state, carried, followed)
        if state.sensing is not None:
            moment = Moment(
                hand=hand,
                task=task,
                time=state.time,
                state=true_state,
                object_position=physics_state.object_position,
                lift=protocols.up(state.frame.height),
                surface=state.surface,
            )
            state = state._replace(sensing=sense(state.sensing, moment, newest))
        return self._with_views(state, true_state)

    def _sums(
        self,
        state: EnvState,
        scene: Scene,
        errors: dict[str, tuple[Array, Array]],
        reward: Array,
        had_table: Array,
    ) -> dict[str, Array]:
        """Sums of the episode including this step, whose reward is (B,).

        The paper's window ends `hold_steps` after the removal, however long the episode continues.
        """
        task = self.task
        window = ~had_table & (state.time <= task.approach_steps + task.hold_steps)
        force = jnp.linalg.norm(scene.features.force, axis=-1)
        sums = state.sums
        return {
            **metrics.accumulate(task, sums, errors, had_table, window),
            "return": sums["return"] + reward,
            "force_sum": sums["force_sum"] + jnp.sum(force, -1) * window,
            "force_link_max": sums["force_link_max"] + jnp.max(force, -1) * window,
        }

    def _ends(self, state: EnvState, up: Array) -> tuple[Array, Array]:
        """(B,) bool each: the episode's metrics are complete with this step, and the episode ends
        with it.
        """
        task = self.task
        over = state.time - state.hold - task.approach_steps
        complete = over == 0
        terminal = over >= state.after
        if task.end_when_fallen:
            counted = state.time >= task.approach_steps + task.hold_steps
            fell = counted & ~up & (over < 0)
            complete = complete | fell
            terminal = terminal | fell
        return complete, terminal

    def _episode(self, state: EnvState, up: Array) -> Array:
        """Metrics (B, fields) of the current episodes, as if they ended now."""
        task = self.task
        sums = state.sums
        success = state.success
        steps = max(task.hold_steps, 1)
        values = {
            "success": success.succeeded,
            "held": success.succeeded & up,
            "return": sums["return"],
            "length": state.time,
            "links_at_removal": success.links_at_removal,
            "moved_at_removal": success.moved_at_removal,
            **metrics.episode_errors(task, sums),
            **{name: sums[name] / steps for name in FORCES},
            DIVERGED: success.diverged,
            **{f"mask_{name}": state.goal.active[name] for name in blocks(task)},
            "object_index": state.reset_state.object_index,
        }
        columns = [jnp.asarray(values[name], jnp.float32) for name in metric_names(task)]
        return jnp.concatenate([jnp.stack(columns, -1), state.terms], -1)

    def _object_load(self, state: EnvState, settings: Settings) -> ObjectLoad | None:
        """Weight and friction of the objects; None where the masses are not recorded."""
        if settings.masses is None:
            return None
        start = state.reset_state
        mass = settings.masses[start.object_index] * start.mass_scale
        return ObjectLoad(weight=GRAVITY * mass, friction=start.friction)

    def table_present(self, state: EnvState) -> Array:
        """(B,) bool: the table is present in the coming control step."""
        return (state.time < self.task.approach_steps) | state.reset_state.stationary

    # Scenes.

    def with_scene(self, state: EnvState, physics_state: PhysicsState) -> EnvState:
        """Returns the environments with the scene of an engine that has simulated no step since the
        last `advance`.
        """
        carried = protocols.to_carried_frame(
            physics_state, state.reset_state.base_quaternion, state.frame
        )
        newest = Action(state.q_target, state.u_target)
        followed = targets_last_followed(self.task, state.sensing, newest)
        return self._with_views(state, self._scene_state(state, carried, followed))

    def _scene_state(self, state: EnvState, carried: PhysicsState, followed: Action) -> SceneState:
        """True state of hand and object in the carried frame, with the targets that the servos
        followed.
        """
        reset_state = state.reset_state
        load = wrist_load(self.hand, self.task, state.momentum, carried.u, carried.u_velocity)
        return SceneState(
            q=carried.q,
            u=carried.u,
            q_velocity=carried.q_velocity,
            u_velocity=carried.u_velocity,
            q_target=followed.q_target,
            u_target=followed.u_target,
            object_position=carried.object_position,
            object_quaternion=carried.object_quaternion,
            object_velocity=carried.object_velocity,
            object_angular_velocity=carried.object_angular_velocity,
            contact_force=carried.contact_force,
            contact_position=carried.contact_position,
            contact_found=carried.contact_found,
            base_position=reset_state.base_position,
            base_quaternion=reset_state.base_quaternion,
            q_initial=reset_state.q,
            object_position_initial=reset_state.object_position,
            object_quaternion_initial=reset_state.object_quaternion,
            wrist_load=load,
            time=state.time.astype(jnp.float32),
            table=self.table_present(state),
        )

    def _with_views(self, state: EnvState, true_state: SceneState) -> EnvState:
        """Returns the environments with the geometry of a control step, in the true state and as
        observed by the policy.
        """
        sensed = None
        if state.sensing is not None:
            sensor = get_sensor(self.task)
            first = sensor.first_pose(state.sensing.sensor)
            sensed_state = true_state._replace(
                object_position_initial=first[:, :3], object_quaternion_initial=first[:, 3:]
            )
            sensed_state = sensor.seen(self.task, sensed_state, state.sensing.readings)
            sensed = self._view(sensed_state, *self._observed_surface_and_goal(state))
        true = self._view(true_state, state.surface, state.goal)
        return state._replace(views=Views(true, sensed))

    def _observed_surface_and_goal(self, state: EnvState) -> tuple[Surface, Goal]:
        """Points of the object and goal as the policy observes them."""
        if state.sensing is None:
            return state.surface, state.goal
        sensor = get_sensor(self.task)
        return sensor.view(state.sensing.sensor, state.surface, state.goal)

    def _view(self, scene_state: SceneState, surface: Surface, goal: Goal) -> View:
        """Returns a control step with its features."""
        return View(scene_state, features(self.hand, self.task, scene_state, surface, goal))

    def scene_of(self, state: EnvState) -> Scene:
        """Scene of the current control step, as input of the task's terms."""
        assert state.views is not None, "call `with_scene` first"
        return Scene(self.hand, self.task, *state.views.true, state.goal, state.surface)

    def seen(self, state: EnvState) -> Scene:
        """Scene of the current control step as observed by the policy."""
        assert state.views is not None, "call `with_scene` first"
        view = state.views.sensed or state.views.true
        surface, goal = self._observed_surface_and_goal(state)
        scene = Scene(self.hand, self.task, *view, goal, surface)
        if state.sensing is None:
            return scene
        measured = get_sensor(self.task).measure(state.sensing.sensor)
        return scene._replace(readings=state.sensing.readings, measured=measured)

    def privileged(self, state: EnvState) -> Scene:
        """Scene of the current control step as observed by a policy of the full state."""
        full = dataclasses.replace(self.task, observation="full")
        return self.scene_of(state)._replace(task=full)

    def critic_inputs(self, state: EnvState, masses: Array) -> Array:
        """Privileged inputs (B, P) of the critic; `masses` are those of `Settings`."""
        start = state.reset_state
        sensors = None
        if state.sensing is not None:
            sensors = state.sensing.parameters
        parameters = privileged.Parameters(
            mass=masses[start.object_index] * start.mass_scale,
            friction=start.friction,
            gain_scale=start.gain_scale,
            stationary=start.stationary,
            hold=state.hold,
            sensors=sensors,
        )
        return privileged.observe(self.scene_of(state), parameters)
