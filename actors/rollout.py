"""Rollouts: the single driver of control steps, for training, evaluation, attempts and benchmarks.

With a compiled engine the whole rollout is one program (`jax.lax.scan`); otherwise the same functions are compiled
separately around the engine's step.
"""

import concurrent.futures
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.actors import harvest, initial
from congrasp.actors import stress as protocols
from congrasp.actors.env import EnvState, GraspEnv, Settings, Transition, episode_fields
from congrasp.actors.harvest import Grasps
from congrasp.actors.initial import InitialConditions
from congrasp.actors.physics.engine import Physics, PhysicsState
from congrasp.actors.stress import Frame
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task import metrics
from congrasp.common.task.config import RewardWeights, TaskConfig
from congrasp.common.task.constraints.base import Scene
from congrasp.common.task.observation import observe
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.teaching import observe_for_teacher
from congrasp.common.task.types import Action, Array

ActFunction = Callable[[Any, Array, Array], tuple[Array, Array]]
"""(parameters, observation (B, D) float32, random key) -> action (B, A), log-probability (B,)."""
Probe = Callable[[Scene, Array, Any], Any]
"""(scene after a control step, indices of the objects (B,), `Settings.probe_data`) -> a pytree of arrays to record for
every environment and step."""


class Trace(NamedTuple):
    """Recorded values of one environment, or of several, at every step, for logs and pictures (T leads).

    Poses are in the world frame, even if the policy observes a carried frame (`actors.stress`).
    """

    q: Array
    u: Array
    q_target: Array
    u_target: Array
    wrist_position: Array
    wrist_quaternion: Array
    object_position: Array
    object_quaternion: Array
    contact_force: Array
    """(T, L, 3) net force on each link, world frame, N."""
    action: Array
    terms: Array
    """(T, terms) weighted reward terms."""
    errors: Array
    """(T, errors) of the constraints, in the order of `common.task.metrics.specs`."""
    table: Array
    terminal: Array


class Rollout(NamedTuple):
    """T control steps of B environments."""

    observation: Array
    """(T, B, D)."""
    action: Array
    """(T, B, A)."""
    log_probability: Array
    """(T, B) log probability under the behaviour policy."""
    reward: Array
    """(T, B)."""
    terminal: Array
    """(T, B) bool: the episode ended with this step."""
    truncated: Array
    """(T, B) bool: it ended by its time limit with the object held (`actors.env.Transition`)."""
    occupancy: Array
    """(T, 3), see `actors.physics.engine.PhysicsState`."""
    last_observation: Array
    """(B, D)."""
    episodes: Array
    """(B, fields) metrics of the last finished episode of each environment, in the order of `episode_fields`."""
    has_episode: Array
    """(B,) bool."""
    trace: Trace
    probed: Any
    """Result of the probe, with leading axis T; None without a probe."""
    teacher_observation: Array | None = None
    """(T, B, S) input of the teacher that labels the rollout (`common.task.teaching`)."""
    privileged: Array | None = None
    """(T, B, P) privileged inputs of the critic (`common.task.privileged`), if recorded."""
    last_privileged: Array | None = None
    """(B, P)."""


class _Seen(NamedTuple):
    """Observations of one control step, in the learner's precision."""

    observation: Array
    """(B, D)."""
    teacher_observation: Array | None
    """(B, S) input of a teacher, if recorded."""
    privileged: Array | None
    """(B, P) privileged inputs of the critic, if recorded."""


class _Decision(NamedTuple):
    """Decision of the policy for the coming control step."""

    seen: _Seen
    action: Array
    log_probability: Array
    target: Action
    command: tuple[Array, ...]
    """Inputs of the engine's step."""


