"""The environment: `reset` and `step` over a batch of hands and objects.

A step is `targets`, what physics makes of them, and `advance`. Engines that JAX cannot trace stand between the two
compiled halves (`actors.rollout`); `step` puts them together for those that it can.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp

from actors import harvest, success
from actors.harvest import Grasps
from actors.initial import InitialConditions
from actors.physics.engine import Physics, Readout, World, where_worlds
from actors.success import Success
from common.config import ControlConfig, RewardWeights, TaskConfig
from common.hands.spec import Hand
from common.task import metrics
from common.task.constraints import blocks
from common.task.constraints.base import Scene
from common.task.control import decode
from common.task.features import features
from common.task.reward import reward_terms, terms
from common.task.types import Action, Array, Goal, SceneState, Surface

_FORCES = ("force_sum", "force_link_max")


def metric_names(task: TaskConfig) -> tuple[str, ...]:
    """Metrics of a finished episode: outcome, errors of the constraints, forces, and which blocks were active."""
    return (
        "success",
        "held",
        "return",
        "length",
        "links_at_removal",
        "moved_at_removal",
        *(spec.name for spec in metrics.specs(task)),
        *_FORCES,
        "bad",
        *(f"mask_{name}" for name in blocks(task)),
        "object_index",
    )


def episode_fields(task: TaskConfig) -> tuple[str, ...]:
    """Columns of `EnvState.finished`: the metrics, then the sums of the reward's terms."""
    return (*(f"episode/{name}" for name in metric_names(task)), *(f"term/{name}" for name in terms(task)))


class Settings(NamedTuple):
    """What may change between steps without compiling anew."""

    weights: RewardWeights
    control: ControlConfig


class EnvState(NamedTuple):
    """A batch of B environments between two control steps."""

    physics: Any
    """The engine's state; None where the engine keeps it in place."""
    scene: tuple[Any, ...]
    """`SceneState` and `Features` after the step; empty inside of a loop around an engine that is not compiled."""
    world: World
    """What the present episodes started from."""
    goal: Goal
    """Active constraints."""
    surface: Surface
    """Surface points of the objects."""
    region: Array
    """(B,) int: the region of the constraint bank that the episodes were drawn from."""
    hold: Array
    """(B,) control steps without the table before the episode ends."""
    time: Array
    """(B,) control steps since the episode began."""
    q_target: Array
    """(B, F) targets of the previous step."""
    u_target: Array
    """(B, 6)."""
    success: Success
    """What is known of the episodes' success."""
    sums: dict[str, Array]
    """Sums (B,) of errors, forces and reward over the episode."""
    terms: Array
    """(B, terms) sums of the reward's terms over the episode."""
    grasps: Grasps
    """Grasps of successful episodes that may become references."""
    finished: Array
    """(B, fields) metrics of the episode that ended last, in the order of `episode_fields`."""
    has_finished: Array
    """(B,) bool: an episode ended since the flag was cleared."""


class Transition(NamedTuple):
    """What one control step brought."""

    reward: Array
    """(B,)."""
    terminal: Array
    """(B,) bool: the episode ended with this step."""
    terms: Array
    """(B, terms) weighted reward terms."""
    errors: dict[str, tuple[Array, Array]]
    """Numerator and denominator (B,) of every error of the constraints."""
    usage: Array
    """(2,) occupancy of the engine's buffers, see `actors.physics.engine.Readout`."""


