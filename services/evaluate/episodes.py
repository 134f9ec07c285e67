"""Parallel episodes under a policy's mean action, for evaluations and reference grasps."""

import dataclasses
import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.actors import stress as protocols
from congrasp.actors.env_state import EnvState, View
from congrasp.actors.episode import EpisodeFacts, traced_episode
from congrasp.actors.harvest import Grasps
from congrasp.actors.initial import InitialConditions
from congrasp.actors.physics import make_physics
from congrasp.actors.rollout import Trace, finished_episodes
from congrasp.actors.worker import RolloutWorker
from congrasp.common.episode.episode import Episode
from congrasp.common.hands import get_hand
from congrasp.common.objects.distance import DistanceField
from congrasp.common.objects.spec import GraspObject
from congrasp.common.policy.bundle import PolicyBundle, acting
from congrasp.common.runtime.engines import PhysicsName
from congrasp.common.runtime.resources import cores
from congrasp.common.task import plausibility
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import get_constraint
from congrasp.common.task.metrics import metric_names
from congrasp.common.task.types import Array, Goal
from congrasp.services.evaluate.plan import required_hold_steps

MAX_PROBED_EPISODES = 2000
"""Most episodes of a row from which forces are read."""
_LINK_FORCE = "sample/link_force"
_TORQUE = "sample/torque"
_MIN_CHUNK_STEPS = 10
"""Control steps below which an episode is collected as a whole."""


