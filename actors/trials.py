"""Grasps side by side that begin as they are told, all of them recorded: what is tried for one object.

Training and evaluation draw their episodes at random (`actors.rollout`); here someone asks for certain ones.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from actors import environment
from actors.environment import METRICS, EnvironmentState
from actors.physics.engine import Readout, World
from actors.physics.native import NativePhysics
from actors.rollout import Trace, traced
from common.config import TaskConfig
from common.constraints.priority import Request, resolve
from common.hands.spec import Hand
from common.objects.spec import GraspObject
from common.policy.bundle import PolicyBundle, mean_action
from common.task.control import decode
from common.task.observation import observe
from common.task.types import Array, Goal, Surface


class Beginnings(NamedTuple):
    """B episodes that are asked for."""

    request: Request
    """Constraints, object frame."""
    surface: Surface
    """Labelled surface points."""
    rest: Array
    """(B, 7) the object's pose on the table."""


class Outcome(NamedTuple):
    """What became of them."""

    goal: Goal
    """Active constraints after the priority rules."""
    redirected: np.ndarray
    """(B,) bool, see `common.constraints.priority.Resolution`."""
    aligned: np.ndarray
    """(B,) bool."""
    metrics: dict[str, np.ndarray]
    """(B,) each, by the names in `METRICS`."""
    trace: Trace
    """(T, B, ...)."""


class Trials:
    """A policy that grasps one object after another, each in several ways at once, by its mean action."""

    def __init__(self, hand: Hand, task: TaskConfig, bundle: PolicyBundle, *, hold: int, threads: int):
        """Compiles nothing yet.

        Args:
          hand: the hand.
          task: the task; of its hold only the part that counts for success is taken.
          bundle: the policy.
          hold: control steps without the table.
          threads: threads of the physics.
        """
        self._hand, self._task, self._bundle = hand, task, bundle
        self._hold, self._threads = hold, threads
        self._physics: NativePhysics | None = None
        self._begin_jit = jax.jit(self._begin)
        self._decide_jit = jax.jit(self._decide)
        self._score_jit = jax.jit(self._score)

    @property
    def steps(self) -> int:
        """T, control steps of an episode."""
        return self._task.approach_steps + self._hold

    def run(
        self, obj: GraspObject, beginnings: Beginnings, progress: Callable[[int], None] = lambda step: None
    ) -> Outcome:
        """Grasps an object in B ways; another B than the last one is compiled anew.

        Args:
          obj: the object.
          beginnings: the episodes.
          progress: told how many of the T control steps are done.
        """
        env, redirected, aligned = self._begin_jit(beginnings)
        if self._physics is None:
            self._physics = NativePhysics(self._hand, self._task, [obj], self._threads)
        physics = self._physics.replace_objects(None, [obj])
        physics.start(env.world)
        acting, control = self._bundle.acting, jax.device_put(self._task.control)
        readout, rows = physics.read(None), []
        for step in range(1, self.steps + 1):
            action, target, joints, table = self._decide_jit(acting, control, env, readout)
            _, readout = physics.step(None, np.asarray(joints), np.asarray(table))
            env, row = self._score_jit(env, readout, target, action)
            rows.append(row)
            progress(step)
        metrics = np.asarray(env.finished)[:, : len(METRICS)].T
        trace = jax.tree.map(lambda *steps: np.stack(steps), *rows)
        flags = (np.asarray(redirected), np.asarray(aligned))
        return Outcome(env.goal, *flags, dict(zip(METRICS, metrics, strict=True)), trace)

    def renew(self, bundle: PolicyBundle) -> None:
        """Newer weights of the same policy; nothing is compiled anew."""
        self._bundle.spec.require(bundle.spec, "that was to take its place")
        self._bundle = bundle

    def close(self) -> None:
        """Ends the physics' threads."""
        if self._physics is not None:
            self._physics.close()

    def _begin(self, asked: Beginnings) -> tuple[EnvironmentState, Array, Array]:
        resolution = resolve(self._hand, asked.surface, asked.request)
        goal, pose = resolution.goal, asked.request.pose
        batch = pose.shape[0]
        q = jnp.where(pose[:, None], goal.pose_q, jnp.array(self._hand.q_open))
        position, quaternion = asked.rest[:, :3], asked.rest[:, 3:]
        wrist = environment.initial_wrist(
            self._hand, self._task, goal, q, asked.request.trajectory, position, quaternion
        )
        nominal, index = jnp.ones(batch), jnp.zeros(batch, jnp.int32)
        world = World(index, nominal, nominal, *wrist, q, position, quaternion, jnp.zeros(batch, bool))
        hold = jnp.full(batch, self._hold, jnp.int32)
        env = environment.begin(world, goal, asked.surface, index, hold, jax.random.key(0))
        return env, resolution.redirected, resolution.aligned

    def _decide(self, acting: Any, control: Any, env: EnvironmentState, readout: Readout) -> tuple[Any, ...]:
        scene, seen = environment.moment(self._hand, self._task, env, readout)
        observation = observe(self._task, scene, seen, env.goal)
        action = mean_action(self._bundle.spec.layout, acting, observation)
        target = decode(self._hand, control, scene, seen, env.goal, action)
        joints = jnp.concatenate([target.u_target, target.q_target], -1)
        return action, target, joints, environment.table_present(env, self._task)

    def _score(self, env: EnvironmentState, readout: Readout, target: Any, action: Array) -> tuple[Any, Trace]:
        env, score, scene, seen = environment.score(self._hand, self._task, self._task.reward, env, readout, target)
        return env, traced(scene, seen, action, score, slice(None))
