"""Evaluation by the paper's protocol: the deterministic policy under chosen constraints on a pool of objects."""

import contextlib
import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from actors.environment import METRICS, EnvironmentState
from actors.episode import episode_message
from actors.physics import make_physics
from actors.rollout import Rollout, RolloutWorker, finished_episodes, goal_of_world
from actors.taskset import TaskSet, build_taskset
from common.config import PhysicsName, TaskConfig
from common.errors import CongraspError
from common.hands import get_hand
from common.hands.spec import Hand
from common.objects.pool import sized
from common.objects.spec import GraspObject
from common.policy.bundle import PolicyBundle, mean_action
from common.task.features import Features
from common.task.types import Array, SceneState, Surface
from common.wire.codec import Message
from services.evaluation.noise import LEVELS, Noise, disturbed
from services.evaluation.scores import Row, Sample, active_mask, joined, matching, summarise

HOLD_SECONDS = 2.0
"""How long a grasp should last without the table, beyond the paper's quarter of a second."""
_BATCH = {"native": 64, "warp": 4096, "jax": 256}
_PATIENCE = 100
_REFERENCES = 4
"""References that an object needs, on average."""


def mixture(task: TaskConfig, constraints: Sequence[str]) -> TaskConfig:
    """The task whose episodes belong to these rows, each row with the same probability or more than others."""
    asked = [constraint.split("+") for constraint in constraints]

    def probability(part: str) -> float:
        share = sum(part in parts for parts in asked) / len(asked)
        return share if share in (0.0, 1.0) else 0.5

    return dataclasses.replace(
        task,
        p_affordance=probability("affordance"),
        p_pose=probability("pose"),
        p_trajectory=probability("trajectory"),
    )


def two_seconds(task: TaskConfig) -> int:
    """Control steps in `HOLD_SECONDS`."""
    return round(HOLD_SECONDS / task.control_dt)


