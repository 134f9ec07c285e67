"""The single driver of control steps, for training, evaluation, attempts and benchmarks."""

import concurrent.futures
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from congrasp.actors import harvest
from congrasp.actors.env_state import EnvState
from congrasp.actors.harvest import Grasps
from congrasp.actors.initial import InitialConditions
from congrasp.actors.physics.engine import Physics, PhysicsState
from congrasp.actors.rollout import (
    ActFunction,
    Probe,
    Rollout,
    Traced,
    no_probe,
    programs_of,
    rollout_of,
    row_of,
)
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.config import RewardWeights, TaskConfig
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.types import Array


class RolloutWorker:
    """Environments that continue from one rollout to the next."""

    def __init__(  # noqa: PLR0913
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
        probe: Probe = no_probe,
        traced: Traced = "first",
        staggered: bool = False,
        taught: bool = False,
        privileged: Sequence[GraspObject] = (),
    ):
        """Creates the worker, and starts episodes if there is a bank.

        Args:
          hand: the hand.
          task: the task.
          physics: the engine, with the objects of the bank.
          bank: constraint bank of the episodes; without one, `begin` sets the episodes, which do
            not restart at their end.
          policy: a pure function; `collect` passes its parameters.
          batch: number B of environments.
          seed: seed of episodes and actions.
          half_precision: rounds observations to half precision, for the policy and for the learner.
          probe: computes additional values to record at every step.
          traced: environments whose trace is recorded.
          staggered: ends the first episodes early at different times, so that short rollouts then
            contain all phases of the task.
          taught: records `Rollout.teacher_observation`.
          privileged: the engine's objects, if `Rollout.privileged` is recorded.
        """
        self.programs = programs_of(
            hand,
            task,
            physics,
            policy,
            batch=batch,
            half_precision=half_precision,
            probe=probe,
            traced=traced,
            taught=taught,
        )
        self.physics = physics
        self.env = self.programs.env
        self.batch = batch
        self._hand = hand
        self._task = task
        self._staggered = staggered
        self._bank: ConstraintBank | None = None
        self._settings = self.env.settings
        self._stationary = np.array(False)
        if privileged:
            self.adjust(masses=_masses(privileged))
        self._episode_key, self._key = _split(_on_device(jax.random.key(seed)))
        self.state: EnvState | None = None
        if bank is not None:
            self.start(bank)

    def start(self, bank: ConstraintBank) -> None:
        """Starts episodes of this bank in every environment."""
        self._bank = _on_device(bank)
        self.restart()

    def adjust(self, **settings: Any) -> None:
        """Changes `Settings` by name from the next control step on; new types or shapes are
        recompiled.
        """
        self._settings = self._settings._replace(**settings)

    def configure(self, weights: RewardWeights, *, stationary: bool) -> None:
        """Sets the reward weights, and whether the objects of episodes that start from now on are
        fixed.
        """
        self._settings = self._settings._replace(weights=weights)
        self._stationary = np.array(stationary)

    def replace_objects(self, objects: Sequence[GraspObject], bank: ConstraintBank | None) -> None:
        """Replaces the objects by as many others, with their bank, for episodes that start from now
        on.
        """
        running = self.state.physics if self.state else None
        physics = self.physics.replace_objects(running, objects)
        self._bank = _on_device(bank)
        if self._settings.masses is not None:
            self.adjust(masses=_masses(objects))
        if self.state is not None:
            self.state = self.state._replace(physics=physics if self.physics.compiled else None)
            self.take_grasps()

    def restart(self) -> None:
        """Starts new episodes in every environment."""
        self._episode_key, key = _split(self._episode_key)
        if self.physics.compiled:
            conditions = self.programs.sample(self._bank, key, self._stationary)
            self.begin(conditions._replace(hold=self._staggered_hold(conditions.hold, key)))
            return
        # By the program that replaces finished episodes: another one would take as long to compile.
        state = (self.state or self._blank(key))._replace(views=None)
        every = _on_device(np.ones(self.batch, bool))
        state = self.programs.renew(self._bank, state, key, self._stationary, every)
        self._place(state._replace(hold=self._staggered_hold(state.hold, key)))

    def _blank(self, key: Array) -> EnvState:
        """An engine's environments before their first episodes."""
        conditions = jax.eval_shape(self.programs.sample, self._bank, key, self._stationary)
        form = jax.eval_shape(self.programs.begin, conditions, None)
        return jax.tree.map(lambda array: _on_device(np.zeros(array.shape, array.dtype)), form)

    def _staggered_hold(self, hold: Array, key: Array) -> Array:
        """Hold lengths (B,) of the first episodes, in control steps without the table.

        A staggered worker shortens them at random, so that not all episodes end at the same time.
        """
        if not self._staggered:
            return hold
        steps = self._task.approach_steps + np.asarray(hold)
        rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        missing = np.floor(rng.uniform(size=steps.shape) * steps)
        return _on_device(np.int32(hold - missing))

    def begin(self, conditions: InitialConditions) -> None:
        """Starts these episodes, one in each environment."""
        conditions = _on_device(conditions)
        if self.physics.compiled:
            self.state = self.programs.begin(conditions, _on_device(self.state))
        else:
            self._place(self.programs.begin(conditions, None))

    def _place(self, state: EnvState) -> None:
        """Resets an engine outside of JAX programs to the start of these episodes."""
        earlier = self.state
        if earlier is None:
            self.physics.start(state.reset_state)
        else:
            self.physics.reset(None, np.ones(self.batch, bool), state.reset_state)
        self.state = self.programs.with_scene(state._replace(views=None), self.physics.read(None))
        if earlier is not None:
            self.state = self.state._replace(grasps=earlier.grasps)

    def renew(self, mask: np.ndarray, conditions: InitialConditions) -> None:
        """Starts these episodes in the masked environments (B,)."""
        assert self.state is not None, "call `begin` first"
        conditions = _on_device(conditions)
        if self.physics.compiled:
            self.state = self.programs.restart(self.state, mask, conditions)
            return
        self.physics.reset(None, mask, conditions.reset_state)
        state = self.programs.restart(self.state._replace(views=None), mask, conditions)
        self.state = self.programs.with_scene(state, self.physics.read(None))

    def observe(self) -> Array:
        """Observation (B, D) of the current control step by the policy."""
        return self.programs.look(self.state, self._settings).observation

    def compile(self, form: ConstraintBank, parameters: Any, steps: int) -> None:
        """Compiles the programs of `start`, `collect` and `renew_references`, for compiled engines.

        Args:
          form: shapes of the bank (`common.task.sampling.build.bank_form`); no bank is needed yet.
          parameters: parameters of the policy, or their shapes.
          steps: number T of steps.
        """
        key = self._key
        programs = self.programs
        stationary = self._stationary
        form, parameters = _shapes((form, parameters))
        conditions = _shapes(jax.eval_shape(programs.sample, form, key, stationary))
        state = _shapes(jax.eval_shape(programs.begin, conditions, None))
        scanned = (parameters, self._settings, stationary, form, (state, key), key)
        lowerings: list[Callable[[], jax.stages.Lowered]] = [
            lambda: programs.scan.lower(*scanned, steps=steps),
            lambda: programs.sample.lower(form, key, stationary),
            lambda: programs.begin.lower(conditions, None),
            lambda: harvest.renew.lower(self._hand, self._task, form, state.grasps, key),
        ]
        with concurrent.futures.ThreadPoolExecutor(len(lowerings)) as threads:
            # Each is compiled while the next one is lowered, which takes Python's lock.
            compilations = [threads.submit(lower().compile) for lower in lowerings]
            for compilation in compilations:
                compilation.result()

    @property
    def bank(self) -> ConstraintBank:
        """Current constraint bank of the episodes."""
        assert self._bank is not None, "these episodes are given"
        return self._bank

    def weigh_objects(self, weight: np.ndarray) -> None:
        """Sets the weights (N,) with which episodes that start from now on draw objects."""
        self._bank = self.bank._replace(weight=_on_device(np.asarray(weight, np.float32)))

    def renew_references(self) -> None:
        """Stores the grasps that succeeded since the last call as reference poses in the bank."""
        self._key, key = _split(self._key)
        self._bank = harvest.renew(self._hand, self._task, self.bank, self.take_grasps(), key)

    def take_grasps(self) -> Grasps:
        """Returns the grasps that succeeded since the last call."""
        assert self.state is not None, "call `begin` first"
        grasps = self.state.grasps
        self.state = self.state._replace(
            grasps=grasps._replace(found=_on_device(np.zeros(self.batch, bool)))
        )
        return grasps

    def collect(
        self, parameters: Any, steps: int, progress: Callable[[int], None] = lambda step: None
    ) -> Rollout:
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

    def _collect_stepwise(
        self, parameters: Any, key: Array, steps: int, progress: Callable[[int], None]
    ) -> Rollout:
        """Collects a rollout with an engine that JAX cannot trace; see `collect`."""
        # One more key than steps: the decision after the last step only yields `last_observation`.
        # A split does not depend on how many follow it, so that one program serves many lengths.
        count = 1 << steps.bit_length()
        key_data = np.asarray(jax.random.key_data(jax.random.split(key, count)))
        parameters, settings = _on_device((parameters, self._settings))
        assert self.state is not None
        decision = self.programs.decide(
            parameters, settings, self.state, jax.random.wrap_key_data(key_data[0])
        )
        state = self.state._replace(views=None)
        rows: list[dict[str, Any]] = []
        extras = []
        for step in range(1, steps + 1):
            _, physics_state = self.physics.step(None, *map(np.asarray, decision.command))
            changed, transition, recorded, following = self.programs.advance(
                parameters, settings, state, physics_state, decision, key_data[step]
            )
            state = state._replace(**changed)
            rows.append(
                row_of(decision.seen, decision.action, decision.log_probability, transition)
            )
            extras.append(recorded)
            decision = following
            if self._bank is not None and np.asarray(transition.terminal).any():
                state, physics_state = self._renew(state, transition.terminal)
                state_key = jax.random.wrap_key_data(key_data[step])
                scene = self.programs.with_scene(state, physics_state)
                decision = self.programs.decide(parameters, settings, scene, state_key)
            progress(step)
        self.state = self.programs.with_scene(state, physics_state)
        columns, (trace, probed) = jax.tree.map(
            lambda *x: np.stack(x), *zip(rows, extras, strict=True)
        )
        return rollout_of(self.state, columns, decision.seen, trace, probed)

    def _renew(self, state: EnvState, terminal: Array) -> tuple[EnvState, PhysicsState]:
        """Starts another episode in the environments (B,) whose episode has ended."""
        self._episode_key, key = _split(self._episode_key)
        state = self.programs.renew(self._bank, state, key, self._stationary, terminal)
        self.physics.reset(None, terminal, state.reset_state)
        return state, self.physics.read(None)

    def _collect_compiled(self, parameters: Any, key: Array, steps: int) -> Rollout:
        """Collects a rollout as one program; see `collect`."""
        parameters, bank, carry = _on_device(
            (parameters, self._bank, (self.state, self._episode_key))
        )
        (self.state, self._episode_key), rollout = self.programs.scan(
            parameters, self._settings, self._stationary, bank, carry, key, steps=steps
        )
        return rollout


def _on_device(tree: Any) -> Any:
    """Commits the arrays to this process's device: uncommitted ones would cause another
    compilation.
    """
    return jax.device_put(tree, jax.local_devices()[0])


def _shapes(tree: Any) -> Any:
    """Shapes and types of the arrays of a tree, on this process's device."""
    device = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    return jax.tree.map(
        lambda array: jax.ShapeDtypeStruct(array.shape, array.dtype, sharding=device), tree
    )


def _masses(objects: Sequence[GraspObject]) -> Array:
    """Masses (N,) in kg."""
    return _on_device(np.array([obj.mass for obj in objects], np.float32))


_split = jax.jit(lambda key: tuple(jax.random.split(key)))
"""Two random keys, in one call."""