@dataclasses.dataclass(frozen=True)
class Sample:
    """Episodes of one row."""

    values: dict[str, np.ndarray]
    """Metrics (E,), by the names in `common.task.metrics.metric_names`; `mass_kg`; `identity`,
    equal for equal episodes; and `reference`, equal for the same object and reference (`identity`,
    `reference`)."""
    link_force: np.ndarray
    """(E', W, L) net contact force of each link in the paper's window, N, for the first E'
    episodes.
    """
    torque: np.ndarray
    """(E', W, F) finger torques in that window, as shares of their limits."""

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> "Sample":
        """Returns the sample of its `arrays`."""
        values = dict(arrays)
        link_force = values.pop(_LINK_FORCE)
        torque = values.pop(_TORQUE)
        return cls(values, link_force, torque)

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns all arrays for a file."""
        return {**self.values, _LINK_FORCE: self.link_force, _TORQUE: self.torque}

    def where(self, chosen: np.ndarray) -> "Sample":
        """Selects episodes by `chosen` (E,)."""
        with_forces = chosen[: len(self.link_force)]
        values = {name: column[chosen] for name, column in self.values.items()}
        return Sample(values, self.link_force[with_forces], self.torque[with_forces])

    def without_forces(self) -> "Sample":
        """Drops the forces of all episodes."""
        return Sample(self.values, self.link_force[:0], self.torque[:0])

    def first(self, count: int) -> "Sample":
        """Returns the first `count` episodes."""
        return self.where(np.arange(len(self.values["success"])) < count)


def join_samples(samples: Sequence[Sample]) -> Sample:
    """Joins the episodes of several samples, with forces of at most the first
    `MAX_PROBED_EPISODES`.
    """
    values = {}
    for name in samples[0].values:
        values[name] = np.concatenate([sample.values[name] for sample in samples])
    probed: list[Sample] = []
    for sample in samples:
        probed.append(sample)
        if len(sample.link_force) < len(sample.values["success"]):
            break
    link_force = np.concatenate([sample.link_force for sample in probed])
    torque = np.concatenate([sample.torque for sample in probed])
    return Sample(values, link_force[:MAX_PROBED_EPISODES], torque[:MAX_PROBED_EPISODES])


class Batch(NamedTuple):
    """B episodes simulated together."""

    conditions: InitialConditions
    sample: Sample
    final: View
    """Hand and object at the end of the hold."""
    episode: Callable[[int], Episode]
    """Recording of an episode, if traces are kept."""


class Episodes:
    """Batches of given episodes of one policy, each from its beginning to the end of the hold or
    beyond.
    """

    def __init__(  # noqa: PLR0913
        self,
        bundle: PolicyBundle,
        task: TaskConfig,
        objects: Sequence[GraspObject],
        *,
        hold: int,
        batch: int,
        physics: PhysicsName,
        field: DistanceField | None = None,
        traced: bool = False,
    ):
        """Creates the engine.

        Args:
          bundle: the policy.
          task: the task, under `services.evaluate.plan.protocol`.
          objects: objects, scaled for the hand.
          hold: control steps without the table.
          batch: number B of episodes.
          physics: engine, except `auto`.
          field: grids of the objects' surfaces, used to measure plausibility at every step
            (`common.task.plausibility`); None skips it.
          traced: records every step of every episode.
        """
        self._bundle = bundle
        self._task = task
        self._hold = hold
        self._measured = field is not None
        self._hand = get_hand(bundle.spec.hand)
        self.batch = batch
        self._worker = RolloutWorker(
            self._hand,
            task,
            make_physics(physics, self._hand, task, objects, threads=cores()),
            None,
            acting(bundle.spec.layout, mean=True),
            batch=batch,
            seed=0,
            half_precision=False,
            probe=plausibility.sample if self._measured else _effort,
            traced="all" if traced else "none",
        )
        self.stressable = self._measured and hold == required_hold_steps(task)
        """True if episodes can continue after the hold: the stress test begins after two
        seconds.
        """
        self._measure(objects, field)

    def __enter__(self) -> "Episodes":
        return self

    def __exit__(self, *error: object) -> None:
        self._worker.physics.close()

    def replace_objects(self, objects: Sequence[GraspObject], field: DistanceField | None) -> None:
        """Replaces the objects by as many others, with grids if the first ones had some; nothing is
        recompiled.
        """
        self._worker.replace_objects(objects, None)
        self._measure(objects, field)

    def run(
        self,
        conditions: InitialConditions,
        *,
        stressed: bool = False,
        progress: Callable[[float], None] = lambda share: None,
    ) -> Batch:
        """Simulates B episodes.

        They are collected in chunks, so that the observations of a large batch are not in memory
        for all steps.

        Args:
          conditions: initial conditions, including the length of the hold.
          stressed: also simulates the stress test after the hold (`actors.stress`).
          progress: called with the share of simulated control steps: after each step, or after each
            chunk of an engine that is compiled.
        """
        length = self._task.approach_steps + self._hold
        chunk = self._chunk_steps()
        after = 0
        if stressed:
            after = chunk * math.ceil(protocols.stress_steps(self._task) / chunk)
        begun = self._begin(conditions, after)
        traces: list[Trace] = []
        probed: list[Any] = []
        for step in range(0, length + after, chunk):

            def report(done: int, first: int = step) -> None:
                """Reports `done` steps of the chunk that begins at step `first`."""
                progress((first + done) / (length + after))

            rollout = self._worker.collect(self._bundle.inference_parameters, chunk, report)
            report(chunk)
            probed.append(jax.tree.map(np.asarray, rollout.probed))
            if step < length:
                traces.append(rollout.trace)
                finished = finished_episodes(rollout, self._task)
                assert self._worker.state is not None and self._worker.state.views is not None
                final = self._worker.state.views.true
        samples = jax.tree.map(lambda *chunks: np.concatenate(chunks), *probed)
        values = {name: finished[f"episode/{name}"] for name in metric_names(self._task)}
        if self._measured:
            values |= protocols.assess(samples, values["held"] > 0, self._task, self._hold)
        sample = Sample(
            {**values, **self._facts(conditions)},
            self._in_window(samples.link_force),
            self._in_window(samples.torque_share),
        )

        def episode(index: int) -> Episode:
            """Returns the recording of one episode."""
            metrics = {name: float(column[index]) for name, column in values.items()}
            return self._episode(begun, _trace_of_episode(traces, index), metrics, index)

        return Batch(conditions, sample, final, episode)

    def _chunk_steps(self) -> int:
        """Control steps of a chunk, a divisor of the steps before and after the removal of the
        table.
        """
        chunk = math.gcd(self._task.approach_steps, self._hold)
        if chunk < _MIN_CHUNK_STEPS:
            return self._task.approach_steps + self._hold
        return chunk

    def _in_window(self, steps: np.ndarray) -> np.ndarray:
        """Returns the steps of the paper's window: (B, W, ...) of (T, B, ...)."""
        start = self._task.approach_steps
        return steps[start : start + self._task.hold_steps].swapaxes(0, 1)

    def take_grasps(self) -> Grasps:
        """Returns the grasps of the last batch that may become references."""
        return self._worker.take_grasps()

    def _facts(self, conditions: InitialConditions) -> dict[str, np.ndarray]:
        """Columns (B,) of the initial conditions of episodes: masses in kg, and their
        identities.
        """
        start = jax.tree.map(np.asarray, conditions.reset_state)
        masses = np.array([obj.mass for obj in self.objects])[start.object_index]
        mass = (masses * start.mass_scale).astype(np.float32)
        return {
            "mass_kg": mass,
            "identity": identity(conditions),
            "reference": reference(conditions),
        }

    def _begin(self, conditions: InitialConditions, after: int) -> EnvState:
        """Starts episodes with the full hold and `after` more steps; returns their initial
        state.
        """
        self._worker.begin(conditions._replace(hold=jnp.full_like(conditions.hold, self._hold)))
        assert self._worker.state is not None
        self._worker.state = self._worker.state._replace(
            after=jnp.full_like(conditions.hold, after)
        )
        return self._worker.state

    def _measure(self, objects: Sequence[GraspObject], field: DistanceField | None) -> None:
        """Prepares measurements for these objects; later phases are under `protocols.stress`."""
        self.objects = objects
        if self._measured:
            stress = protocols.stress(self._task, objects, self._hold) if self.stressable else None
            self._worker.adjust(protocol=stress, probe_data=field)

    def _episode(
        self, begun: EnvState, trace: Trace, metrics: dict[str, float], index: int
    ) -> Episode:
        """Returns one episode, from the initial states of all episodes and its own trace."""
        origin = {"version": self._bundle.version, "actor": "evaluation"}
        return traced_episode(
            self._hand,
            self._task,
            trace,
            begun.goal.row(index),
            jax.tree.map(lambda array: np.asarray(array)[index], begun.surface),
            self.objects[int(np.asarray(begun.reset_state.object_index)[index])],
            EpisodeFacts(metrics["success"] > 0, metrics, origin),
        )


