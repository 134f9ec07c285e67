"""Evaluation by the paper's protocol: the deterministic policy under chosen constraints on a pool of objects."""

import contextlib
import functools
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from actors import protocols
from actors.bank import build_bank
from actors.env import EnvState, metric_names
from actors.episode import episode_message
from actors.rollout import RolloutWorker, Trace, finished_episodes
from common.config import TaskConfig
from common.engines import ENGINES, PhysicsName
from common.errors import CongraspError
from common.hands import get_hand
from common.objects.pool import scale_objects
from common.objects.spec import GraspObject
from common.policy.bundle import PolicyBundle
from common.task.bank import ConstraintBank, Draw
from common.task.constraints import get_constraint, optional, require_known
from common.task.types import Surface
from common.wire.codec import Message
from services.evaluate.noise import LEVELS, Noise, with_noise
from services.evaluate.scores import Row, Sample, active_mask, joined, matching, summarise
from services.evaluate.worlds import (
    NOMINAL_FRICTION,
    evaluation_worker,
    measure,
    protocol,
    sampling_config,
    two_seconds,
)

STRESSED = 200
"""Episodes of a row that go on after the hold, lifted and pushed."""
_PATIENCE = 100
_ATTEMPTS = 40
_REFERENCES = 4
"""References that an object needs, on average."""
_KEPT = 8
"""Episodes of a row that can be looked at afterwards: so many that hold the object to the end, and so many others."""


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
        friction: float = NOMINAL_FRICTION,
        hold_steps: int | None = None,
        bank: ConstraintBank | None = None,
    ):
        """Builds the constraint sets.

        Args:
          bundle: the policy.
          objects: what it grasps; they are brought to the size of its hand (`common.objects.pool.scale_objects`).
          physics: engine; not `auto`.
          batch: worlds that run side by side; 0 chooses by the engine.
          threads: threads of the `native` engine.
          seed: seed of constraints and episodes.
          task: where it is not to be the bundle's; see `protocol` for what stays of it.
          friction: sliding friction between hand and object.
          hold_steps: control steps without the table; the task's, which count for success, if not given.
          bank: constraints to draw from, of these objects in this order
            (`services.grasp.constraint_sets.bank_of`); made from the seed if not given.
        """
        base = task or bundle.task
        hold = hold_steps or base.hold_steps
        self.bundle = bundle
        self.task = protocol(base, hold, friction)
        self._hold = hold
        self._hand = get_hand(bundle.spec.hand)
        self.objects = scale_objects(self._hand, self.task, objects)
        self._physics, self._threads, self._seed = physics, threads, seed
        self._batch = batch or ENGINES[physics].batch
        self._bank = bank or build_bank(self._hand, self.task, self.objects, seed)
        self._harvested = bank is not None
        self._kept: dict[str, dict[bool, list[Message]]] = {}

    def samples(
        self,
        constraints: Sequence[str],
        episodes: int,
        progress: Callable[[int], None] = lambda done: None,
        *,
        keep: bool = False,
    ) -> dict[str, Sample]:
        """Episodes for every row, in one run: an episode counts for the row whose constraints were all it had.

        Args:
          constraints: names of rows.
          episodes: for each row.
          progress: is told how many episodes of all rows there are.
          keep: keep some of them for `examples`, for which every step of all worlds has to be in memory.

        Raises:
          CongraspError: no object of the pool allows a row's constraints, or too few resting poses do.
        """
        with self._worker(sampling_config(self.task, constraints), episodes, traced=keep) as worker:
            self._harvest_references(worker, constraints)
            stressed = min(episodes, STRESSED) if self._hold == two_seconds(self.task) else 0
            if keep:
                self._kept |= {constraint: {False: [], True: []} for constraint in constraints}
            return self._gather(worker, constraints, episodes, progress, keep, stressed)

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
        with self._worker(sampling_config(self.task, [constraint]), episodes) as worker:
            yield self._gather(worker, [constraint], episodes, progress)[constraint]
            for number, objects in enumerate(pools, 1):
                self.objects = scale_objects(self._hand, self.task, objects)
                self._bank = build_bank(self._hand, self.task, self.objects, self._seed + number)
                self._harvested = False
                worker.replace_objects(self.objects, self._bank)
                measure(worker, self.task, self.objects)
                worker.restart()
                yield self._gather(worker, [constraint], episodes, progress)[constraint]

    def _check_available(self, constraint: str) -> None:
        """Passes if some object of the pool allows a row's constraints.

        Raises:
          CongraspError: none does.
        """
        require_known(constraint.split("+"), self.task)
        bank, found = self._bank, active_mask(constraint, self.task)
        objects, rests = (axis.ravel() for axis in np.indices(bank.has_affordance.shape))
        draw = Draw(bank, objects, rests, np.zeros_like(objects), np.zeros_like(objects))
        allowed = np.ones(objects.shape, bool)
        for part in optional(self.task):
            if any(found[block] for block in part.blocks):
                allowed &= np.asarray(part.available(draw))
                draw = draw._replace(region=np.maximum(draw.region, part.region))
        if not allowed.any():
            raise CongraspError(
                f"None of the {len(self.objects)} objects allows the constraint '{constraint}'.",
                "An affordance needs labelled parts, poses and trajectories need room above the table.",
            )

    def allowed(self, constraints: Sequence[str]) -> tuple[list[str], list[CongraspError]]:
        """The rows that some object allows, and why others are left out; captured objects may have no labelled parts.

        Raises:
          CongraspError: no row is left.
        """
        allowed, errors = [], []
        for name in constraints:
            try:
                self._check_available(name)
                allowed.append(name)
            except CongraspError as error:
                errors.append(error)
        if not allowed:
            raise errors[0]
        return allowed, errors

    def references(self, progress: Callable[[int, int], None] = lambda filled, slots: None) -> ConstraintBank:
        """The constraint bank with reference poses and trajectories from the policy's own grasps under headings.

        It grasps until every slot is filled, or until `_ATTEMPTS` episodes a region of an object filled no further one.

        Args:
          progress: is told how many slots are filled, and how many there are: those on the whole surface of every
            object, and on the graspable region where that can be approached.
        """
        with self._worker(sampling_config(self.task, ["heading", "affordance"]), self._batch) as worker:
            regions = np.stack([np.ones(len(self.objects), bool), np.asarray(self._bank.has_affordance).any(-1)], -1)
            slots = int(regions.sum()) * self._bank.pose_q.shape[2]
            worker.forget_references()
            filled = idle = 0
            while filled < slots and idle < _ATTEMPTS * regions.sum():
                worker.restart()
                worker.collect(self.bundle.inference_parameters, self.task.approach_steps + self.task.hold_steps)
                worker.renew_references()
                before, filled = filled, int(np.any(worker.bank.pose_valid, axis=2)[regions].sum())
                idle = 0 if filled > before else idle + self._batch
                progress(filled, slots)
            return ConstraintBank(*(np.asarray(field) for field in worker.bank))

    def rows_under_noise(self, progress: Callable[[int], None], episodes: int) -> list[Row]:
        """A row for each of `services.evaluate.noise.LEVELS`; see there. All of them add noise to the same references.

        Args:
          progress: is told how many episodes of all rows there are.
          episodes: for each row.
        """
        rows: list[Row] = []
        for constraint, group in itertools.groupby(LEVELS, lambda noise: noise.constraint):
            with self._worker(sampling_config(self.task, [constraint]), episodes) as worker:
                self._harvest_references(worker, [constraint])
                for noise in group:
                    worker.replace_objects(self.objects, with_noise(self._hand, self._bank, noise, self._seed))
                    worker.restart()
                    advance = functools.partial(lambda done, n: progress(done + n), len(rows) * episodes)
                    sample = self._gather(worker, [constraint], episodes, advance)
                    rows.append(self.row(constraint, sample[constraint], noise.label))
        return rows

    def noisy_example(self, noise: Noise) -> Message | None:
        """An episode under a noisy reference in which the object is held to the end, if there is one."""
        kept = self._bank, self._kept
        try:
            self._bank, self._kept = with_noise(self._hand, self._bank, noise, self._seed), {}
            return next(iter(self.examples(noise.constraint, 1, 0, self._batch)), None)
        finally:
            self._bank, self._kept = kept

    def _harvest_references(self, worker: RolloutWorker, constraints: Sequence[str]) -> None:
        """Takes references from the policy's own grasps under headings, as the paper makes them for its hands; once."""
        needed = any(get_constraint(part).from_reference for name in constraints for part in name.split("+"))
        if not self.task.own_references or self._harvested or not needed:
            return
        self._harvested = True
        worker.forget_references()
        wanted = _REFERENCES * len(self.objects)
        for _ in range(0, 2 * wanted, self._batch):
            worker.restart()
            worker.collect(self.bundle.inference_parameters, self.task.approach_steps + self.task.hold_steps)
            worker.renew_references()
        made = int(np.asarray(worker.bank.pose_valid).any(2).sum())
        if made < wanted // 4:  # a policy that hardly grasps: those that closing the hand gave are all there is
            worker.replace_objects(self.objects, self._bank)
        else:
            self._bank = worker.bank
        worker.restart()

    def _gather(
        self,
        worker: RolloutWorker,
        constraints: Sequence[str],
        episodes: int,
        progress: Callable[[int], None],
        keep: bool = False,
        stressed: int = 0,
    ) -> dict[str, Sample]:
        """Collects episodes until every row has enough; the first `stressed` go on after the hold. See `samples`.

        Raises:
          CongraspError: a row's constraints are not allowed, or hardly ever drawn.
        """
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
            batch, message = self._batch_of_episodes(worker, min(counts.values()) < stressed)
            seen += len(batch.values["success"])
            for name in constraints:
                fits = matching(batch.values, name, self.task)
                sample = batch.where(fits).first(episodes - counts[name])
                for row in np.flatnonzero(fits)[: episodes - counts[name]] if keep else ():
                    kept = self._kept[name][bool(batch.values["held"][row] > 0)]
                    if len(kept) < _KEPT:
                        kept.append(message(int(row)))
                found[name].append(sample)
                counts[name] += len(sample.values["success"])
            progress(sum(counts.values()))
        return {name: joined(parts) for name, parts in found.items()}

    def rows(
        self,
        constraints: Sequence[str],
        episodes: int,
        progress: Callable[[int], None] = lambda done: None,
        *,
        keep: bool = False,
    ) -> list[Row]:
        """One row for each set of constraints; see `samples`."""
        samples = self.samples(constraints, episodes, progress, keep=keep)
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

        They are some of those that `samples` kept last, or of `most` that are evaluated now.

        Raises:
          CongraspError: the pool does not allow these constraints.
        """
        if constraint not in self._kept:
            self.samples([constraint], most, keep=True)
        kept = self._kept[constraint]
        return [*kept[False][:failures], *kept[True][:successes]]

    def episode(self, constraint: str, attempts: int = 1) -> Message:
        """An episode of one world under a set of constraints: the first that succeeds, or the last of `attempts`.

        Raises:
          CongraspError: the pool does not allow these constraints.
        """
        self._check_available(constraint)
        with self._worker(sampling_config(self.task, [constraint]), 1, traced=True) as worker:
            for _ in range(_PATIENCE * attempts):
                sample, message = self._batch_of_episodes(worker)
                if not matching(sample.values, constraint, self.task)[0]:
                    continue
                attempts -= 1
                if sample.values["success"][0] > 0 or not attempts:
                    return message(0)
        raise CongraspError(f"No episode had the constraints '{constraint}'.", "Choose other objects.")

    def _message(self, begun: EnvState, trace: Trace, metrics: dict[str, float], world: int) -> Message:
        """The episode of one of the worlds, from how all of them began and what was recorded of it."""
        return episode_message(
            self._hand,
            self.task,
            trace,
            begun.goal.row(world),
            Surface(*(np.asarray(field)[world] for field in begun.surface)),
            self.objects[int(np.asarray(begun.reset_state.object_index)[world])],
            {
                "version": self.bundle.version,
                "actor": "evaluation",
                "success": metrics["success"] > 0,
                "metrics": metrics,
            },
        )

    def _worker(
        self, task: TaskConfig, episodes: int, traced: bool = False
    ) -> contextlib.AbstractContextManager[RolloutWorker]:
        """A worker with not many more worlds than `episodes` of each row need."""
        rows = 2 ** sum(getattr(task, f"p_{constraint.name}") not in (0.0, 1.0) for constraint in optional(task))
        return evaluation_worker(
            self.bundle,
            task,
            self.objects,
            self._bank,
            physics=self._physics,
            threads=self._threads,
            batch=min(self._batch, 1 << (episodes * rows - 1).bit_length()),
            seed=self._seed,
            traced=slice(None) if traced else slice(0),
        )

    def _begin(self, worker: RolloutWorker, after: int) -> EnvState:
        """Gives the episodes that begin now the full hold and `after` steps more, whatever was drawn for them."""
        assert worker.state is not None
        hold = jnp.full_like(worker.state.hold, self._hold)
        worker.state = worker.state._replace(hold=hold, after=jnp.full_like(hold, after))
        return worker.state

    def _batch_of_episodes(
        self, worker: RolloutWorker, stressed: bool = False
    ) -> tuple[Sample, Callable[[int], Message]]:
        """One episode of every world, and what gives the recording of one; all of them begin and end together.

        It is collected in pieces, so that a large batch's observations need not be in memory for all steps. If it is
        `stressed`, what grasps survive after the hold is simulated too.
        """
        start, window = self.task.approach_steps, self.task.hold_steps
        length = start + self._hold
        piece = math.gcd(start, self._hold)
        piece = piece if piece >= 10 else length
        after = -(-protocols.stress_steps(self.task) // piece) * piece if stressed else 0
        begun = self._begin(worker, after)
        traces: list[Trace] = []
        probed: list[Any] = []
        for step in range(0, length + after, piece):
            rollout = worker.collect(self.bundle.inference_parameters, piece)
            probed.append(jax.tree.map(np.asarray, rollout.probed))
            if step < length:
                traces.append(rollout.trace)
                finished = finished_episodes(rollout, self.task)
        samples = jax.tree.map(lambda *parts: np.concatenate(parts), *probed)
        force, torque = (x[start : start + window].swapaxes(0, 1) for x in (samples.link_force, samples.torque_share))
        values = {name: finished[f"episode/{name}"] for name in metric_names(self.task)}
        values |= protocols.assess(samples, values["held"] > 0, self.task, self._hold)

        def message(world: int) -> Message:
            """The recording of one world's episode."""
            trace = Trace(
                *(np.concatenate([np.asarray(x[:, world]) for x in field]) for field in zip(*traces, strict=True))
            )
            return self._message(begun, trace, {name: float(column[world]) for name, column in values.items()}, world)

        return Sample(values, force, torque), message