class GraspEnv:
    """The grasping task on a physics engine."""

    def __init__(self, hand: Hand, task: TaskConfig, physics: Physics):
        """Allocates nothing yet.

        Args:
          hand: the hand.
          task: the task.
          physics: the engine, with the objects that initial conditions name by index.
        """
        self.hand, self.task, self.physics = hand, task, physics
        self.settings = Settings(task.reward, task.control)

    def reset(self, initial: InitialConditions) -> EnvState:
        """Episodes that begin as they are told, in every environment."""
        return self.state_of(initial, self.physics.start(initial.world))

    def state_of(self, initial: InitialConditions, physics: Any) -> EnvState:
        """Episodes that have just begun in an engine that was started from their `world`."""
        batch = initial.world.q.shape[0]
        zero, no, index = jnp.zeros(batch), jnp.zeros(batch, bool), jnp.zeros(batch, jnp.int32)
        world = initial.world
        sums = {**metrics.empty_sums(self.task, batch), **dict.fromkeys(("return", *_FORCES), zero)}
        state = EnvState(
            physics=physics if self.physics.compiled else None,
            scene=(),
            world=world,
            goal=initial.goal,
            surface=initial.surface,
            region=initial.region,
            hold=initial.hold,
            time=index,
            q_target=world.q,
            u_target=jnp.zeros((batch, 6)),
            success=success.begin(world.object_position[:, 2]),
            sums=sums,
            terms=jnp.zeros((batch, len(terms(self.task)))),
            grasps=Grasps(no, index, index, world.q, world.base_position, world.base_quaternion),
            finished=jnp.zeros((batch, len(episode_fields(self.task)))),
            has_finished=no,
        )
        return self.seen(state, self.physics.read(physics)) if self.physics.compiled else state

    def restart(self, state: EnvState, mask: Array, initial: InitialConditions) -> EnvState:
        """New episodes in the masked environments (B,); the others go on, with their contacts."""
        physics = self.physics.reset(state.physics, mask, initial.world)
        return self.merge(state, mask, self.state_of(initial, physics))

    def merge(self, state: EnvState, mask: Array, fresh: EnvState) -> EnvState:
        """`fresh` in the masked environments (B,), but for what is not of the episode; its engine is merged already."""
        kept: dict[str, Any] = {name: getattr(state, name) for name in ("grasps", "finished", "has_finished")}
        scene = where_worlds(mask, fresh.scene, state.scene) if self.physics.compiled else ()
        apart: dict[str, Any] = {"physics": None, "scene": ()}
        merged = where_worlds(mask, fresh._replace(**kept, **apart), state._replace(**apart))
        return merged._replace(physics=fresh.physics, scene=scene)

    def step(self, state: EnvState, action: Array, settings: Settings | None = None) -> tuple[EnvState, Transition]:
        """One control step of an engine that can be traced; episodes that ended stay in place.

        Args:
          state: the environments.
          action: (B, F + 6) residual action.
          settings: reward weights and control, may be traced; those of the task by default.
        """
        settings = settings or self.settings
        target, joints, table = self.targets(state, action, settings)
        physics, readout = self.physics.step(state.physics, joints, table)
        return self.advance(state._replace(physics=physics), target, readout, settings)

    def targets(self, state: EnvState, action: Array, settings: Settings) -> tuple[Action, Array, Array]:
        """Joint targets of an action; in the order of the engine (B, 6 + F); and (B,) bool where the table stands."""
        target = decode(self.scene_of(state), settings.control, action)
        return target, jnp.concatenate([target.u_target, target.q_target], -1), self.table_present(state)

    def advance(
        self, state: EnvState, target: Action, readout: Readout, settings: Settings
    ) -> tuple[EnvState, Transition]:
        """What follows from a control step that the engine has made.

        Args:
          state: before the step; its `physics` is after it already.
          target: the joint targets of the step.
          readout: the engine after it.
          settings: see `step`.
        """
        task, had_table = self.task, self.table_present(state)
        state = state._replace(
            time=state.time + 1,
            q_target=jnp.where(readout.bad[:, None], state.world.q, target.q_target),
            u_target=jnp.where(readout.bad[:, None], 0.0, target.u_target),
        )
        state = self.seen(state, readout)
        scene = self.scene_of(state)
        tracked, up = success.track(task, state.success, scene, readout.bad)
        found = reward_terms(scene, settings.weights)
        found["drop"] = jnp.where(tracked.diverged, -settings.weights.drop, found["drop"])
        stacked = jnp.stack([found[name] for name in terms(task)], -1)
        reward = jnp.sum(stacked, -1)
        error = metrics.errors(scene)
        # The paper's window ends `hold_steps` after the removal, however much longer the episode holds.
        window = ~had_table & (state.time <= task.approach_steps + task.hold_steps)
        force = jnp.linalg.norm(scene.features.force, axis=-1)
        state = state._replace(
            success=tracked,
            grasps=harvest.collect(task, state, scene, error, up),
            sums={
                **metrics.accumulate(task, state.sums, error, had_table, window),
                "return": state.sums["return"] + reward,
                "force_sum": state.sums["force_sum"] + jnp.sum(force, -1) * window,
                "force_link_max": state.sums["force_link_max"] + jnp.max(force, -1) * window,
            },
            terms=state.terms + stacked,
        )
        terminal = state.time >= task.approach_steps + state.hold
        if task.end_when_fallen:
            terminal |= (state.time >= task.approach_steps + task.hold_steps) & ~up
        finished = jnp.where(terminal[:, None], self._episode(state, up), state.finished)
        state = state._replace(finished=finished, has_finished=state.has_finished | terminal)
        return state, Transition(reward, terminal, stacked, error, readout.usage)

    def seen(self, state: EnvState, readout: Readout) -> EnvState:
        """The environments with the scene that the engine shows."""
        world = state.world
        scene = SceneState(
            q=readout.q,
            u=readout.u,
            q_velocity=readout.q_velocity,
            u_velocity=readout.u_velocity,
            q_target=state.q_target,
            u_target=state.u_target,
            object_position=readout.object_position,
            object_quaternion=readout.object_quaternion,
            object_velocity=readout.object_velocity,
            object_angular_velocity=readout.object_angular_velocity,
            contact_force=readout.contact_force,
            contact_position=readout.contact_position,
            contact_found=readout.contact_found,
            base_position=world.base_position,
            base_quaternion=world.base_quaternion,
            q_initial=world.q,
            object_position_initial=world.object_position,
            object_quaternion_initial=world.object_quaternion,
            time=state.time.astype(jnp.float32),
            table=self.table_present(state),
        )
        return state._replace(scene=(scene, features(self.hand, self.task, scene, state.surface, state.goal)))

    def scene_of(self, state: EnvState) -> Scene:
        """The present control step as the task's terms see it."""
        scene, seen = state.scene
        return Scene(self.hand, self.task, scene, seen, state.goal)

    def table_present(self, state: EnvState) -> Array:
        """(B,) bool: whether the table stands in the coming control step."""
        return (state.time < self.task.approach_steps) | state.world.stationary

    def _episode(self, state: EnvState, up: Array) -> Array:
        """(B, fields) metrics of the present episodes, as if they ended now."""
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
            **{name: sums[name] / after for name in _FORCES},
            "bad": known.diverged,
            **{f"mask_{name}": state.goal.active[name] for name in blocks(task)},
            "object_index": state.world.object_index,
        }
        columns = [jnp.asarray(values[name], jnp.float32) for name in metric_names(task)]
        return jnp.concatenate([jnp.stack(columns, -1), state.terms], -1)
