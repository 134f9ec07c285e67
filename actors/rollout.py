"""Rollouts and the compiled functions that produce them.

With an engine that JAX can trace the whole rollout is one program (`jax.lax.scan`); otherwise the
same functions are compiled separately around the engine's step. `actors.worker` drives both.
"""

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.actors import draws
from congrasp.actors import stress as protocols
from congrasp.actors.env import GraspEnv
from congrasp.actors.env_state import EnvState, Settings, Transition
from congrasp.actors.initial import InitialConditions
from congrasp.actors.physics.engine import Physics, PhysicsState
from congrasp.actors.stress import Frame
from congrasp.common.hands.spec import Hand
from congrasp.common.task import metrics
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.metrics import episode_fields
from congrasp.common.task.observation import observe
from congrasp.common.task.privileged import observe_for_teacher
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.scene import Scene
from congrasp.common.task.types import Action, Array

ActFunction = Callable[[Any, Array, Array], tuple[Array, Array]]
"""(parameters, observation (B, D) float32, random key) -> action (B, A), log-probability (B,)."""
Probe = Callable[[Scene, Array, Any], Any]
"""(scene after a control step, indices of the objects (B,), `Settings.probe_data`) -> a pytree of
arrays to record for every environment and step."""
Traced = Literal["first", "all", "none"]
"""Environments whose steps are recorded (`Trace`)."""
_BATCH_PER_RENEWED = 64
"""A batch of new episodes is the environments over this number: about three times as many as end in
a control step.
"""
LEAST_RENEWED = 8
"""Least number of episodes in a batch of new ones."""
_TRACED_ROWS: dict[Traced, int | slice] = {"first": 0, "all": slice(None), "none": slice(0)}


def no_probe(scene: Scene, index: Array, data: Any) -> None:
    """Probe that records nothing."""


