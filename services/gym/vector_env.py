"""The task as a Gymnasium vector environment, for external learners."""

import dataclasses
from typing import Any, Literal

import gymnasium as gym
import jax
import numpy as np
from gymnasium.vector import AutoresetMode

from congrasp.actors.physics import make_physics
from congrasp.actors.rollout import Rollout
from congrasp.actors.training_set import training_set
from congrasp.actors.worker import RolloutWorker
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.ranges import task_faults
from congrasp.common.runtime.engines import PhysicsName
from congrasp.common.runtime.entry import compiling_entry, entry
from congrasp.common.runtime.resources import cores
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.metrics import episode_fields
from congrasp.common.task.observation import layout
from congrasp.services.gym import ID
from congrasp.services.gym.seeds import EpisodeStreams, Seed
from congrasp.services.train.presets import FULL, get_preset

ACTION = 3.0
"""Bound of the action space, in units of action: five initial standard deviations of the recipe's
policy.
"""
METRICS = "metrics"
"""Key of the metrics of ended episodes; `episode` belongs to Gymnasium's wrappers."""
_RESET_MASK = "reset_mask"
_PREFIX = "episode/"


class GraspVectorEnv(gym.vector.VectorEnv[Any, Any, Any]):
    """Vector environment of hands that grasp objects under sampled constraints (`actors.env`).

    An episode ends with its time limit while the object is held (truncated), or when it is not held
    (terminated). `infos["metrics"]` then holds the metrics of ended episodes by name (num_envs,),
    where `infos["_metrics"]` is true.

    The start of the next episode depends on the autoreset mode, as in Gymnasium:

    * `SAME_STEP`: in the same step. `infos["final_obs"]` (num_envs, D) holds the last observations
      where `infos["_final_obs"]` is true, and `infos["final_info"]` the metrics again.
    * `NEXT_STEP`: in the next step, which ignores the action and has reward 0.
    * `DISABLED`: with a call of `reset`, by `options={"reset_mask": ended}` for some environments.
    """

    @compiling_entry
    def __init__(
        self,
        num_envs: int = 64,
        *,
        hand: str = "human",
        objects: int = 64,
        physics: PhysicsName = "auto",
        arrays: Literal["numpy", "jax"] = "numpy",
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        **task: Any,
    ):
        """Creates objects, their constraints and the engine; the first calls of `reset` and `step`
        compile.

        Args:
          num_envs: number of parallel environments.
          hand: name or file of the hand.
          objects: number of procedural objects, of the families of the hand's training.
          physics: engine, see `congrasp train --physics`.
          arrays: array type of observations, rewards and flags. NumPy arrays are copies, which the
            caller may change. JAX arrays stay on the device, and other libraries can import them
            through DLPack.
          autoreset_mode: mode of Gymnasium, or its name or value.
          **task: fields of `TaskConfig` other than those of the hand's training. `autoreset=False`
            is short for the mode DISABLED.

        Raises:
          CongraspError: there is no environment, or no such hand, engine, mode or field of the
            task.
        """
        if num_envs < 1:
            raise CongraspError(f"num_envs is {num_envs}.", "It must be at least 1.")
        if not task.pop("autoreset", True):
            autoreset_mode = AutoresetMode.DISABLED
        self._mode = _mode_of(autoreset_mode)
        config = get_preset(FULL, hand)
        fields = {"reward": config.curriculum.reward, **_task_fields(task)}
        self.task = dataclasses.replace(config.task, **fields)
        for fault in task_faults(self.task):
            raise CongraspError(f"The task's {fault}.", "Pass a value in the range.")
        self.hand = get_hand(config.task.hand)
        pool = dataclasses.replace(config.objects, count=objects)
        prepared = training_set(
            self.hand, dataclasses.replace(config, task=self.task, objects=pool), 0
        )
        engine = make_physics(physics, self.hand, self.task, prepared.objects, threads=cores())
        self._worker = RolloutWorker(
            self.hand,
            self.task,
            engine,
            None,
            _commanded,
            batch=num_envs,
            seed=0,
            half_precision=False,
        )
        self._streams = EpisodeStreams(self.hand, self.task, prepared.bank, num_envs)
        self._arrays = arrays
        self._begun = False
        self._pending = np.zeros(num_envs, bool)
        self.num_envs = num_envs
        self.metadata = {"autoreset_mode": self._mode}
        self._define_spaces()

    @compiling_entry
    def reset(
        self, *, seed: Seed = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Starts new episodes; returns observations (num_envs, D).

        Args:
          seed: seed of all later draws: non-negative integers of any size, one for each
            environment; or one integer, of which environment i gets i more. Without a seed the
            first episodes differ in each process.
          options: `reset_mask` (num_envs,) bool starts new episodes only where it is true.

        Raises:
          CongraspError: seeds or mask do not fit the environments, there is another option, or the
            environment is closed.
        """
        self._require_open()
        mask = self._reset_mask(options)
        self._streams.seed(seed)
        if isinstance(seed, int | np.integer):
            self._np_random, self._np_random_seed = gym.utils.seeding.np_random(int(seed))
        conditions = self._streams.draw(mask)
        if mask.all():
            self._worker.begin(conditions)
        else:
            self._require_begun()
            self._worker.renew(mask, conditions)
        self._begun = True
        self._pending = self._pending & ~mask
        return self._exported(self._worker.observe()), {}

    @entry
    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Simulates one control step under actions (num_envs, A): obs, rewards, terminated,
        truncated, infos.

        Raises:
          CongraspError: the actions are of another shape or not finite, no episode has begun, or
            the environment is closed.
        """
        self._require_open()
        self._require_begun()
        rollout = self._worker.collect(self._checked(actions), 1)
        observation = rollout.last_observation
        reward = rollout.reward[0]
        ended = np.array(rollout.terminal[0])
        truncated = np.array(rollout.truncated[0])
        renewed = np.zeros(self.num_envs, bool)
        if self._mode is AutoresetMode.NEXT_STEP:
            renewed = self._pending
            ended = ended & ~renewed
            truncated = truncated & ~renewed
            reward = jax.numpy.where(renewed, 0.0, reward)
            self._pending = ended
        infos = self._infos(rollout, ended)
        if self._mode is AutoresetMode.SAME_STEP:
            renewed = ended
            if ended.any():
                infos |= self._final(observation, ended, infos)
        if renewed.any():
            self._worker.renew(renewed, self._streams.draw(renewed))
            observation = self._worker.observe()
        return (
            self._exported(observation),
            self._exported(reward),
            self._exported(ended & ~truncated),
            self._exported(truncated),
            infos,
        )

    def close_extras(self, **kwargs: Any) -> None:
        """Closes the engine."""
        self._worker.physics.close()

    def _define_spaces(self) -> None:
        """Sets the spaces of observations and actions."""
        size = sum(count for _, count in layout(self.hand, self.task))
        actions = len(self.hand.motors) + 6
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.single_action_space = gym.spaces.Box(-ACTION, ACTION, (actions,), np.float32)
        self.observation_space = gym.vector.utils.batch_space(
            self.single_observation_space, self.num_envs
        )
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, self.num_envs)

    def _require_open(self) -> None:
        """Raises a CongraspError once the environment is closed."""
        if self.closed:
            raise CongraspError("The environment is closed.", "Make another one.")

    def _require_begun(self) -> None:
        """Raises a CongraspError before the first call of `reset`."""
        if not self._begun:
            raise CongraspError("No episode has begun.", "Call reset for all environments first.")

    def _reset_mask(self, options: dict[str, Any] | None) -> np.ndarray:
        """Returns the environments (num_envs,) bool that a call of `reset` restarts."""
        options = options or {}
        for name in options:
            if name != _RESET_MASK:
                raise CongraspError(f"There is no option '{name}'.", f"Known: {_RESET_MASK}.")
        if _RESET_MASK not in options:
            return np.ones(self.num_envs, bool)
        mask = np.asarray(options[_RESET_MASK])
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise CongraspError(
                f"{_RESET_MASK} has shape {mask.shape} and type {mask.dtype}.",
                f"It must have shape ({self.num_envs},) and type bool.",
            )
        if not mask.any():
            raise CongraspError(f"{_RESET_MASK} is false everywhere.", "Set one or more.")
        return mask

    def _checked(self, actions: Any) -> jax.Array:
        """Returns actions (num_envs, A) float32."""
        shape = self.action_space.shape
        try:
            array = jax.numpy.asarray(actions, np.float32)
        except (TypeError, ValueError):
            raise CongraspError(
                "The actions are not an array of numbers.", f"Pass one of shape {shape}."
            ) from None
        if array.shape != shape:
            raise CongraspError(f"The actions have shape {array.shape}.", f"Pass {shape}.")
        if not jax.numpy.isfinite(array).all():
            raise CongraspError("An action is not finite.", "Pass finite numbers.")
        return array

    def _infos(self, rollout: Rollout, ended: np.ndarray) -> dict[str, Any]:
        """Metrics of the episodes that have just ended (num_envs,), if there are any."""
        if not ended.any():
            return {}
        columns = np.array(rollout.episodes).T
        named = zip(episode_fields(self.task), columns, strict=True)
        metrics = {
            name.removeprefix(_PREFIX): column for name, column in named if name.startswith(_PREFIX)
        }
        return {METRICS: metrics, f"_{METRICS}": ended.copy()}

    def _final(self, observation: Any, ended: np.ndarray, infos: dict[str, Any]) -> dict[str, Any]:
        """Entries of Gymnasium for episodes that end and restart in the same step."""
        return {
            "final_obs": self._exported(observation),
            "_final_obs": ended.copy(),
            "final_info": dict(infos),
            "_final_info": ended.copy(),
        }

    def _exported(self, array: Any) -> Any:
        """Converts an array to the requested type, as a copy for NumPy."""
        return np.array(array) if self._arrays == "numpy" else jax.numpy.asarray(array)


