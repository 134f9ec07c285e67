"""The task as a Gymnasium vector environment, for external learners."""

import dataclasses
from typing import Any, Literal

import gymnasium as gym
import jax
import numpy as np
from gymnasium.vector import AutoresetMode

from congrasp.actors import initial
from congrasp.actors.physics import make_physics
from congrasp.actors.rollout import Rollout
from congrasp.actors.training_set import training_set
from congrasp.actors.worker import RolloutWorker
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.runtime.engines import PhysicsName
from congrasp.common.runtime.parallel import cores
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.metrics import episode_fields
from congrasp.common.task.observation import layout
from congrasp.services.gym import ID
from congrasp.services.train.presets import FULL, get_preset

ACTION = 3.0
"""Bound of the action space, in units of action: five initial standard deviations of the recipe's
policy.
"""


class GraspVectorEnv(gym.vector.VectorEnv[Any, Any, Any]):
    """Vector environment of hands that grasp objects under sampled constraints (`actors.env`).

    An episode ends with its time limit while the object is held (truncated), or when it is not held
    (terminated). Ended environments are reset in the same step: `infos["final_obs"]` (num_envs, D)
    holds their last observations, and `infos["episode"]` the metrics of ended episodes by name
    (num_envs,), where `infos["_final_obs"]` is true.
    """

    def __init__(
        self,
        num_envs: int = 64,
        *,
        hand: str = "human",
        objects: int = 64,
        physics: PhysicsName = "auto",
        arrays: Literal["numpy", "jax"] = "numpy",
        autoreset: bool = True,
        **task: Any,
    ):
        """Creates objects, their constraints and the engine; the first calls of `reset` and `step`
        compile.

        Args:
          num_envs: number of parallel environments.
          hand: name or file of the hand.
          objects: number of procedural objects, of the families of the hand's training.
          physics: engine, see `congrasp train --physics`.
          arrays: array type of observations, rewards and flags. JAX arrays stay on the device, and
            other libraries can import them through DLPack.
          autoreset: resets ended environments automatically; otherwise all wait for `reset`.
          **task: fields of `TaskConfig` other than those of the hand's training.

        Raises:
          CongraspError: there is no environment, or no such hand, engine or field of the task.
        """
        if num_envs < 1:
            raise CongraspError(f"There are {num_envs} environments.", "Make one or more.")
        config = get_preset(FULL, hand)
        self.task = dataclasses.replace(
            config.task, **{"reward": config.curriculum.reward, **_known(task)}
        )
        self.hand = get_hand(config.task.hand)
        pool = dataclasses.replace(config.objects, count=objects)
        made = training_set(self.hand, dataclasses.replace(config, task=self.task, objects=pool), 0)
        engine = make_physics(physics, self.hand, self.task, made.objects, threads=cores())
        self._worker = RolloutWorker(
            self.hand, self.task, engine, None, _given, batch=num_envs, seed=0, half_precision=False
        )
        self._bank, self._autoreset, self._arrays = made.bank, autoreset, arrays
        self._key = jax.random.key(0)
        self.num_envs = num_envs
        self.metadata = {
            "autoreset_mode": AutoresetMode.SAME_STEP if autoreset else AutoresetMode.DISABLED
        }
        size = sum(count for _, count in layout(self.hand, self.task))
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.single_action_space = gym.spaces.Box(
            -ACTION, ACTION, (len(self.hand.motors) + 6,), np.float32
        )
        self.observation_space = gym.vector.utils.batch_space(
            self.single_observation_space, num_envs
        )
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Starts new episodes in all environments; returns observations (num_envs, D).

        Args:
          seed: seed of all later draws.
          options: not supported.
        """
        if seed is not None:
            self._key = jax.random.key(seed)
        self._worker.begin(self._drawn())
        return self._given_out(self._worker.observe()), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Simulates one control step under actions (num_envs, A): obs, rewards, terminated,
        truncated, infos.
        """
        rollout = self._worker.collect(jax.numpy.asarray(actions, np.float32), 1)
        observation, infos = rollout.last_observation, {}
        ended = np.asarray(rollout.terminal[0])
        if self._autoreset and ended.any():
            infos = {
                "final_obs": self._given_out(observation),
                "_final_obs": ended,
                **self._episodes(rollout),
            }
            self._worker.renew(ended, self._drawn())
            observation = self._worker.observe()
        terminated = rollout.terminal[0] & ~rollout.truncated[0]
        found = (observation, rollout.reward[0], terminated, rollout.truncated[0])
        return (*map(self._given_out, found), infos)

    def close_extras(self, **kwargs: Any) -> None:
        """Closes the engine."""
        self._worker.physics.close()

    def _drawn(self) -> initial.InitialConditions:
        """Draws initial conditions of episodes."""
        self._key, key = jax.random.split(self._key)
        return self._worker.programs.sample(self._bank, key, np.array(False))

    def _episodes(self, rollout: Rollout) -> dict[str, Any]:
        """Metrics of the episodes that have just ended."""
        columns = np.asarray(rollout.episodes).T
        named = zip(episode_fields(self.task), columns, strict=True)
        ended = np.asarray(rollout.has_episode)
        found = {
            name.removeprefix("episode/"): column
            for name, column in named
            if name.startswith("episode/")
        }
        return {"episode": found, "_episode": ended}

    def _given_out(self, array: Any) -> Any:
        """Converts an array to the requested type."""
        return np.asarray(array) if self._arrays == "numpy" else jax.numpy.asarray(array)


class GraspEnv(gym.Env[np.ndarray, np.ndarray]):
    """One hand and one object: a vector environment of size one, which waits for `reset` at the
    end.
    """

    def __init__(self, **settings: Any):
        """Creates the environment; for the arguments see `GraspVectorEnv`."""
        self._vector = GraspVectorEnv(1, autoreset=False, **settings)
        self.observation_space = self._vector.single_observation_space
        self.action_space = self._vector.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict]:
        """Starts a new episode; returns its first observation (D,)."""
        super().reset(seed=seed)
        observation, infos = self._vector.reset(seed=seed)
        return observation[0], infos

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Simulates one control step under an action (A,)."""
        observation, reward, terminated, truncated, infos = self._vector.step(action[None])
        return observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), infos

    def close(self) -> None:
        """Closes the engine."""
        self._vector.close()


def make_vec(id: str = ID, num_envs: int = 64, **settings: Any) -> GraspVectorEnv:
    """Creates a vector environment by its id; for the settings see `GraspVectorEnv`.

    Raises:
      CongraspError: there is no such environment, hand, engine or field of the task.
    """
    if id != ID:
        raise CongraspError(f"There is no environment '{id}'.", f"Known: {ID}.")
    return GraspVectorEnv(num_envs, **settings)


def _given(action: Any, observation: Any, key: Any) -> tuple[Any, Any]:
    """Policy of an external learner: its parameters are the actions."""
    return action, jax.numpy.zeros(action.shape[0])


def _known(task: dict[str, Any]) -> dict[str, Any]:
    """Returns the given fields of the task; raises a CongraspError for an unknown one."""
    names = [field.name for field in dataclasses.fields(TaskConfig)]
    for name in task:
        if name not in names:
            raise CongraspError(f"The task has no field '{name}'.", f"Known: {', '.join(names)}.")
    return task