class RolloutWorker:
    """Environments that continue from one rollout to the next."""

    def __init__(
        self,
        hand: Hand,
        task: TaskConfig,
        physics: Physics,
        bank: ConstraintBank | None,
        policy: ActFunction,
        *,
        batch: int,
        seed: int,
        half_precision: bool,
        probe: Probe = lambda scene, index, data: None,
        traced: int | slice = 0,
        staggered: bool = False,
        taught: bool = False,
        privileged: Sequence[GraspObject] = (),
    ):
        """Creates the worker, and starts episodes if there is a bank.

        Args:
          hand: the hand.
          task: the task.
          physics: the engine, with the objects of the bank.
          bank: constraint bank of the episodes; without one, `begin` sets the episodes, which do not restart at their
            end.
          policy: a pure function; `collect` passes its parameters.
          batch: number B of environments.
          seed: seed of episodes and actions.
          half_precision: rounds observations to half precision, for the policy and for the learner.
          probe: computes additional values to record at every step.
          traced: environments whose trace is recorded.
          staggered: ends the first episodes early at different times, so that short rollouts then contain all phases of
            the task.
          taught: records `Rollout.teacher_observation`.
          privileged: the engine's objects, if `Rollout.privileged` is recorded.
        """
        self.physics, self.env = physics, GraspEnv(hand, task, physics)
        self._hand, self._task, self._bank, self._policy = hand, task, _on_device(bank), policy
        self._probe, self._traced, self._staggered, self.batch = probe, traced, staggered, batch
        self._taught = taught
        self._dtype = jnp.float16 if half_precision else jnp.float32
        self._settings, self._stationary = self.env.settings, np.array(False)
        if privileged:
            self.adjust(masses=_masses(privileged))
        self._episode_key, self._key = _split(_on_device(jax.random.key(seed)))
        self._sample_jit = jax.jit(self._sample)
        self._begin_jit = jax.jit(self._begin)
        self._decide_jit = jax.jit(self._decide)
        self._advance_jit = jax.jit(self._advance)
        self._merge_jit = jax.jit(self._merge)
        self._restart_jit = jax.jit(self.env.restart)
        self._look_jit = jax.jit(self._look)
        self._with_scene_jit = jax.jit(self.env.with_scene)
        self._scan_jit = jax.jit(self._scan, static_argnames="steps")
        self.state: EnvState | None = None
        if bank is not None:
            self.restart()

    def adjust(self, **settings: Any) -> None:
        """Changes `Settings` by name from the next control step on; new types or shapes are recompiled."""
        self._settings = self._settings._replace(**settings)

    def configure(self, weights: RewardWeights, *, stationary: bool) -> None:
        """Sets the reward weights, and whether the objects of episodes that start from now on are fixed."""
        self._settings, self._stationary = self._settings._replace(weights=weights), np.array(stationary)

    def replace_objects(self, objects: Sequence[GraspObject], bank: ConstraintBank | None) -> None:
        """Replaces the objects by as many others, with their bank, for episodes that start from now on."""
        physics = self.physics.replace_objects(self.state.physics if self.state else None, objects)
        self._bank = _on_device(bank)
        if self._settings.masses is not None:
            self.adjust(masses=_masses(objects))
        if self.state is not None:
            self.state = self.state._replace(physics=physics if self.physics.compiled else None)
            self.take_grasps()

    def restart(self) -> None:
        """Starts new episodes in every environment."""
        self._episode_key, key = _split(self._episode_key)
        conditions = self._sample_jit(self._bank, key, self._stationary)
        if self._staggered:
            whole = self._task.approach_steps + np.asarray(conditions.hold)
            share = np.random.default_rng(np.asarray(jax.random.key_data(key))).uniform(size=whole.shape)
            conditions = conditions._replace(hold=_on_device(np.int32(conditions.hold - np.floor(share * whole))))
        self.begin(conditions)

    def begin(self, conditions: InitialConditions) -> None:
        """Starts these episodes, one in each environment."""
        kept, conditions = self.state, _on_device(conditions)
        if self.physics.compiled:
            self.state = self._begin_jit(conditions, _on_device(kept))
            return
        if kept is None:
            self.physics.start(conditions.reset_state)
        else:
            self.physics.reset(None, np.ones(self.batch, bool), conditions.reset_state)
        state = self._begin_jit(conditions, None)
        self.state = self._with_scene_jit(state._replace(views=None), self.physics.read(None))
        if kept is not None:
            self.state = self.state._replace(grasps=kept.grasps)

    def renew(self, mask: np.ndarray, conditions: InitialConditions) -> None:
        """Starts these episodes in the masked environments (B,)."""
        assert self.state is not None, "call `begin` first"
        conditions = _on_device(conditions)
        if self.physics.compiled:
            self.state = self._restart_jit(self.state, mask, conditions)
            return
        self.physics.reset(None, mask, conditions.reset_state)
        state = self._merge_jit(self.state._replace(views=None), mask, conditions)
        self.state = self._with_scene_jit(state, self.physics.read(None))

    def observe(self) -> Array:
        """Observation (B, D) of the current control step by the policy."""
        return self._look_jit(self.state, self._settings).observation

    def compile(self, parameters: Any, steps: int) -> None:
        """Compiles the programs of `collect` and `renew_references` without running them; for compiled engines.

        Args:
          parameters: parameters of the policy, as for `collect`.
          steps: number T of steps.
        """
        given, grasps = self._scan_arguments(parameters, self._key), self.state.grasps if self.state else None
        programs = [self._scan_jit.lower(*given, steps=steps)]
        programs.append(harvest.renew.lower(self._hand, self._task, self._bank, grasps, self._key))
        with concurrent.futures.ThreadPoolExecutor(len(programs)) as threads:
            list(threads.map(lambda program: program.compile(), programs))

    @property
    def bank(self) -> ConstraintBank:
        """Current constraint bank of the episodes."""
        assert self._bank is not None, "these episodes are given"
        return self._bank

    def weigh_objects(self, weight: np.ndarray) -> None:
        """Sets the weights (N,) with which episodes that start from now on draw objects."""
        self._bank = self.bank._replace(weight=jnp.asarray(weight, jnp.float32))

    def renew_references(self) -> None:
        """Stores the grasps that succeeded since the last call as reference poses in the bank."""
        self._key, key = _split(self._key)
        self._bank = harvest.renew(self._hand, self._task, self.bank, self.take_grasps(), key)

    def take_grasps(self) -> Grasps:
        """Returns the grasps that succeeded since the last call."""
        assert self.state is not None, "call `begin` first"
        grasps = self.state.grasps
        self.state = self.state._replace(grasps=grasps._replace(found=_on_device(np.zeros(self.batch, bool))))
        return grasps

    def collect(self, parameters: Any, steps: int, progress: Callable[[int], None] = lambda step: None) -> Rollout:
        """Simulates the next `steps` control steps with these policy parameters.

        Args:
          parameters: parameters of the policy.
          steps: number T of steps.
          progress: called with the number of completed steps, by engines that are not compiled.
        """
        assert self.state is not None, "call `begin` first"
        self._key, key = _split(self._key)
        self.state = _on_device(self.state._replace(has_finished=np.zeros(self.batch, bool)))
        if self.physics.compiled:
            return self._collect_compiled(parameters, key, steps)
        return self._collect_stepwise(parameters, key, steps, progress)

    def _sample(self, bank: ConstraintBank, key: Array, stationary: Array) -> InitialConditions:
        """Draws initial conditions for all environments from the bank."""
        return initial.sample(self._hand, self._task, bank, key, self.batch, stationary)

    def _begin(self, conditions: InitialConditions, kept: EnvState | None) -> EnvState:
        """Starts episodes in every environment; a compiled engine is started or, if it runs already, reset."""
        if not self.physics.compiled:
            return self.env.state_of(conditions, None)
        if kept is None:
            return self.env.reset(conditions)
        physics = self.physics.reset(kept.physics, jnp.ones(self.batch, bool), conditions.reset_state)
        return self.env.state_of(conditions, physics)._replace(grasps=kept.grasps)

    def _merge(self, state: EnvState, mask: Array, fresh: InitialConditions) -> EnvState:
        """Merges fresh episodes into the masked environments (B,), whose engine was reset separately."""
        return self.env.merge(state, mask, self.env.state_of(fresh, None))

    def _look(self, state: EnvState, settings: Settings) -> _Seen:
        """Returns the observations of the current control step."""
        observation = observe(self.env.seen(state)).astype(self._dtype)
        everything = None
        if self._taught:
            given = self.env.privileged(state), self.env.seen(state), settings.control
            everything = observe_for_teacher(*given).astype(self._dtype)
        masses = settings.masses
        inputs = None if masses is None else self.env.critic_inputs(state, masses).astype(self._dtype)
        return _Seen(observation, everything, inputs)

    def _decide(self, parameters: Any, settings: Settings, state: EnvState, key: Array) -> _Decision:
        """Returns observation, action and joint targets of the coming step."""
        seen = self._look(state, settings)
        action, log_probability = self._policy(parameters, seen.observation.astype(jnp.float32), key)
        target, command = self.env.targets(state, action, settings)
        return _Decision(seen, action, log_probability, target, command)

    def _kept(self, state: EnvState, action: Array, transition: Transition, settings: Settings) -> tuple[Trace, Any]:
        """Returns the recorded values of trace and probe of a step."""
        scene = self.env.scene_of(state)
        probed = self._probe(scene, state.reset_state.object_index, settings.probe_data)
        return _traced(scene, state.frame, action, transition, self._traced), probed

    def _advance(
        self,
        parameters: Any,
        settings: Settings,
        state: EnvState,
        physics_state: PhysicsState,
        decision: _Decision,
        key_data: Array,
    ) -> tuple[dict[str, Any], Transition, tuple[Trace, Any], _Decision]:
        """Completes a control step and decides on the next one: one call between two steps of the engine.

        Only the changed part of the state is returned, because every array that passes through a call has a cost.
        """
        after, transition = self.env.advance(state, decision.target, physics_state, settings)
        kept = self._kept(after, decision.action, transition, settings)
        following = self._decide(parameters, settings, after, jax.random.wrap_key_data(key_data))
        changed = {name: new for name, new in after._asdict().items() if new is not getattr(state, name)}
        changed.pop("views")
        return changed, transition, kept, following

    def _collect_stepwise(self, parameters: Any, key: Array, steps: int, progress: Callable[[int], None]) -> Rollout:
        """Collects a rollout with an engine that JAX cannot trace; see `collect`."""
        # One more key than steps: the decision after the last step only yields `last_observation`.
        keys = jax.random.split(key, steps + 1)
        key_data = np.asarray(jax.random.key_data(keys))
        parameters, settings = _on_device((parameters, self._settings))
        assert self.state is not None
        decision = self._decide_jit(parameters, settings, self.state, keys[0])
        state = self.state._replace(views=None)
        rows: list[dict[str, Any]] = []
        extras = []
        for step in range(1, steps + 1):
            _, physics_state = self.physics.step(None, *map(np.asarray, decision.command))
            decided = decision
            changed, transition, kept, decision = self._advance_jit(
                parameters, settings, state, physics_state, decision, key_data[step]
            )
            state = state._replace(**changed)
            rows.append(_row(decided.seen, decided.action, decided.log_probability, transition))
            extras.append(kept)
            if self._bank is not None and np.asarray(transition.terminal).any():
                self._episode_key, episode_key = _split(self._episode_key)
                fresh = self._sample_jit(self._bank, episode_key, self._stationary)
                self.physics.reset(None, transition.terminal, fresh.reset_state)
                state = self._merge_jit(state, transition.terminal, fresh)
                physics_state = self.physics.read(None)
                decision = self._decide_jit(
                    parameters, settings, self._with_scene_jit(state, physics_state), keys[step]
                )
            progress(step)
        self.state = self._with_scene_jit(state, physics_state)
        columns, (trace, probed) = jax.tree.map(lambda *x: np.stack(x), *zip(rows, extras, strict=True))
        return _rollout(self.state, columns, decision.seen, trace, probed)

    def _collect_compiled(self, parameters: Any, key: Array, steps: int) -> Rollout:
        """Collects a rollout as one program; see `collect`."""
        (self.state, self._episode_key), rollout = self._scan_jit(*self._scan_arguments(parameters, key), steps=steps)
        return rollout

    def _scan_arguments(self, parameters: Any, key: Array) -> tuple[Any, ...]:
        """Arguments of `_scan` except for the steps."""
        parameters, bank, carry = _on_device((parameters, self._bank, (self.state, self._episode_key)))
        return parameters, self._settings, self._stationary, bank, carry, key

    def _scan(
        self,
        parameters: Any,
        settings: Settings,
        stationary: Array,
        bank: ConstraintBank | None,
        carry: tuple[EnvState, Array],
        key: Array,
        steps: int,
    ) -> tuple[tuple[EnvState, Array], Rollout]:
        """Scans `steps` control steps, with new episodes where some end; traced."""

        def renew(operand: Any) -> Any:
            state, episode_key, terminal = operand
            episode_key, own = jax.random.split(episode_key)
            assert bank is not None
            return self.env.restart(state, terminal, self._sample(bank, own, stationary)), episode_key

        def body(carry: Any, step_key: Array) -> tuple[Any, Any]:
            state, episode_key = carry
            seen = self._look(state, settings)
            action, log_probability = self._policy(parameters, seen.observation.astype(jnp.float32), step_key)
            state, transition = self.env.step(state, action, settings)
            kept = self._kept(state, action, transition, settings)
            carry = state, episode_key
            if bank is not None:
                ended = jnp.any(transition.terminal)
                carry = jax.lax.cond(ended, renew, lambda x: x[:2], (*carry, transition.terminal))
            return carry, (_row(seen, action, log_probability, transition), kept)

        carry, (columns, (trace, probed)) = jax.lax.scan(body, carry, jax.random.split(key, steps))
        state, _ = carry
        return carry, _rollout(state, columns, self._look(state, settings), trace, probed)