class GraspEnv(gym.Env[np.ndarray, np.ndarray]):
    """One hand and one object: a vector environment of size one, which waits for `reset` at the
    end. `info["metrics"]` then holds the episode's metrics by name.
    """

    def __init__(self, **settings: Any):
        """Creates the environment; for the arguments see `GraspVectorEnv`."""
        settings = {**settings, "autoreset_mode": AutoresetMode.DISABLED}
        self._vector = GraspVectorEnv(1, **settings)
        self.observation_space = self._vector.single_observation_space
        self.action_space = self._vector.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict]:
        """Starts a new episode; returns its first observation (D,).

        Args:
          seed: seed of all later draws.
          options: none are known.

        Raises:
          CongraspError: the seed is negative or not an integer.
        """
        observation, infos = self._vector.reset(seed=seed, options=options)
        super().reset(seed=seed)
        return observation[0], infos

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Simulates one control step under an action (A,).

        Raises:
          CongraspError: the action is of another shape or not finite, or no episode has begun.
        """
        shape = self.action_space.shape
        if np.shape(action) != shape:
            raise CongraspError(f"The action has shape {np.shape(action)}.", f"Pass {shape}.")
        observation, reward, terminated, truncated, infos = self._vector.step([action])
        metrics = infos.get(METRICS, {})
        info = {METRICS: {name: float(column[0]) for name, column in metrics.items()}}
        return (
            observation[0],
            float(reward[0]),
            bool(terminated[0]),
            bool(truncated[0]),
            info if metrics else {},
        )

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


def _commanded(action: Any, observation: Any, key: Any) -> tuple[Any, Any]:
    """Policy of an external learner: its parameters are the actions."""
    return action, jax.numpy.zeros(action.shape[0])


def _mode_of(mode: AutoresetMode | str) -> AutoresetMode:
    """Returns an autoreset mode by itself, its name or its value, such as `next_step`."""
    for one in AutoresetMode:
        if mode is one or str(mode).upper() in (one.name, one.value.upper()):
            return one
    names = ", ".join(one.name for one in AutoresetMode)
    raise CongraspError(f"There is no autoreset mode '{mode}'.", f"Known: {names}.")


def _task_fields(task: dict[str, Any]) -> dict[str, Any]:
    """Returns the given fields of the task; raises a CongraspError for an unknown one."""
    names = [field.name for field in dataclasses.fields(TaskConfig)]
    for name in task:
        if name not in names:
            raise CongraspError(f"The task has no field '{name}'.", f"Known: {', '.join(names)}.")
    return task
