"""Evaluation by the paper's protocol: the deterministic policy under chosen constraints on a pool of objects."""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

from congrasp.actors.initial import InitialConditions
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.objects.distance import DistanceField, distance_field
from congrasp.common.objects.pool import scale_objects
from congrasp.common.objects.spec import GraspObject
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.runtime.engines import ENGINES, PhysicsName
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.sampling.build import build_bank, with_columns
from congrasp.common.wire.codec import Message
from congrasp.services.evaluate import loads, references, sensing
from congrasp.services.evaluate.episodes import Batch, Episodes
from congrasp.services.evaluate.heading_rules import HeadingRules, heading_rules
from congrasp.services.evaluate.loads import Load
from congrasp.services.evaluate.noise import LEVELS, Noise, with_noise
from congrasp.services.evaluate.paper import CENTER_GROUP
from congrasp.services.evaluate.plan import RowPlan, batches, from_references, plan_row
from congrasp.services.evaluate.protocol import NOMINAL_FRICTION, protocol, two_seconds
from congrasp.services.evaluate.references import References
from congrasp.services.evaluate.scores import Row, Sample, joined, summarise

STRESSED = 200
"""Episodes of a row that continue after the hold with lift and pushes."""
_KEPT = 8
"""Episodes of a row kept for inspection: at most this many that hold the object to the end, and as many others."""
MEASURED = 512
"""Number of objects above which distance fields, and thus plausibility, are skipped."""


class _Level(NamedTuple):
    """One of several variants of the same episodes."""

    change: Callable[[InitialConditions], InitialConditions]
    objects: Sequence[GraspObject] = ()
    """Objects that replace the evaluator's, if any."""