def _on_device(tree: Any) -> Any:
    """Commits the arrays to this process's device: uncommitted ones would cause another compilation."""
    return jax.device_put(tree, jax.local_devices()[0])


def _masses(objects: Sequence[GraspObject]) -> Array:
    """Masses (N,) in kg."""
    return _on_device(np.array([obj.mass for obj in objects], np.float32))


def _row(seen: _Seen, action: Array, log_probability: Array, transition: Transition) -> dict[str, Any]:
    """Fields of a `Rollout` for one control step."""
    return {
        **seen._asdict(),
        "action": action,
        "log_probability": log_probability,
        "reward": transition.reward,
        "terminal": transition.terminal,
        "truncated": transition.truncated,
        "occupancy": transition.occupancy,
    }


def _rollout(state: EnvState, columns: dict[str, Any], last: _Seen, trace: Trace, probed: Any) -> Rollout:
    """Returns the rollout of stacked rows (`_row`) that ends in this state, with the observations `last`."""
    return Rollout(
        **columns,
        last_observation=last.observation,
        last_privileged=last.privileged,
        episodes=state.finished,
        has_episode=state.has_finished,
        trace=trace,
        probed=probed,
    )


_split = jax.jit(lambda key: tuple(jax.random.split(key)))
"""Two random keys, in one call."""