def _trace_of_episode(traces: Sequence[Trace], episode: int) -> Trace:
    """Returns the trace of one episode, joined from chunks of (T, B, ...)."""
    fields = []
    for chunks in zip(*traces, strict=True):
        fields.append(np.concatenate([np.asarray(chunk[:, episode]) for chunk in chunks]))
    return Trace(*fields)


def identity(conditions: InitialConditions) -> np.ndarray:
    """(B,) uint32, equal for episodes with the same initial conditions and active constraints,
    ignoring sensors.

    Numbers are rounded to 1e-4.
    """
    goal = conditions.goal
    arrays = list(conditions.reset_state)
    for name in goal.values:
        arrays += _active(goal, name)
    return _hashes(arrays)


def reference(conditions: InitialConditions) -> np.ndarray:
    """(B,) uint32, equal for episodes with the same object and reference.

    If poses and trajectories are drawn independently, the pose counts.
    """
    goal = conditions.goal
    arrays = [conditions.reset_state.object_index]
    for name in goal.values:
        if get_constraint(name).from_reference:
            arrays += _active(goal, name)
    return _hashes(arrays)


def _active(goal: Goal, name: str) -> list[np.ndarray]:
    """Goal arrays (B, ...) of a constraint, zero where it is inactive."""
    constraint = get_constraint(name)
    arrays = [np.asarray(array) for array in goal[name]]
    if not constraint.blocks:
        return arrays
    active = np.any([goal.active[block] for block in constraint.blocks], 0)
    masked = []
    for array in arrays:
        of_episodes = active.reshape(-1, *[1] * (array.ndim - 1))
        masked.append(np.where(of_episodes, array, 0))
    return masked


def _hashes(arrays: Sequence[Array]) -> np.ndarray:
    """Hashes (B,) uint32 of the rows of arrays (B, ...), rounded to 1e-4."""
    rows = [np.asarray(array, np.float64).reshape(len(arrays[0]), -1) for array in arrays]
    rounded = np.round(np.concatenate(rows, 1) * 1e4).astype(np.int64)
    return np.array([zlib.crc32(row.tobytes()) for row in rounded], np.uint32)


class _Effort(NamedTuple):
    """Values recorded in a control step without plausibility."""

    link_force: Array
    """(B, L) N."""
    torque_share: Array
    """(B, F)."""


def _effort(scene: Any, index: Array, data: Any) -> _Effort:
    """Forces of the links, and finger torques as shares of their limits."""
    force = jnp.linalg.norm(scene.features.force, axis=-1)
    return _Effort(force.astype(jnp.float16), plausibility.torque_share(scene).astype(jnp.float16))