class Evaluator:
    """Evaluates a policy on a pool of objects."""

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
        paper: str = "hands",
    ):
        """Builds the constraint sets.

        Args:
          bundle: the policy.
          objects: objects to grasp; they are scaled for its hand (`common.objects.pool.scale_objects`).
          physics: engine, except `auto`.
          batch: number of parallel worlds; 0 uses the engine's default.
          threads: threads of the `native` engine.
          seed: seed of constraints and episodes.
          task: task, by default that of the bundle; see `protocol` for the settings that are kept.
          friction: sliding friction between hand and object.
          hold_steps: control steps without the table; by default the task's, which count for success.
          bank: constraint bank of these objects in this order (`common.task.sampling.write_sets.bank_of`); by default
            generated from the seed, with references of the reference policy (`services.evaluate.references`).
          paper: table of the paper for comparison (`services.evaluate.paper`); empty for none.
        """
        base = task or bundle.task
        hold = hold_steps or base.hold_steps
        self.bundle, self.paper = bundle, paper
        self.task = protocol(base, hold, friction)
        self._hold = hold
        self._hand = get_hand(bundle.spec.hand)
        self.objects = scale_objects(self._hand, self.task, objects)
        self._physics, self._threads, self._seed = physics, threads, seed
        self._batch = batch or ENGINES[physics].batch
        self._bank = (
            with_columns(self._hand, self.task, bank) if bank else build_bank(self._hand, self.task, self.objects, seed)
        )
        self._given = bank is not None
        self._references: References | None = None
        self._field: DistanceField | None = None
        self._kept: dict[str, dict[bool, list[Message]]] = {}

    def references(self, progress: Callable[[int, int], None] = lambda done, of: None) -> References | None:
        """Returns the references of which rows draw, those of the reference policy; None if some were given."""
        if self._references is None and not self._given:
            policy, _ = references.reference_policy(self.bundle)
            self._references = self.references_of(policy, progress)
        return self._references

    def references_of(
        self, policy: PolicyBundle, progress: Callable[[int, int], None] = lambda done, of: None
    ) -> References:
        """Returns references of a policy on these objects; see `services.evaluate.references.make`."""
        return references.make(
            policy,
            self.task,
            self.objects,
            self._bank,
            physics=self._physics,
            threads=self._threads,
            progress=progress,
        )

    def bank_for(self, name: str) -> ConstraintBank:
        """Returns the constraint bank of a row's episodes."""
        if from_references(name) and (made := self.references()):
            return made.bank
        return self._bank

    def plan(self, name: str, episodes: int) -> RowPlan:
        """Plans the episodes of a row; see `services.evaluate.plan.plan_row`.

        Raises:
          CongraspError: no object allows the row's constraints, or the policy does not support them.
        """
        return plan_row(self.task, self.bank_for(name), self.objects, name, episodes)

    def samples(
        self,
        names: Sequence[str],
        episodes: int,
        progress: Callable[[int], None] = lambda done: None,
        *,
        keep: bool = False,
    ) -> dict[str, Sample]:
        """Simulates the episodes of every row.

        Args:
          names: names of rows, see `services.evaluate.plan.plan_row`.
          episodes: least number for each row.
          progress: called with the number of finished episodes of all rows.
          keep: keeps some of them for `examples`; every step of all worlds is then in memory.

        Raises:
          CongraspError: no object of the pool allows a row's constraints.
        """
        plans = {name: self.plan(name, episodes) for name in names}
        found: dict[str, Sample] = {}
        with self._episodes(episodes, traced=keep) as running:
            for name, plan in plans.items():
                done = sum(plans[other].total for other in found)
                advance = functools.partial(lambda before, n: progress(before + n), done)
                found[name] = self._run(running, name, plan, self.bank_for(name), advance, keep)
        return found

    def allowed(self, names: Sequence[str]) -> tuple[list[str], list[CongraspError]]:
        """Returns the rows that some object allows, and errors for the others (captured objects may lack parts).

        Raises:
          CongraspError: no row is left.
        """
        allowed, errors = [], []
        for name in names:
            try:
                self.plan(name, 1)
                allowed.append(name)
            except CongraspError as error:
                errors.append(error)
        if not allowed:
            raise errors[0]
        return allowed, errors

    def rows_under_noise(self, progress: Callable[[int], None], episodes: int) -> list[Row]:
        """Evaluates a row for each of `services.evaluate.noise.LEVELS`, all with noise on the same references.

        Args:
          progress: called with the number of finished episodes of all rows.
          episodes: least number for each row.
        """
        rows: list[Row] = []
        with self._episodes(episodes) as running:
            for constraint, group in itertools.groupby(LEVELS, lambda noise: noise.constraint):
                plan, bank = self.plan(constraint, episodes), self.bank_for(constraint)
                for noise in group:
                    advance = functools.partial(lambda done, n: progress(done + n), sum(row.episodes for row in rows))
                    noisy = with_noise(self._hand, bank, noise, self._seed)
                    rows.append(self.row(constraint, self._run(running, "", plan, noisy, advance), noise.label))
        return rows

    def rows_under_sensing(self, progress: Callable[[int], None], episodes: int) -> list[Row]:
        """Evaluates a row for each of `services.evaluate.sensing.LEVELS`; see `_rows_at`."""
        task = sensing.sensing_task(self.task)
        levels = {
            level.label: _Level(functools.partial(sensing.at_level, level=level, control_dt=task.control_dt))
            for level in sensing.LEVELS
        }
        return self._rows_at(sensing.CONSTRAINT, levels, episodes, progress, task)

    def rows_under_loads(self, levels: Sequence[Load], progress: Callable[[int], None], episodes: int) -> list[Row]:
        """Evaluates a row for each load; see `_rows_at`."""
        found = {
            load.label: _Level(functools.partial(loads.at_load, load=load), loads.loaded(self.objects, load))
            for load in levels
        }
        return self._rows_at(loads.CONSTRAINT, found, episodes, progress, self.task)

    def _rows_at(
        self,
        constraint: str,
        levels: Mapping[str, _Level],
        episodes: int,
        progress: Callable[[int], None],
        task: TaskConfig,
    ) -> list[Row]:
        """Evaluates a row of a constraint for each level, by its label, all with the same initial conditions.

        `episodes` is the least number of each row, and `progress` receives the number of finished ones of all rows.
        """
        rows: list[Row] = []
        plan, bank = self.plan(constraint, episodes), self.bank_for(constraint)
        with self._episodes(episodes, task=task) as running:
            for label, level in levels.items():
                if level.objects:
                    running.replace_objects(level.objects, self._field)
                drawn = batches(self._hand, task, bank, plan, self._seed, running.batch)
                conditions = ((level.change(begun), count) for begun, count in drawn)
                advance = functools.partial(lambda done, n: progress(done + n), sum(row.episodes for row in rows))
                rows.append(self.row(constraint, simulate(running, conditions, plan.total, advance), label))
        return rows

    def row_by_center(self, episodes: int, progress: Callable[[int], None]) -> tuple[Row, HeadingRules]:
        """Evaluates headings that only keep the hand's centre above the table; returns the row and the rules' effect.

        Args:
          episodes: least number for the row.
          progress: called with the number of finished episodes.
        """
        task = dataclasses.replace(self.task, headings="center")
        bank = build_bank(self._hand, task, self.objects, self._seed)
        plan = plan_row(task, bank, self.objects, "heading", episodes)
        with self._episodes(episodes) as running:
            row = self.row("heading", self._run(running, "", plan, bank, progress), CENTER_GROUP)
        return row, heading_rules(self._bank, self.objects, bank)

    def noisy_example(self, noise: Noise) -> Message | None:
        """Returns an episode under a noisy reference in which the object is held to the end; None if there is none."""
        plan = self.plan(noise.constraint, self._batch)
        noisy = with_noise(self._hand, self.bank_for(noise.constraint), noise, self._seed)
        with self._episodes(self._batch, traced=True) as running:
            self._kept[noise.label] = {False: [], True: []}
            self._run(running, noise.label, plan, noisy, keep=True)
        return next(iter(self._kept.pop(noise.label)[True]), None)

    def rows(
        self,
        names: Sequence[str],
        episodes: int,
        progress: Callable[[int], None] = lambda done: None,
        *,
        keep: bool = False,
    ) -> list[Row]:
        """Evaluates one row for each name; see `samples`."""
        samples = self.samples(names, episodes, progress, keep=keep)
        return [self.row(name, sample) for name, sample in samples.items()]

    def row(self, name: str, sample: Sample, group: str = "", objects: Sequence[str] = ()) -> Row:
        """Returns a row of episodes of this evaluator's protocol, on its objects or on those of these names."""
        return summarise(
            name,
            self._hand.name,
            sample,
            held_2s=self._hold == two_seconds(self.task),
            by_reference=self._given and from_references(name),
            group=group,
            method=self.task.method,
            paper=self.paper,
            objects=objects or [obj.name for obj in self.objects],
        )

    def examples(self, name: str, successes: int, failures: int, most: int = 300) -> list[Message]:
        """Returns episodes of a row for inspection, failures first; success requires a hold to the end.

        They come from those kept by the last `samples`, or from `most` that are evaluated now.

        Raises:
          CongraspError: the pool does not allow these constraints.
        """
        if name not in self._kept:
            self.samples([name], most, keep=True)
        kept = self._kept[name]
        return [*kept[False][:failures], *kept[True][:successes]]

    def _episodes(self, episodes: int, traced: bool = False, task: TaskConfig | None = None) -> Episodes:
        """Returns the simulator of rows with `episodes` episodes; its batch depends only on this number."""
        if self._field is None and len(self.objects) <= MEASURED:
            self._field = distance_field(self.objects)
        return Episodes(
            self.bundle,
            task or self.task,
            self.objects,
            hold=self._hold,
            batch=batch_of(max(episodes, len(self.objects)), self._batch),  # rows have an episode of every object
            physics=self._physics,
            threads=self._threads,
            field=self._field,
            traced=traced,
        )

    def _run(
        self,
        running: Episodes,
        name: str,
        plan: RowPlan,
        bank: ConstraintBank,
        progress: Callable[[int], None] = lambda done: None,
        keep: bool = False,
    ) -> Sample:
        """Simulates the episodes of a plan, of which some are kept under a name."""
        if keep:
            self._kept[name] = {False: [], True: []}

        def visit(batch: Batch, count: int) -> None:
            for i in range(count):
                kept = self._kept[name][bool(batch.sample.values["held"][i] > 0)]
                if len(kept) < _KEPT:
                    kept.append(batch.message(i))

        conditions = batches(self._hand, self.task, bank, plan, self._seed, running.batch)
        return simulate(running, conditions, plan.total, progress, visit if keep else lambda batch, count: None)


def batch_of(episodes: int, most: int) -> int:
    """Number of parallel environments for rows of `episodes` episodes: a power of two, or `most`."""
    return min(most, 1 << (episodes - 1).bit_length())


def simulate(
    running: Episodes,
    conditions: Iterable[tuple[InitialConditions, int]],
    total: int,
    progress: Callable[[int], None] = lambda done: None,
    visit: Callable[[Batch, int], None] = lambda batch, count: None,
    stressed: int = STRESSED,
) -> Sample:
    """Simulates the episodes of a row; the first ones continue after the hold with lift and pushes.

    Args:
      running: simulator.
      conditions: see `services.evaluate.plan.batches`.
      total: number of episodes.
      progress: called with the number of finished episodes.
      visit: called with each batch, and the number of its episodes that count.
      stressed: least number of episodes that continue; batches continue as a whole.
    """
    found: list[Sample] = []
    done, most = 0, min(total, stressed) if running.stressable else 0
    for begun, count in conditions:
        batch = running.run(begun, stressed=done < most)
        visit(batch, count)
        found.append(batch.sample.first(count))
        done += count
        progress(done)
    return joined(found)
