"""Rollouts: policy, decode, physics, reward and reset for T control steps of a batch of worlds.

With a compiled engine the whole rollout is one program (`jax.lax.scan`); with `native` the same functions are
compiled piecewise around the C step.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from actors import environment, references
from actors.environment import EPISODE_FIELDS, EnvironmentState
from actors.physics.engine import Physics, Readout, where_worlds
from actors.taskset import TaskSet
from common.config import RewardWeights, TaskConfig
from common.hands.spec import Hand
from common.objects.spec import GraspObject
from common.task.control import decode
from common.task.features import Features
from common.task.observation import observe
from common.task.types import Action, Array, Goal, SceneState

Policy = Callable[[Any, Array, Array], tuple[Array, Array]]
"""(parameters, observation (B, D) float32, random key) -> action (B, A), log-probability (B,)."""
Probe = Callable[[SceneState, Features], Any]
"""The moment after a control step -> a pytree of arrays that someone wants of every world and step."""


class Trace(NamedTuple):
    """What is kept of world 0, or of several, at every step, for logs and pictures (T leads)."""

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
    table: Array
    terminal: Array


class Rollout(NamedTuple):
    """T control steps of B worlds."""

    observation: Array
    """(T, B, D)."""
    action: Array
    """(T, B, A)."""
    log_probability: Array
    """(T, B) under the behaviour policy."""
    reward: Array
    """(T, B)."""
    terminal: Array
    """(T, B) bool."""
    usage: Array
    """(T, 2), see `actors.physics.engine.Readout`."""
    last_observation: Array
    """(B, D)."""
    episodes: Array
    """(B, fields) metrics of the last episode that ended in each world, in the order of `EPISODE_FIELDS`."""
    has_episode: Array
    """(B,) bool."""
    trace: Trace
    probed: Any
    """What the probe returned, with leading axis T; None without a probe."""


class RolloutWorker:
    """Worlds that go on from one rollout to the next."""

    def __init__(
        self,
        hand: Hand,
        task: TaskConfig,
        physics: Physics,
        taskset: TaskSet,
        policy: Policy,
        *,
        batch: int,
        seed: int,
        half: bool,
        probe: Probe = lambda scene, seen: None,
        traced: int | slice = 0,
    ):
        """Starts fresh episodes.

        Args:
          hand: the hand.
          task: the task.
          physics: the engine; its objects are those of `taskset`.
          taskset: what episodes are drawn from.
          policy: a pure function; parameters are given at each rollout.
          batch: B, number of worlds.
          seed: seed of episodes and actions.
          half: observations are rounded to float16, for the policy as well as for the learner.
          probe: what else to keep of every step.
          traced: of which worlds a trace is kept.
        """
        self.physics = physics
        self._hand, self._task, self._taskset, self._policy = hand, task, taskset, policy
        self._probe, self._traced = probe, traced
        self._dtype = jnp.float16 if half else jnp.float32
        self._weights, self._control, self._stationary = task.reward, task.control, np.array(False)
        episode_key, self._key = jax.random.split(jax.random.key(seed))
        self.env: EnvironmentState = jax.jit(functools.partial(environment.start, hand, task, batch=batch))(
            taskset, episode_key, stationary=self._stationary
        )
        self.state = physics.start(self.env.world)
        self._act_jit = jax.jit(self._act)
        self._advance_jit = jax.jit(self._advance)
        self._restart_jit = jax.jit(functools.partial(environment.restart, hand, task))
        self._moment_jit = jax.jit(functools.partial(environment.moment, hand, task))
        self._scan_jit = jax.jit(self._scan, static_argnames="steps")
        self._moment: tuple[SceneState, Features] = self._moment_jit(self.env, physics.read(self.state))

    def configure(self, weights: RewardWeights, *, stationary: bool) -> None:
        """Sets the reward's weights, and whether the objects of episodes that start from now on are held in place."""
        self._weights, self._stationary = weights, np.array(stationary)

    def replace_objects(self, objects: Sequence[GraspObject], taskset: TaskSet) -> None:
        """Episodes that start from now on are drawn from these objects, as many as before, and their task set."""
        self.state = self.physics.replace_objects(self.state, objects)
        self._taskset = taskset
        found = self.env.grasps.found
        self.env = self.env._replace(grasps=self.env.grasps._replace(found=jnp.zeros_like(found)))

    def restart(self) -> None:
        """Fresh episodes in every world."""
        everywhere = jnp.ones_like(self.env.bad)
        self.begin(self._restart_jit(self._taskset, self.env, everywhere, self._stationary))

    def begin(self, env: EnvironmentState) -> None:
        """Goes on with these episodes, which have just begun, one for each world."""
        self.env = env
        self.state = self.physics.reset(self.state, jnp.ones_like(env.bad), env.world)
        self._moment = self._moment_jit(self.env, self.physics.read(self.state))

    @property
    def taskset(self) -> TaskSet:
        """What episodes are drawn from at present."""
        return self._taskset

    def forget_references(self) -> None:
        """Episodes that start from now on have no reference pose or trajectory, until there are renewed ones."""
        none = jnp.zeros_like(self._taskset.pose_valid)
        self._taskset = self._taskset._replace(pose_valid=none)

    def renew_references(self) -> None:
        """Puts the grasps that succeeded since the last call into the task set as reference poses."""
        self._key, key = jax.random.split(self._key)
        grasps = self.env.grasps
        self._taskset = references.renew(self._hand, self._task, self._taskset, grasps, key)
        self.env = self.env._replace(grasps=grasps._replace(found=jnp.zeros_like(grasps.found)))

    def collect(self, parameters: Any, steps: int) -> Rollout:
        """The next `steps` control steps under these policy parameters."""
        self._key, key = jax.random.split(self._key)
        self.env = self.env._replace(has_finished=jnp.zeros_like(self.env.has_finished))
        run = self._collect_compiled if self.physics.compiled else self._collect_stepwise
        return run(parameters, key, steps)

    def _act(
        self, parameters: Any, control: Any, env: EnvironmentState, scene: SceneState, seen: Features, key: Array
    ) -> tuple[Array, Array, Array, Action, Array, Array]:
        observation = observe(self._task, scene, seen, env.goal).astype(self._dtype)
        action, log_probability = self._policy(parameters, observation.astype(jnp.float32), key)
        target = decode(self._hand, control, scene, seen, env.goal, action)
        joints = jnp.concatenate([target.u_target, target.q_target], -1)
        return observation, action, log_probability, target, joints, environment.table_present(env, self._task)

    def _score(
        self, weights: Any, env: EnvironmentState, readout: Readout, target: Action, action: Array
    ) -> tuple[EnvironmentState, environment.Score, SceneState, Features, tuple[Trace, Any]]:
        env, score, scene, seen = environment.score(self._hand, self._task, weights, env, readout, target)
        return env, score, scene, seen, (traced(scene, seen, action, score, self._traced), self._probe(scene, seen))

    def _advance(
        self,
        parameters: Any,
        weights: Any,
        control: Any,
        env: EnvironmentState,
        readout: Readout,
        decision: Any,
        keys: Array,
        step: Array,
    ) -> tuple[dict[str, Any], environment.Score, tuple[Trace, Any], Any]:
        """Scores a control step and decides on the next one: one call between two physics steps.

        Of the environment only what changed is returned, because every array that passes through a call has its price.
        """
        _, action, _, target, _, _ = decision
        after, score, scene, seen, kept = self._score(weights, env, readout, target, action)
        changed = {name: new for name, new in after._asdict().items() if new is not getattr(env, name)}
        key = jax.random.wrap_key_data(keys[step])
        return changed, score, kept, self._act(parameters, control, after, scene, seen, key)

    def _collect_stepwise(self, parameters: Any, key: Array, steps: int) -> Rollout:
        # One key more than there are steps: what is decided after the last one only yields `last_observation`.
        keys = jax.random.split(key, steps + 1)
        key_data = jax.random.key_data(keys)
        weights, control = jax.device_put((self._weights, self._control))
        decision = self._act_jit(parameters, control, self.env, *self._moment, keys[0])
        rows, extras = [], []
        for step in range(1, steps + 1):
            observation, action, log_probability, _, joints, table = decision
            self.state, readout = self.physics.step(self.state, np.asarray(joints), np.asarray(table))
            changed, score, kept, decision = self._advance_jit(
                parameters, weights, control, self.env, readout, decision, key_data, step
            )
            self.env = self.env._replace(**changed)
            rows.append((observation, action, log_probability, score.reward, score.terminal, readout.usage))
            extras.append(kept)
            if np.asarray(score.terminal).any():
                self.env = self._restart_jit(self._taskset, self.env, score.terminal, self._stationary)
                self.state = self.physics.reset(self.state, score.terminal, self.env.world)
                readout = self.physics.read(self.state)
                moment = self._moment_jit(self.env, readout)
                decision = self._act_jit(parameters, control, self.env, *moment, keys[step])
        self._moment = self._moment_jit(self.env, readout)
        columns = [np.stack(column) for column in zip(*rows, strict=True)]
        trace, probed = jax.tree.map(lambda *x: np.stack(x), *extras)
        last, *_ = decision
        return Rollout(*(*columns, last, self.env.finished, self.env.has_finished, trace, probed))

    def _collect_compiled(self, parameters: Any, key: Array, steps: int) -> Rollout:
        # Committed to the device, whether they were there already or not: anything else would compile once more.
        parameters, taskset, carry = jax.device_put(
            (parameters, self._taskset, (self.env, self.state, self._moment)), jax.local_devices()[0]
        )
        carry, rollout = self._scan_jit(
            parameters, self._weights, self._control, self._stationary, taskset, carry, key, steps=steps
        )
        self.env, self.state, self._moment = carry
        return rollout

    def _scan(
        self,
        parameters: Any,
        weights: Any,
        control: Any,
        stationary: Array,
        taskset: TaskSet,
        carry: Any,
        key: Array,
        steps: int,
    ) -> tuple[Any, Rollout]:
        physics = self.physics

        def body(carry: Any, step_key: Array) -> tuple[Any, Any]:
            env, state, (scene, seen) = carry
            observation, action, log_probability, target, joints, table = self._act(
                parameters, control, env, scene, seen, step_key
            )
            state, readout = physics.step(state, joints, table)
            env, score, scene, seen, kept = self._score(weights, env, readout, target, action)

            def renew(operand: Any) -> Any:
                env, state, ended = operand
                env = environment.restart(self._hand, self._task, taskset, env, score.terminal, stationary)
                state = physics.reset(state, score.terminal, env.world)
                # The worlds that go on keep their contacts, which `read` does not know.
                fresh = environment.moment(self._hand, self._task, env, physics.read(state))
                return env, state, where_worlds(score.terminal, fresh, ended)

            carry = jax.lax.cond(jnp.any(score.terminal), renew, lambda x: x, (env, state, (scene, seen)))
            return carry, (observation, action, log_probability, score.reward, score.terminal, readout.usage, kept)

        carry, (*columns, (trace, probed)) = jax.lax.scan(body, carry, jax.random.split(key, steps))
        env, _, (scene, seen) = carry
        last = observe(self._task, scene, seen, env.goal).astype(self._dtype)
        return carry, Rollout(*(*columns, last, env.finished, env.has_finished, trace, probed))