def _traced(scene: Scene, frame: Frame, action: Array, transition: Transition, where: int | slice) -> Trace:
    """Recorded values of a step for one environment, or for several."""
    state, features = scene.state, scene.features
    force = jnp.sum(jnp.where(state.contact_found[where][..., None], state.contact_force[where], 0.0), -2)
    errors = [
        a[where] / jnp.maximum(b[where], 1.0) for a, b in (transition.errors[s.name] for s in metrics.specs(scene.task))
    ]
    way, slid = protocols.up(frame.height), protocols.slides(state.base_quaternion, frame.height)
    return Trace(
        q=state.q[where],
        u=(state.u + slid)[where],
        q_target=state.q_target[where],
        u_target=(state.u_target + slid)[where],
        wrist_position=(features.wrist_position + way)[where],
        wrist_quaternion=features.wrist_quaternion[where],
        object_position=(state.object_position + way)[where],
        object_quaternion=state.object_quaternion[where],
        contact_force=force,
        action=action[where],
        terms=transition.terms[where],
        errors=jnp.stack(errors, -1),
        table=state.table[where],
        terminal=transition.terminal[where],
    )


def finished_episodes(rollout: Rollout, task: TaskConfig) -> dict[str, np.ndarray]:
    """Metrics (E,) of the E finished episodes, by the names in `actors.env.episode_fields`."""
    rows = np.asarray(rollout.episodes)[np.asarray(rollout.has_episode)]
    return dict(zip(episode_fields(task), rows.T, strict=True))