class Trace(NamedTuple):
    """Recorded values of one environment, or of several, at every step, for logs and pictures (T
    leads).

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
    """(T, B) bool: it ended by its time limit with the object held
    (`actors.env_state.Transition`).
    """
    occupancy: Array
    """(T, 3), see `actors.physics.engine.PhysicsState`."""
    last_observation: Array
    """(B, D)."""
    episodes: Array
    """(B, fields) metrics of the last finished episode of each environment, in the order of
    `episode_fields`.
    """
    has_episode: Array
    """(B,) bool."""
    trace: Trace
    probed: Any
    """Result of the probe, with leading axis T; None without a probe."""
    teacher_observation: Array | None = None
    """(T, B, S) input of the teacher that labels the rollout (`common.task.privileged`)."""
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


class Programs:
    """Compiled functions of the rollouts of one hand, task, policy and batch size.

    The methods with an underscore are what the attributes without it compile.
    """

    def __init__(  # noqa: PLR0913
        self,
        hand: Hand,
        task: TaskConfig,
        engine: Physics | None,
        policy: ActFunction,
        *,
        batch: int,
        half_precision: bool,
        probe: Probe,
        traced: Traced,
        taught: bool,
    ):
        """Declares the functions; nothing is compiled yet. `actors.worker.RolloutWorker` describes
        the arguments.

        Args:
          engine: an engine that JAX can trace; None for one that is stepped between the functions.
        """
        self.env = GraspEnv(hand, task, engine)
        self._engine = engine
        self._policy = policy
        self._probe = probe
        self._batch = batch
        self._traced = _TRACED_ROWS[traced]
        self._taught = taught
        self._together = min(batch, max(LEAST_RENEWED, batch // _BATCH_PER_RENEWED))
        self._dtype = jnp.float16 if half_precision else jnp.float32
        self.sample = jax.jit(self._sample)
        self.begin = jax.jit(self._begin)
        self.renew = jax.jit(self._renew)
        self.restart = jax.jit(self._restart)
        self.with_scene = jax.jit(self.env.with_scene)
        self.look = jax.jit(self._look)
        self.decide = jax.jit(self._decide)
        self.advance = jax.jit(self._advance)
        self.scan = jax.jit(self._scan, static_argnames="steps")

    def _sample(self, bank: ConstraintBank, key: Array, stationary: Array) -> InitialConditions:
        """Draws initial conditions for all environments from the bank."""
        return draws.sample(self.env.hand, self.env.task, bank, key, self._batch, stationary)

    def _begin(self, conditions: InitialConditions, running: EnvState | None) -> EnvState:
        """Starts episodes in every environment; a compiled engine is started or, if it runs
        already, reset.
        """
        if self._engine is None:
            return self.env.state_of(conditions, None)
        if running is None:
            return self.env.reset(conditions)
        every = jnp.ones(self._batch, bool)
        physics = self._engine.reset(running.physics, every, conditions.reset_state)
        return self.env.state_of(conditions, physics)._replace(grasps=running.grasps)

    def _restart(self, state: EnvState, mask: Array, conditions: InitialConditions) -> EnvState:
        """Starts these episodes in the masked environments (B,); see `GraspEnv.restart`."""
        rows = jnp.where(mask, jnp.arange(self._batch), self._batch)
        return self.env.restart(state, rows, conditions)

    def _renew(
        self, bank: ConstraintBank, state: EnvState, key: Array, stationary: Array, ended: Array
    ) -> EnvState:
        """Draws new episodes for environments whose episodes ended (B,), a small batch at a
        time.
        """

        def renew_some(carry: tuple[EnvState, Array]) -> tuple[EnvState, Array]:
            """Draws a batch of the episodes that are left; returns which are left then."""
            state, left = carry
            rows = jnp.nonzero(left, size=self._together, fill_value=self._batch)[0]
            fresh = draws.sample(
                self.env.hand, self.env.task, bank, key, self._batch, stationary, rows
            )
            return self.env.restart(state, rows, fresh), left.at[rows].set(False, mode="drop")

        def is_any_left(carry: tuple[EnvState, Array]) -> Array:
            _, left = carry
            return jnp.any(left)

        state, _ = jax.lax.while_loop(is_any_left, renew_some, (state, ended))
        return state

    def _look(self, state: EnvState, settings: Settings) -> _Seen:
        """Returns the observations of the current control step."""
        env = self.env
        observation = observe(env.seen(state)).astype(self._dtype)
        for_teacher = None
        if self._taught:
            true = env.privileged(state)
            for_teacher = observe_for_teacher(true, env.seen(state), settings.control)
            for_teacher = for_teacher.astype(self._dtype)
        for_critic = None
        if settings.masses is not None:
            for_critic = env.critic_inputs(state, settings.masses).astype(self._dtype)
        return _Seen(observation, for_teacher, for_critic)

    def _decide(
        self, parameters: Any, settings: Settings, state: EnvState, key: Array
    ) -> _Decision:
        """Returns observation, action and joint targets of the coming step."""
        seen = self._look(state, settings)
        action, log_probability = self._policy(
            parameters, seen.observation.astype(jnp.float32), key
        )
        target, command = self.env.targets(state, action, settings)
        return _Decision(seen, action, log_probability, target, command)

    def _record_step(
        self, state: EnvState, action: Array, transition: Transition, settings: Settings
    ) -> tuple[Trace, Any]:
        """Returns the recorded values of trace and probe of a step."""
        scene = self.env.scene_of(state)
        probed = self._probe(scene, state.reset_state.object_index, settings.probe_data)
        return _trace_of(scene, state.frame, action, transition, self._traced), probed

    def _advance(
        self,
        parameters: Any,
        settings: Settings,
        state: EnvState,
        physics_state: PhysicsState,
        decision: _Decision,
        key_data: Array,
    ) -> tuple[dict[str, Any], Transition, tuple[Trace, Any], _Decision]:
        """Completes a control step and decides on the next one: one call between two steps of the
        engine.

        Only the changed part of the state is returned, because every array that passes through a
        call has a cost.
        """
        after, transition = self.env.advance(state, decision.target, physics_state, settings)
        recorded = self._record_step(after, decision.action, transition, settings)
        following = self._decide(parameters, settings, after, jax.random.wrap_key_data(key_data))
        changed = {}
        for name, value in after._asdict().items():
            if name != "views" and value is not getattr(state, name):
                changed[name] = value
        return changed, transition, recorded, following

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
            episode_key, drawn_key = jax.random.split(episode_key)
            assert bank is not None
            return self._renew(bank, state, drawn_key, stationary, terminal), episode_key

        def body(carry: Any, step_key: Array) -> tuple[Any, Any]:
            state, episode_key = carry
            seen = self._look(state, settings)
            action, log_probability = self._policy(
                parameters, seen.observation.astype(jnp.float32), step_key
            )
            state, transition = self.env.step(state, action, settings)
            recorded = self._record_step(state, action, transition, settings)
            carry = state, episode_key
            if bank is not None:
                ended = jnp.any(transition.terminal)
                carry = jax.lax.cond(ended, renew, lambda x: x[:2], (*carry, transition.terminal))
            return carry, (row_of(seen, action, log_probability, transition), recorded)

        carry, (columns, (trace, probed)) = jax.lax.scan(body, carry, jax.random.split(key, steps))
        state, _ = carry
        return carry, rollout_of(state, columns, self._look(state, settings), trace, probed)


@functools.lru_cache(maxsize=16)
def _shared_programs(
    hand: Hand, task: TaskConfig, policy: ActFunction, **settings: Any
) -> Programs:
    """Returns the programs around an engine that is stepped between them; the same ones for the
    same arguments.
    """
    return Programs(hand, task, None, policy, **settings)


def programs_of(
    hand: Hand, task: TaskConfig, engine: Physics, policy: ActFunction, **settings: Any
) -> Programs:
    """Returns the programs of rollouts on an engine.

    Workers on equal tasks share them, so that each is compiled once in a process; the programs of
    an engine that JAX can trace belong to that engine.
    """
    if engine.compiled:
        return Programs(hand, task, engine, policy, **settings)
    return _shared_programs(hand, task, policy, **settings)


def row_of(
    seen: _Seen, action: Array, log_probability: Array, transition: Transition
) -> dict[str, Any]:
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


def rollout_of(
    state: EnvState, columns: dict[str, Any], last: _Seen, trace: Trace, probed: Any
) -> Rollout:
    """Returns the rollout of stacked rows (`row_of`) that ends in this state, with the observations
    `last`.
    """
    return Rollout(
        **columns,
        last_observation=last.observation,
        last_privileged=last.privileged,
        episodes=state.finished,
        has_episode=state.has_finished,
        trace=trace,
        probed=probed,
    )


def _trace_of(
    scene: Scene, frame: Frame, action: Array, transition: Transition, where: int | slice
) -> Trace:
    """Recorded values of a step for one environment, or for several."""
    state = scene.state
    features = scene.features
    is_contact = state.contact_found[where][..., None]
    force = jnp.sum(jnp.where(is_contact, state.contact_force[where], 0.0), -2)
    errors = []
    for spec in metrics.specs(scene.task):
        numerator, denominator = transition.errors[spec.name]
        errors.append(numerator[where] / jnp.maximum(denominator[where], 1.0))
    way = protocols.up(frame.height)
    slid = protocols.slides(state.base_quaternion, frame.height)
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
    """Metrics (E,) of the E finished episodes, by name (`common.task.metrics.episode_fields`)."""
    rows = np.asarray(rollout.episodes)[np.asarray(rollout.has_episode)]
    return dict(zip(episode_fields(task), rows.T, strict=True))