def traced(scene: SceneState, seen: Features, action: Array, score: environment.Score, worlds: int | slice) -> Trace:
    """What is kept of a step of one world, or of several."""
    force = jnp.sum(jnp.where(scene.contact_found[worlds][..., None], scene.contact_force[worlds], 0.0), -2)
    return Trace(
        q=scene.q[worlds],
        u=scene.u[worlds],
        q_target=scene.q_target[worlds],
        u_target=scene.u_target[worlds],
        wrist_position=seen.wrist_position[worlds],
        wrist_quaternion=seen.wrist_quaternion[worlds],
        object_position=scene.object_position[worlds],
        object_quaternion=scene.object_quaternion[worlds],
        contact_force=force,
        action=action[worlds],
        terms=score.terms[worlds],
        table=scene.table[worlds],
        terminal=score.terminal[worlds],
    )


def goal_of_world(goal: Goal, index: int = 0) -> Goal:
    """The goal of one world, without the batch axis, as NumPy."""
    return Goal(*(np.asarray(field)[index] for field in goal))


def finished_episodes(rollout: Rollout) -> dict[str, np.ndarray]:
    """Metrics (E,) of the E episodes that ended, by the names in `EPISODE_FIELDS`."""
    rows = np.asarray(rollout.episodes)[np.asarray(rollout.has_episode)]
    return dict(zip(EPISODE_FIELDS, rows.T, strict=True))
