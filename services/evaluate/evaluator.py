"""Evaluation by the paper's protocol: the deterministic policy under chosen constraints on a pool of objects."""

import dataclasses
import functools
import itertools
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np

from congrasp.actors.initial import InitialConditions
from congrasp.common.config import TaskConfig
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.objects.distance import DistanceField, distance_field
from congrasp.common.objects.pool import scale_objects
from congrasp.common.objects.spec import GraspObject
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.runtime.engines import ENGINES, PhysicsName
from congrasp.common.task.sampling.bank import ConstraintBank, with_columns
from congrasp.common.task.sampling.build import build_bank
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
"""Episodes of a row that go on after the hold, lifted and pushed."""
_KEPT = 8
"""Episodes of a row that can be looked at afterwards: so many that hold the object to the end, and so many others."""
MEASURED = 512
"""Objects beyond which their surfaces' distance fields are left out, and plausibility with them."""


class _Level(NamedTuple):
    """One of several changes of the same episodes."""

    change: Callable[[InitialConditions], InitialConditions]
    objects: Sequence[GraspObject] = ()
    """In place of the evaluator's, if there are any."""


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
        paper: str = "hands",
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
            (`common.task.sampling.write_sets.bank_of`); made from the seed if not given, with references of the
            reference policy (`services.evaluate.references`).
          paper: which of the paper's tables rows stand beside (`services.evaluate.paper`); empty for none.
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
        """References of the reference policy, which rows draw the held-out ones of; None where all were given."""
        if self._references is None and not self._given:
            policy, _ = references.reference_policy(self.bundle)
            self._references = self.references_of(policy, progress)
        return self._references

    def references_of(
        self, policy: PolicyBundle, progress: Callable[[int, int], None] = lambda done, of: None
    ) -> References:
        """References of a policy on these objects; see `services.evaluate.references.make`."""
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
        """What a row's episodes are drawn from."""
        if from_references(name) and (made := self.references()):
            return references.held_out(made.bank)
        return self._bank

    def plan(self, name: str, episodes: int) -> RowPlan:
        """The episodes of a row; see `services.evaluate.plan.plan_row`.

        Raises:
          CongraspError: no object allows the row's constraints, or the policy does not know them.
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
        """Episodes of every row.

        Args:
          names: of rows, see `services.evaluate.plan.plan_row`.
          episodes: for each row, at least.
          progress: is told how many episodes of all rows there are.
          keep: keep some of them for `examples`, for which every step of all worlds has to be in memory.

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
        """The rows that some object allows, and why others are left out; captured objects may have no labelled parts.

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
        """A row for each of `services.evaluate.noise.LEVELS`; see there. All of them add noise to the same references.

        Args:
          progress: is told how many episodes of all rows there are.
          episodes: for each row, at least.
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
        """A row for each of `services.evaluate.sensing.LEVELS`; see `_rows_at`."""
        task = sensing.sensing_task(self.task)
        levels = {
            level.label: _Level(functools.partial(sensing.at_level, level=level, control_dt=task.control_dt))
            for level in sensing.LEVELS
        }
        return self._rows_at(sensing.CONSTRAINT, levels, episodes, progress, task)

    def rows_under_loads(self, levels: Sequence[Load], progress: Callable[[int], None], episodes: int) -> list[Row]:
        """A row for each load; see `_rows_at`."""
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
        """A row of a constraint for each level, by its label; all of them begin with the same episodes.

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
        """The heading row whose headings leave room for the hand's centre alone, and the effect of the rules.

        Args:
          episodes: of the row, at least.
          progress: receives the number of finished episodes.
        """
        task = dataclasses.replace(self.task, headings="center")
        bank = build_bank(self._hand, task, self.objects, self._seed)
        plan = plan_row(task, bank, self.objects, "heading", episodes)
        with self._episodes(episodes) as running:
            row = self.row("heading", self._run(running, "", plan, bank, progress), CENTER_GROUP)
        return row, heading_rules(self._bank, self.objects, bank)

    def noisy_example(self, noise: Noise) -> Message | None:
        """An episode under a noisy reference in which the object is held to the end, if there is one."""
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
        """One row for each name; see `samples`."""
        samples = self.samples(names, episodes, progress, keep=keep)
        return [self.row(name, sample) for name, sample in samples.items()]

    def row(self, name: str, sample: Sample, group: str = "", objects: Sequence[str] = ()) -> Row:
        """A row of episodes of this evaluator's protocol, on its own objects or on those of these names."""
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

    def draws(self, name: str, episodes: int, count: int) -> list[Row]:
        """`count` rows of `episodes` each from independent draws, to see how much chance there is in one."""
        sample = self.samples([name], episodes * count)[name]
        order = np.arange(len(sample.values["success"])) // episodes
        return [self.row(name, sample.where(order == i)) for i in range(count)]

    def examples(self, name: str, successes: int, failures: int, most: int = 300) -> list[Message]:
        """Episodes of a row to look at, failures first; the object must be held to the end of the hold to succeed.

        They are some of those that `samples` kept last, or of `most` that are evaluated now.

        Raises:
          CongraspError: the pool does not allow these constraints.
        """
        if name not in self._kept:
            self.samples([name], most, keep=True)
        kept = self._kept[name]
        return [*kept[False][:failures], *kept[True][:successes]]

    def episode(self, name: str, attempts: int = 1) -> Message:
        """An episode under a set of constraints: the first of `attempts` that succeeds, or the last of them.

        Raises:
          CongraspError: the pool does not allow these constraints.
        """
        plan = self.plan(name, max(attempts, len(self.objects)))
        first = zlib.crc32(name.encode()) % plan.total  # another object for another row
        plan = plan._replace(episodes=jax.tree.map(lambda x: np.roll(x, -first), plan.episodes))
        bank = self.bank_for(name)
        with self._episodes(attempts, traced=True) as running:
            for begun, count in batches(self._hand, self.task, bank, plan, self._seed, running.batch):
                batch = running.run(begun)
                tried = min(count, attempts)
                succeeded = np.flatnonzero(batch.sample.values["success"][:tried] > 0)
                attempts -= tried
                if len(succeeded) or not attempts:
                    break
            return batch.message(int(succeeded[0]) if len(succeeded) else tried - 1)

    def _episodes(self, episodes: int, traced: bool = False, task: TaskConfig | None = None) -> Episodes:
        """What simulates rows of so many episodes; its batch depends on nothing else, so that rows do not either."""
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
        """The episodes of a plan, of which some are kept under a name."""
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
    """Environments side by side for rows of so many episodes: a power of two, or `most`."""
    return min(most, 1 << (episodes - 1).bit_length())


def simulate(
    running: Episodes,
    conditions: Iterable[tuple[InitialConditions, int]],
    total: int,
    progress: Callable[[int], None] = lambda done: None,
    visit: Callable[[Batch, int], None] = lambda batch, count: None,
    stressed: int = STRESSED,
) -> Sample:
    """The episodes of a row; the first ones go on after the hold, lifted and pushed.

    Args:
      running: what simulates them.
      conditions: see `services.evaluate.plan.batches`.
      total: number of episodes.
      progress: is told how many there are.
      visit: is given each batch, and how many of its episodes count.
      stressed: how many go on, at least; batches go on as a whole.
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
