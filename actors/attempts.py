"""Attempts: parallel grasps with requested initial conditions and constraints, all recorded.

Training and evaluation draw their episodes at random; attempts follow a request.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from congrasp.actors import initial
from congrasp.actors import stress as protocols
from congrasp.actors.episode import EpisodeFacts, traced_episode
from congrasp.actors.initial import RequestedEpisodes
from congrasp.actors.initial_hand import handover_speed
from congrasp.actors.physics import make_physics
from congrasp.actors.rollout import Trace
from congrasp.actors.worker import RolloutWorker
from congrasp.common.episode.episode import Episode
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.distance import distance_field
from congrasp.common.objects.spec import GraspObject
from congrasp.common.policy.bundle import PolicyBundle, acting
from congrasp.common.runtime.engines import PhysicsName
from congrasp.common.task import plausibility
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints.priority import Resolution
from congrasp.common.task.metrics import metric_names
from congrasp.common.task.types import Goal, Surface


class Phases(NamedTuple):
    """Requested durations and heights around a grasp."""

    approach: float = 0.0
    """Seconds in which the hand first comes from next to the table; 0 begins near the object."""
    lift: float = 0.0
    """Metres by which the hand lifts the object off the table, which then stays; 0 removes the
    table.
    """
    hold: float = 2.0
    """Seconds of the hold, at least those that count for success."""


PLAIN = Phases()
"""The hand begins near the object, and the table is removed."""


class Outcome(NamedTuple):
    """Outcome of a batch of attempts."""

    goal: Goal
    """Active constraints after the priority rules."""
    redirected: np.ndarray
    """(B,) bool, see `common.task.constraints.priority.Resolution`."""
    aligned: np.ndarray
    """(B,) bool."""
    metrics: dict[str, np.ndarray]
    """(B,) each, by the names in `common.task.metrics.metric_names` and `actors.stress.assess`."""
    trace: Trace
    """(T, B, ...)."""


class Attempts:
    """Grasps objects one after another with a policy's mean action, each in several ways in
    parallel.

    Attributes:
      phases: durations and heights of the next run.
    """

    def __init__(
        self,
        hand: Hand,
        task: TaskConfig,
        bundle: PolicyBundle,
        *,
        threads: int,
        phases: Phases = PLAIN,
        physics: PhysicsName = "native",
    ):
        """Sets up the attempts; nothing is compiled yet.

        Args:
          hand: the hand.
          task: the task; only the part of its hold that counts for success is used.
          bundle: the policy.
          threads: threads of the physics.
          phases: durations and heights.
          physics: engine, one that takes any object after another: not one that is compiled.
        """
        self.phases = phases
        self._hand = hand
        self._task = task
        self._bundle = bundle
        self._threads = threads
        self._physics = physics
        self._worker: RolloutWorker | None = None

    @property
    def steps(self) -> int:
        """T, control steps of an episode."""
        return self._task.approach_steps + self._after

    @property
    def simulated_steps(self) -> int:
        """Control steps of a run: those of the episode, and of the tests of the hold after it."""
        height = 0.0 if self.phases.lift else protocols.LIFT_HEIGHT_M
        return self.steps + protocols.stress_steps(self._task, height)

    @property
    def speed(self) -> float:
        """Initial speed of the wrist along the heading, m/s."""
        if not self.phases.approach:
            return 0.0
        return handover_speed(self._hand, self._task)

    @property
    def _after(self) -> int:
        """Control steps of lift and hold."""
        hold = max(self._task.hold_steps, round(self.phases.hold / self._task.control_dt))
        return protocols.lift_steps(self._task, self.phases.lift) + hold

    @property
    def begins(self) -> dict[str, float]:
        """Start times of the grasp, a lift and the hold, in seconds from the first step."""
        removal = self._task.approach_steps
        begins = {"grasp": 0}
        if self.phases.lift:
            begins["lift"] = removal
        begins["hold"] = removal + protocols.lift_steps(self._task, self.phases.lift)
        return {name: step * self._task.control_dt for name, step in begins.items()}

    def run(
        self,
        obj: GraspObject,
        request: RequestedEpisodes,
        progress: Callable[[int], None] = lambda step: None,
    ) -> Outcome:
        """Grasps an object in B ways; a different B than before causes a recompilation.

        Args:
          obj: the object.
          request: the episodes.
          progress: called with the number of completed control steps, of `simulated_steps`.
        """
        task = self._task
        hold = self._after
        conditions, resolution = conditions_of(self._hand, task, request, hold, self.speed)
        worker = self._worker_of(obj, len(request.rest))
        worker.replace_objects([obj], None)
        worker.adjust(protocol=self._protocol(obj), probe_data=distance_field([obj]))
        worker.begin(conditions)
        parameters = self._bundle.inference_parameters
        rollout = worker.collect(parameters, task.approach_steps + hold, progress)
        stressed = worker.collect(
            parameters,
            protocols.stress_steps(task, self._stress_height),
            lambda step: progress(self.steps + step),
        )
        trace, samples = jax.tree.map(
            lambda *parts: np.concatenate(parts),
            (rollout.trace, rollout.probed),
            (stressed.trace, stressed.probed),
        )
        names = metric_names(task)
        columns = np.asarray(rollout.episodes)[:, : len(names)].T
        metrics = dict(zip(names, columns, strict=True))
        is_held = metrics["held"] > 0
        metrics |= protocols.assess(samples, is_held, task, hold, self._stress_height)
        trace = Trace(*(field[: self.steps] for field in trace))
        if self.phases.lift:
            trace = trace._replace(table=np.ones_like(trace.table))
        return Outcome(
            goal=resolution.goal,
            redirected=np.asarray(resolution.redirected),
            aligned=np.asarray(resolution.aligned),
            metrics=metrics,
            trace=trace,
        )

    @property
    def _stress_height(self) -> float:
        """Height of the lift after the hold, m: none if the hand has already lifted the object."""
        return 0.0 if self.phases.lift else protocols.LIFT_HEIGHT_M

    def _protocol(self, obj: GraspObject) -> protocols.Protocol:
        """Returns the lift and the pushes of a run."""
        if self.phases.lift:
            return protocols.lift_first(self._task, [obj], self._after, self.phases.lift)
        return protocols.stress(self._task, [obj], self._after, self._stress_height)

    def _worker_of(self, obj: GraspObject, batch: int) -> RolloutWorker:
        """Returns the worker, a new one if it has another number of environments."""
        if self._worker is None or self._worker.batch != batch:
            self.close()
            self._worker = self._new_worker(obj, batch)
        return self._worker

    def episode(
        self,
        outcome: Outcome,
        index: int,
        surface: Surface,
        obj: GraspObject,
        about: dict[str, Any],
    ) -> Episode:
        """Returns one attempt as an episode for logs and pictures; `about` has its origin."""
        metrics = {name: float(column[index]) for name, column in outcome.metrics.items()}
        trace = Trace(*(field[:, index] for field in outcome.trace))
        origin = {"version": self._bundle.version, "phases": self.begins, **about}
        facts = EpisodeFacts(metrics["success"] > 0, metrics, origin)
        return traced_episode(
            self._hand, self._task, trace, outcome.goal.row(index), surface, obj, facts
        )

    def renew(self, bundle: PolicyBundle) -> None:
        """Replaces the weights of the policy without recompilation."""
        self._bundle.spec.require(bundle.spec, "that should replace the current one")
        self._bundle = bundle

    def close(self) -> None:
        """Stops the threads of the physics."""
        if self._worker is not None:
            self._worker.physics.close()

    def _new_worker(self, obj: GraspObject, batch: int) -> RolloutWorker:
        """Returns a worker of `batch` environments with an object.

        The worker acts with the mean of the policy, and traces all environments.

        Raises:
          CongraspError: the engine is missing here, or cannot simulate the hand or other objects.
        """
        physics = make_physics(self._physics, self._hand, self._task, [obj], threads=self._threads)
        if physics.compiled:
            raise CongraspError(
                f"The engine '{physics.name}' is compiled for fixed objects, and cannot take new "
                "ones.",
                "Pass --physics native.",
            )
        return RolloutWorker(
            self._hand,
            self._task,
            physics,
            None,
            acting(self._bundle.spec.layout, mean=True),
            batch=batch,
            seed=0,
            half_precision=False,
            probe=plausibility.sample,
            traced="all",
        )


def conditions_of(
    hand: Hand, task: TaskConfig, request: RequestedEpisodes, hold: int, speed: float
) -> tuple[initial.InitialConditions, Resolution]:
    """See `initial.requested_conditions`: one program for all attempts at a task."""
    conditions: tuple[initial.InitialConditions, Resolution] = _requested_program()(
        hand, task, request, hold, speed
    )
    return conditions


@functools.cache
def _requested_program() -> Any:
    """Compiles in a quarter of the time on a CPU, where it runs once for thousands of steps."""
    quick = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
    options = quick if jax.default_backend() == "cpu" else None
    return jax.jit(initial.requested_conditions, static_argnums=(0, 1), compiler_options=options)