class Evaluator:
    """A policy on a pool of objects."""

    def __init__(
        self,
        bundle: PolicyBundle,
        objects: Sequence[GraspObject],
        *,
        physics: PhysicsName = "native",
        batch: int = 0,
        threads: int = 2,
        seed: int = 0,
        task: TaskConfig | None = None,
        hold_steps: int | None = None,
        taskset: TaskSet | None = None,
    ):
        """Builds the constraint sets.

        Args:
          bundle: the policy.
          objects: what it grasps; they are brought to the size of its hand (`common.objects.pool.sized`).
          physics: engine; not `auto`.
          batch: worlds that run side by side; 0 chooses by the engine.
          threads: threads of the `native` engine.
          seed: seed of constraints and episodes.
          task: where it is not to be the bundle's; mass and friction are in the middle of their ranges.
          hold_steps: control steps without the table; the task's, which count for success, if not given.
          taskset: constraints to draw from, of these objects in this order
            (`services.grasping.constraint_sets.taskset_of`); made from the seed if not given.
        """
        base = task or bundle.task
        hold = hold_steps or base.hold_steps
        self.bundle = bundle
        self.task = dataclasses.replace(
            base,
            hold_steps=min(base.hold_steps, hold),
            hold_steps_max=hold,
            end_when_fallen=False,
            mass_range=_nominal(base.mass_range),
            friction_range=_nominal(base.friction_range),
        )
        self._hold = hold
        self._hand = get_hand(bundle.spec.hand)
        self.objects = sized(self._hand, self.task, objects)
        self._physics, self._threads, self._seed = physics, threads, seed
        self._batch = batch or _BATCH[physics]
        self._taskset = taskset or build_taskset(self._hand, self.task, self.objects, seed)
        self._referred = taskset is not None

    def samples(
        self, constraints: Sequence[str], episodes: int, progress: Callable[[int], None] = lambda done: None
    ) -> dict[str, Sample]:
        """Episodes for every row, in one run: an episode counts for the row whose constraints were all it had.

        Args:
          constraints: names of rows.
          episodes: for each row.
          progress: is told how many episodes of all rows there are.

        Raises:
          CongraspError: no object of the pool allows a row's constraints, or too few resting poses do.
        """
        with self._worker(mixture(self.task, constraints), episodes) as worker:
            self._refer(worker, constraints)
            return self._gather(worker, constraints, episodes, progress)

    def samples_of_pools(
        self,
        constraint: str,
        pools: Iterable[Sequence[GraspObject]],
        episodes: int,
        progress: Callable[[int], None] = lambda done: None,
    ) -> Iterator[Sample]:
        """`episodes` on this evaluator's objects, then on each of further pools, with nothing compiled anew.

        Args:
          constraint: name of a row.
          pools: as many objects each as this evaluator has; primitive ones where the engine is compiled.
          episodes: on each pool.
          progress: is told how many episodes of the present pool there are.
        """
        with self._worker(mixture(self.task, [constraint]), episodes) as worker:
            yield self._gather(worker, [constraint], episodes, progress)[constraint]
            for number, objects in enumerate(pools, 1):
                self.objects = sized(self._hand, self.task, objects)
                self._taskset = build_taskset(self._hand, self.task, self.objects, self._seed + number)
                self._referred = False
                worker.replace_objects(self.objects, self._taskset)
                worker.restart()
                yield self._gather(worker, [constraint], episodes, progress)[constraint]

    def references(self, share: float, progress: Callable[[int], None] = lambda done: None) -> TaskSet:
        """The task set with reference poses and trajectories from the policy's own grasps under headings.

        Args:
          share: of the places for references on the whole surface that should be filled.
          progress: is told how many batches of episodes there are.
        """
        with self._worker(mixture(self.task, ["heading", "affordance"]), self._batch) as worker:
            worker.forget_references()
            for batch in range(_PATIENCE):
                worker.restart()
                worker.collect(self.bundle.acting, self.task.approach_steps + self.task.hold_steps)
                worker.renew_references()
                progress(batch + 1)
                if np.asarray(worker.taskset.pose_valid)[:, 0].any(1).mean() >= share:
                    break
            return TaskSet(*(np.asarray(field) for field in worker.taskset))

    def rows_under_noise(self, progress: Callable[[int], None], episodes: int) -> list[Row]:
        """A row for each of `services.evaluation.noise.LEVELS`; see there. The same references are disturbed in all.

        Args:
          progress: is told how many episodes of all rows there are.
          episodes: for each row.
        """
        rows: list[Row] = []
        for constraint, group in itertools.groupby(LEVELS, lambda noise: noise.constraint):
            with self._worker(mixture(self.task, [constraint]), episodes) as worker:
                self._refer(worker, [constraint])
                for noise in group:
                    worker.replace_objects(self.objects, disturbed(self._hand, self._taskset, noise, self._seed))
                    worker.restart()
                    advance = functools.partial(lambda done, n: progress(done + n), len(rows) * episodes)
                    sample = self._gather(worker, [constraint], episodes, advance)
                    rows.append(self.row(constraint, sample[constraint], noise.label))
        return rows

    def noisy_example(self, noise: Noise) -> Message | None:
        """An episode under a noisy reference in which the object is held to the end, if there is one."""
        taskset = self._taskset
        try:
            self._taskset = disturbed(self._hand, taskset, noise, self._seed)
            return next(iter(self.examples(noise.constraint, 1, 0)), None)
        finally:
            self._taskset = taskset

    def _refer(self, worker: RolloutWorker, constraints: Sequence[str]) -> None:
        """References from the policy's own grasps under headings, as the paper makes them for its hands; once."""
        asked = any(any(active_mask(name)[1:]) for name in constraints)
        if not self.task.own_references or self._referred or not asked:
            return
        self._referred = True
        worker.forget_references()
        wanted = _REFERENCES * len(self.objects)
        for _ in range(0, 2 * wanted, self._batch):
            worker.restart()
            worker.collect(self.bundle.acting, self.task.approach_steps + self.task.hold_steps)
            worker.renew_references()
        made = int(np.asarray(worker.taskset.pose_valid).any(2).sum())
        if made < wanted // 4:  # a policy that hardly grasps: those that closing the hand gave are all there is
            worker.replace_objects(self.objects, self._taskset)
        else:
            self._taskset = worker.taskset
        worker.restart()

    def _gather(
        self, worker: RolloutWorker, constraints: Sequence[str], episodes: int, progress: Callable[[int], None]
    ) -> dict[str, Sample]:
        for constraint in constraints:
            self._check_available(constraint)
        found: dict[str, list[Sample]] = {constraint: [] for constraint in constraints}
        counts = dict.fromkeys(constraints, 0)
        seen, limit = 0, _PATIENCE * (episodes + self._batch)
        while min(counts.values()) < episodes:
            if seen > limit:
                scarce = min(counts, key=lambda name: counts[name])
                raise CongraspError(
                    f"Of {seen} episodes only {counts[scarce]} had the constraints '{scarce}'.",
                    "Ask for fewer --episodes, or add objects that allow these constraints.",
                )
            batch = self._batch_of_episodes(worker)
            seen += len(batch.values["success"])
            for name in constraints:
                sample = batch.where(matching(batch.values, name)).first(episodes - counts[name])
                found[name].append(sample)
                counts[name] += len(sample.values["success"])
            progress(sum(counts.values()))
        return {name: joined(parts) for name, parts in found.items()}

    def rows(
        self, constraints: Sequence[str], episodes: int, progress: Callable[[int], None] = lambda done: None
    ) -> list[Row]:
        """One row for each set of constraints; see `samples`."""
        samples = self.samples(constraints, episodes, progress)
        return [self.row(name, sample) for name, sample in samples.items()]

    def row(self, constraint: str, sample: Sample, group: str = "") -> Row:
        """A row of episodes of this evaluator's protocol."""
        held = self._hold == two_seconds(self.task)
        return summarise(constraint, self._hand.name, sample, held_2s=held, group=group)

    def draws(self, constraint: str, episodes: int, count: int) -> list[Row]:
        """`count` rows of `episodes` each from independent draws, to see how much chance there is in one."""
        sample = self.samples([constraint], episodes * count)[constraint]
        order = np.arange(episodes * count) // episodes
        return [self.row(constraint, sample.where(order == i)) for i in range(count)]

    def examples(self, constraint: str, successes: int, failures: int, most: int = 300) -> list[Message]:
        """Episodes of a row to look at, failures first; the object must be held to the end of the hold to succeed.

        They are picked from up to `most` episodes of many worlds, and each is simulated once more alone, to be
        recorded; the few that then end otherwise are left out.

        Raises:
          CongraspError: the pool does not allow these constraints.
        """
        self._check_available(constraint)
        task = mixture(self.task, [constraint])
        wanted = {False: failures, True: successes}
        chosen: dict[bool, list[EnvironmentState]] = {False: [], True: []}
        with self._worker(task, most) as worker:
            self._refer(worker, [constraint])
            for _ in range(0, most, self._batch):
                env = self._begin(worker)
                values = self._batch_of_episodes(worker).values
                for row in np.flatnonzero(matching(values, constraint)):
                    held = bool(values["held"][row] > 0)
                    if len(chosen[held]) < wanted[held]:
                        chosen[held].append(_world(env, int(row)))
                if all(len(chosen[held]) == count for held, count in wanted.items()):
                    break
        messages = []
        with self._worker(task, 1) as alone:
            for held, envs in chosen.items():
                for env in envs:
                    alone.begin(env._replace(key=alone.env.key))
                    rollout = alone.collect(self.bundle.acting, self.task.approach_steps + self._hold)
                    message = self._message(env, rollout)
                    if (message.meta["metrics"]["held"] > 0) is held:
                        messages.append(message)
        return messages

    def episode(self, constraint: str, tries: int = 1) -> Message:
        """An episode of one world under a set of constraints: the first that succeeds, or the last of `tries`.

        Raises:
          CongraspError: the pool does not allow these constraints.
        """
        self._check_available(constraint)
        message: Message | None = None
        with self._worker(mixture(self.task, [constraint]), 1) as worker:
            for _ in range(_PATIENCE * tries):
                env = self._begin(worker)
                rollout = worker.collect(self.bundle.acting, self.task.approach_steps + self._hold)
                if not matching(_metrics(rollout), constraint)[0]:
                    continue
                message, tries = self._message(env, rollout), tries - 1
                if message.meta["success"] or not tries:
                    return message
        raise CongraspError(f"No episode had the constraints '{constraint}'.", "Choose other objects.")

    def _message(self, env: EnvironmentState, rollout: Rollout) -> Message:
        metrics = {name: float(column[0]) for name, column in _metrics(rollout).items()}
        return episode_message(
            self._hand,
            self.task,
            rollout.trace,
            goal_of_world(env.goal),
            Surface(*(np.asarray(field)[0] for field in env.surface)),
            self.objects[int(np.asarray(env.world.object_index)[0])],
            {
                "version": self.bundle.version,
                "actor": "evaluation",
                "success": metrics["success"] > 0,
                "metrics": metrics,
            },
        )

    def _check_available(self, constraint: str) -> None:
        affordance, *pose, trajectory = active_mask(constraint)
        allowed = np.ones(self._taskset.has_affordance.shape, bool)
        if affordance:
            allowed &= np.asarray(self._taskset.has_affordance)
        if trajectory or any(pose):
            allowed &= np.asarray(self._taskset.pose_valid)[:, int(affordance)].any(-1)
        if not allowed.any():
            raise CongraspError(
                f"None of the {len(self.objects)} objects allows the constraint '{constraint}'.",
                "An affordance needs labelled parts, poses and trajectories need room above the table.",
            )

    @contextlib.contextmanager
    def _worker(self, task: TaskConfig, episodes: int) -> Iterator[RolloutWorker]:
        """Worlds that act by the policy's mean, not many more than `episodes` of each row need."""
        rows = 2 ** sum(p not in (0.0, 1.0) for p in (task.p_affordance, task.p_pose, task.p_trajectory))
        batch = min(self._batch, 1 << (episodes * rows - 1).bit_length())
        physics = make_physics(self._physics, self._hand, task, self.objects, threads=self._threads)
        layout, hand = self.bundle.spec.layout, self._hand

        def policy(acting: Any, observation: Array, key: Array) -> tuple[Array, Array]:
            return mean_action(layout, acting, observation), observation[..., 0] * 0.0

        def probe(scene: SceneState, seen: Features) -> tuple[Array, Array]:
            force = jnp.linalg.norm(seen.force, axis=-1)
            return force.astype(jnp.float16), torque_share(hand, scene).astype(jnp.float16)

        try:
            worker = RolloutWorker(
                hand, task, physics, self._taskset, policy, batch=batch, seed=self._seed, half=False, probe=probe
            )
            yield worker
        finally:
            physics.close()

    def _begin(self, worker: RolloutWorker) -> EnvironmentState:
        """Gives the episodes that begin now the full hold, whatever was drawn for them."""
        worker.env = worker.env._replace(hold=jnp.full_like(worker.env.hold, self._hold))
        return worker.env

    def _batch_of_episodes(self, worker: RolloutWorker) -> Sample:
        """One episode of every world; all of them begin and end together.

        It is collected in pieces, so that a large batch's observations need not be in memory for all steps.
        """
        start, window = self.task.approach_steps, self.task.hold_steps
        length = start + self._hold
        piece = math.gcd(start, self._hold)
        piece = piece if piece >= 10 else length
        kept: list[Any] = []
        self._begin(worker)
        for step in range(0, length, piece):
            rollout = worker.collect(self.bundle.acting, piece)
            if step + piece > start and step < start + window:
                rows = slice(max(0, start - step), start + window - step)
                kept.append([np.asarray(values)[rows].swapaxes(0, 1) for values in rollout.probed])
        force, torque = (np.concatenate(parts, 1) for parts in zip(*kept, strict=True))
        return Sample(_metrics(rollout), force, torque)


def _world(env: EnvironmentState, index: int) -> EnvironmentState:
    """One of the worlds."""
    return jax.tree.map(lambda x: x[index : index + 1], env._replace(key=env.bad))


def _nominal(bounds: tuple[float, float]) -> tuple[float, float]:
    middle = (bounds[0] + bounds[1]) / 2
    return middle, middle


def torque_share(hand: Hand, scene: SceneState) -> Array:
    """(B, F) |clip(kp (q_target - q) - kv q_velocity, limit)| / limit: finger torques by the hand's position servos."""
    gains = np.array([(joint.kp, joint.kv, joint.torque_limit) for joint in hand.joints], np.float32)
    torque = gains[:, 0] * (scene.q_target - scene.q) - gains[:, 1] * scene.q_velocity
    return jnp.minimum(jnp.abs(torque) / gains[:, 2], 1.0)


def _metrics(rollout: Rollout) -> dict[str, np.ndarray]:
    """Metrics (E,) of the episodes that ended, by the names in `METRICS`."""
    episodes = finished_episodes(rollout)
    return {name: episodes[f"episode/{name}"] for name in METRICS}
