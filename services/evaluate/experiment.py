"""Experiments: episodes of one policy on some objects by the paper's protocol.

A variation of an experiment is a row of a table.
"""

import dataclasses
import functools
import hashlib
import itertools
import pathlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np

import congrasp.actors
import congrasp.common
import congrasp.services.evaluate
from congrasp.actors.initial import InitialConditions
from congrasp.common.episode.episode import Episode
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.io import files
from congrasp.common.objects import store
from congrasp.common.objects.distance import DistanceField, distance_field
from congrasp.common.objects.pool import scale_objects
from congrasp.common.objects.spec import GraspObject
from congrasp.common.policy.bundle import PolicyBundle, content_hash
from congrasp.common.runtime.engines import ENGINES, PhysicsName
from congrasp.common.runtime.entry import compiling_entry
from congrasp.common.runtime.physics_library import mujoco
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.sampling.build import build_bank, with_columns
from congrasp.common.wire.codec import Message, encode
from congrasp.services.evaluate import references
from congrasp.services.evaluate.common_batches import (
    report_share,
    run_rows,
    sample_of_row,
    with_first_object,
)
from congrasp.services.evaluate.episodes import Batch, Episodes, Sample, join_samples
from congrasp.services.evaluate.plan import (
    NOMINAL_FRICTION,
    RowPlan,
    batches,
    from_references,
    plan_row,
    protocol,
    required_hold_steps,
)
from congrasp.services.evaluate.references import References
from congrasp.services.evaluate.scores import Row, RowDescription, summarise

MIN_STRESSED_EPISODES = 200
"""Episodes of a row that continue after the hold with lift and pushes."""
MAX_MEASURED_OBJECTS = 512
"""Number of objects above which distance fields, and thus plausibility, are skipped."""
_MAX_JOINED_OBJECTS = 1024
"""Most objects of rows in common batches, unless a single row has more."""
_MAX_KEPT_EPISODES = 8
"""Episodes of a row kept for inspection: at most this many that hold the object to the end, and as
many others.
"""
Track = Callable[[str, int | None], Callable[[int], None]]
"""(label, total if known) -> function to call with the number done."""


def silent(label: str, total: int | None) -> Callable[[int], None]:
    """A `Track` that shows nothing."""
    return lambda done: None


def _ignore(batch: Batch, count: int) -> None:
    """Does nothing with a batch."""


def advance_from(advance: Callable[[int], None], before: int, number: int) -> None:
    """Shows that `number` episodes are done in addition to those `before`."""
    advance(before + number)


@dataclasses.dataclass(frozen=True)
class Variation:
    """A row of a table: the constraints of its episodes, and a change of the experiment, here
    none.
    """

    constraint: str = "heading"
    """Name of the row's constraints, see `services.evaluate.plan.plan_row`."""
    label: str = ""
    """Description of the change; the group of the row."""

    def task(self, task: TaskConfig) -> TaskConfig:
        """Returns the task of the simulation."""
        return task

    def bank(self, experiment: "Experiment") -> ConstraintBank:
        """Returns the bank from which the constraints are drawn."""
        return experiment.bank_for(self.constraint)

    def objects(self, objects: Sequence[GraspObject]) -> Sequence[GraspObject]:
        """Returns the objects of the simulation, scaled for the hand."""
        return objects

    def episodes(self, conditions: InitialConditions, control_dt: float) -> InitialConditions:
        """Returns the initial conditions of the simulation; a control step lasts `control_dt`
        seconds.
        """
        return conditions


class Result(NamedTuple):
    """Result of a variation."""

    variation: Variation
    sample: Sample
    row: Row
    held: list[Episode]
    """Kept episodes in which the object is held to the end."""
    lost: list[Episode]
    """Other kept episodes."""

    def examples(self, successes: int, failures: int) -> list[Episode]:
        """Returns some of the kept episodes, failures first."""
        return [*self.lost[:failures], *self.held[:successes]]


@dataclasses.dataclass(frozen=True, eq=False)
class _PlannedRow:
    """A row before it is simulated."""

    variation: Variation
    plan: RowPlan
    file: pathlib.Path | None
    """File of its episodes; None to keep none."""


class _JoinedRows:
    """Rows that run in common batches."""

    def __init__(self) -> None:
        self.rows: list[_PlannedRow] = []
        self.objects: list[GraspObject] = []
        """Objects of all rows; neighbours with the same ones share them."""
        self.first_objects: list[int] = []
        """Place of the first object of each row."""
        self._objects_of_last: Sequence[GraspObject] = ()

    def has_room(self, objects: Sequence[GraspObject]) -> bool:
        """True if a row with these objects may be added."""
        if not self.rows or objects is self._objects_of_last:
            return True
        return len(self.objects) + len(objects) <= _MAX_JOINED_OBJECTS

    def add(self, row: _PlannedRow, objects: Sequence[GraspObject]) -> None:
        """Adds a row and its objects."""
        if objects is not self._objects_of_last:
            self.objects += objects
            self._objects_of_last = objects
        self.rows.append(row)
        self.first_objects.append(len(self.objects) - len(objects))


@dataclasses.dataclass(frozen=True, eq=False)
class Experiment:
    """Episodes of one policy on some objects."""

    policy: PolicyBundle
    objects: Sequence[GraspObject]
    """N objects, before they are scaled for the hand."""
    constraints: ConstraintBank | None = None
    """Constraints of these objects in this order (`common.task.sampling.set_bank.bank_of`); sampled
    if None, with references of the reference policy (`services.evaluate.references`)."""
    episodes: int = 1000
    """Least number of episodes of a row."""
    physics: PhysicsName = "native"
    """Engine, except `auto`."""
    reference_physics: PhysicsName = ""
    """Engine of the reference policy's grasps; that of the episodes if empty. With the same one,
    the episodes of different engines have the same references."""
    batch: int = 0
    """Most parallel worlds; 0 uses the engine's default."""
    seed: int = 0
    """Seed of constraints and episodes."""
    friction: float = NOMINAL_FRICTION
    """Sliding friction between hand and object."""
    hold: int | None = None
    """Control steps without the table; two seconds if None."""
    paper: str = "hands"
    """Table of the paper for comparison (`services.evaluate.paper.figures`); empty for none."""
    pool: int = 0
    """Number of the pool of these objects, added to the seed of sampled constraints."""
    measured: bool = True
    """False skips the measures of plausibility, as do more than `MAX_MEASURED_OBJECTS` objects."""
    track: Track = silent
    """Shows progress."""

    @functools.cached_property
    def hand(self) -> Hand:
        """The policy's hand."""
        return get_hand(self.policy.spec.hand)

    @functools.cached_property
    def steps(self) -> int:
        """Control steps without the table."""
        return required_hold_steps(self.policy.task) if self.hold is None else self.hold

    @functools.cached_property
    def task(self) -> TaskConfig:
        """The policy's task under the protocol."""
        return protocol(self.policy.task, self.steps, self.friction)

    @functools.cached_property
    def scaled(self) -> list[GraspObject]:
        """The objects in the size in which the hand grasps them."""
        return scale_objects(self.hand, self.task, self.objects)

    @functools.cached_property
    def bank(self) -> ConstraintBank:
        """Constraints of the objects; those of sampled references are procedural.

        Raises:
          CongraspError: the hand cannot approach an object.
        """
        if self.constraints is not None:
            return with_columns(self.hand, self.task, self.constraints)
        return build_bank(self.hand, self.task, self.scaled, self.seed + self.pool)

    @functools.cached_property
    def by_center(self) -> ConstraintBank:
        """Sampled constraints whose headings only keep the hand's centre above the table."""
        task = dataclasses.replace(self.task, headings="center")
        return build_bank(self.hand, task, self.scaled, self.seed + self.pool)

    @functools.cached_property
    def references(self) -> References | None:
        """References of the reference policy on these objects; None if the constraints are not
        sampled.
        """
        if self.constraints is not None:
            return None
        policy, _ = references.reference_policy(self.policy)
        return self.references_of(policy)

    def references_of(self, policy: PolicyBundle) -> References:
        """Returns references of a policy on these objects; see
        `services.evaluate.references.make`.
        """
        advance = self.track("Reference grasps", None)
        return references.make(
            policy,
            self.task,
            self.scaled,
            self.bank,
            physics=self.reference_physics or self.physics,
            progress=lambda done, of: advance(done),
        )

    @property
    def worlds(self) -> int:
        """Number of parallel worlds for the episodes of one row, which has at least one of every
        object.
        """
        return self.worlds_for(max(self.episodes, len(self.objects)))

    def worlds_for(self, episodes: int) -> int:
        """Returns the number of parallel worlds for so many episodes: a power of two, or the most
        that the engine or the user allows.
        """
        return min(self.batch or ENGINES[self.physics].batch, 1 << (episodes - 1).bit_length())

    @functools.cached_property
    def field(self) -> DistanceField | None:
        """Grids of the objects' surfaces; None if plausibility is not measured."""
        if not self.measured or len(self.objects) > MAX_MEASURED_OBJECTS:
            return None
        return distance_field(self.scaled)

    def bank_for(self, constraint: str) -> ConstraintBank:
        """Returns the bank of a row's episodes."""
        if from_references(constraint) and self.references is not None:
            return self.references.bank
        return self.bank

    @compiling_entry
    def plan(self, variation: Variation) -> RowPlan:
        """Plans the episodes of a row; see `services.evaluate.plan.plan_row`.

        Raises:
          CongraspError: no object allows the row's constraints, or the policy does not support
            them.
        """
        return plan_row(
            self.task, variation.bank(self), self.scaled, variation.constraint, self.episodes
        )

    @compiling_entry
    def allowed(
        self, variations: Iterable[Variation]
    ) -> tuple[list[Variation], list[CongraspError]]:
        """Returns the rows that some object allows, and errors for the others (captured objects may
        lack parts).

        Raises:
          CongraspError: no row is left.
        """
        allowed = []
        errors = []
        for variation in variations:
            try:
                self.plan(variation)
                allowed.append(variation)
            except CongraspError as error:
                errors.append(error)
        if errors and not allowed:
            raise errors[0]
        return allowed, errors

    @functools.cached_property
    def _identity(self) -> tuple[object, ...]:
        """Code, policy and settings."""
        packages = (congrasp.common, congrasp.actors, congrasp.services.evaluate)
        return (
            files.source_digest(*packages),
            jax.__version__,
            mujoco.__version__,
            self.task,
            self.steps,
            self.episodes,
            self.worlds,
            self.physics,
            self.seed,
            self.pool,
            self.measured,
            content_hash(encode(self.policy.to_message())),
        )

    def digest(self, *others: object) -> str:
        """Returns sixteen hex digits that identify the code, the policy, the settings and other
        values.
        """
        return content_hash(repr((*self._identity, *others)).encode())

    @compiling_entry
    def run(
        self,
        variations: Sequence[Variation],
        *,
        keep: bool = False,
        stored: pathlib.Path | None = None,
    ) -> list[Result]:
        """Simulates rows; one does not depend on the others.

        Args:
          variations: the rows. Those of one task in a sequence share a simulator.
          keep: keeps some episodes of each row; every step of all worlds is then in memory.
          stored: folder for the rows, without kept episodes; a run with the same arguments resumes
            from it.

        Raises:
          CongraspError: no object allows a row's constraints, or the policy does not support them.
        """
        rows = []
        for variation in variations:
            file = None if stored is None else stored / f"{self._name(variation)}.safetensors"
            rows.append(_PlannedRow(variation, self.plan(variation), file))
        advance = self.track("Episodes", sum(row.plan.total for row in rows))
        results: dict[_PlannedRow, Result] = {}
        for row in rows:
            stored_result = self._stored_result(row)
            if stored_result is not None:
                results[row] = stored_result
        missing = [row for row in rows if row not in results]
        for task, of_task in itertools.groupby(missing, lambda row: row.variation.task(self.task)):
            finished = sum(result.row.episodes for result in results.values())
            progress = functools.partial(advance_from, advance, finished)
            for row, result in self._simulate(task, list(of_task), keep, progress):
                results[row] = result
                if row.file is not None:
                    files.keep(row.file, Message(result.sample.arrays()), len(rows))
        return [results[row] for row in rows]

    def _simulate(
        self,
        task: TaskConfig,
        rows: Sequence[_PlannedRow],
        keep: bool,
        progress: Callable[[int], None],
    ) -> Iterator[tuple[_PlannedRow, Result]]:
        """Simulates rows of one task; yields each row with its result.

        On a device, neighbouring rows run in common batches, unless episodes are kept.
        """
        finished = 0
        if keep or not ENGINES[self.physics].on_device:
            with self.simulator(task, traced=keep) as running:
                for row in rows:
                    progress_of_row = functools.partial(advance_from, progress, finished)
                    yield row, self._run(running, row, progress_of_row, keep)
                    finished += row.plan.total
            return
        for joined in self._joined(rows):
            progress_of_run = functools.partial(advance_from, progress, finished)
            yield from self._run_together(task, joined, progress_of_run)
            finished += sum(row.plan.total for row in joined.rows)

    def _joined(self, rows: Sequence[_PlannedRow]) -> Iterator[_JoinedRows]:
        """Yields neighbouring rows that run together."""
        joined = _JoinedRows()
        for row in rows:
            objects = row.variation.objects(self.scaled)
            if not joined.has_room(objects):
                yield joined
                joined = _JoinedRows()
            joined.add(row, objects)
        yield joined

    def _run_together(
        self, task: TaskConfig, joined: _JoinedRows, progress: Callable[[int], None]
    ) -> list[tuple[_PlannedRow, Result]]:
        """Simulates rows of one task in common batches; all their episodes continue after the
        hold.
        """
        conditions = [self._conditions(row.variation, row.plan) for row in joined.rows]
        of_all_objects = [
            with_first_object(*pair) for pair in zip(conditions, joined.first_objects, strict=True)
        ]
        worlds = self.worlds_for(sum(row.plan.total for row in joined.rows))
        with self.simulator(task, joined.objects, worlds=worlds) as running:
            samples = run_rows(
                running, of_all_objects, stressed=running.stressable, progress=progress
            )
        results = []
        for row, sample, planned in zip(joined.rows, samples, conditions, strict=True):
            of_row = sample_of_row(sample, planned)
            result = Result(row.variation, of_row, self.row(row.variation, of_row), [], [])
            results.append((row, result))
        return results

    def _conditions(self, variation: Variation, plan: RowPlan) -> InitialConditions:
        """Returns the initial conditions of all episodes of a row."""
        task = variation.task(self.task)
        columns = []
        for planned, count in batches(
            self.hand, task, variation.bank(self), plan, self.seed, self.worlds
        ):
            conditions = variation.episodes(planned, task.control_dt)
            columns.append(
                jax.tree.map(lambda column, count=count: np.asarray(column)[:count], conditions)
            )
        joined: InitialConditions = jax.tree.map(lambda *parts: np.concatenate(parts), *columns)
        return joined

    def _use_objects(self, running: Episodes, objects: Sequence[GraspObject]) -> None:
        """Replaces a simulator's objects, if they are others."""
        if objects is not running.objects:
            running.replace_objects(objects, self.field)

    def _stored_result(self, row: _PlannedRow) -> Result | None:
        """Returns the result of a row from its file, without kept episodes; None without one."""
        message = None if row.file is None else files.read_kept(row.file)
        if message is None:
            return None
        sample = Sample.of(message.arrays)
        return Result(row.variation, sample, self.row(row.variation, sample), [], [])

    def _name(self, variation: Variation) -> str:
        """File name of a row, from everything that it depends on."""
        bank = hashlib.sha256()
        for leaf in jax.tree.leaves(variation.bank(self)):
            bank.update(np.asarray(leaf).tobytes())
        return self.digest(variation, bank.hexdigest(), self._contents)

    @functools.cached_property
    def _contents(self) -> list[str]:
        """Digests of the objects."""
        return [store.digest(obj) for obj in self.objects]

    def simulator(
        self,
        task: TaskConfig | None = None,
        objects: Sequence[GraspObject] = (),
        *,
        worlds: int = 0,
        traced: bool = False,
    ) -> Episodes:
        """Returns a simulator.

        Args:
          task: the experiment's task if None.
          objects: copies of the experiment's objects with other masses, one after another; these
            objects themselves if empty.
          worlds: parallel worlds; `self.worlds` if 0.
          traced: records every step of every episode.
        """
        field = self.field
        if field is not None and objects:
            field = field.repeated(len(objects) // len(self.scaled))
        return Episodes(
            self.policy,
            task or self.task,
            objects or self.scaled,
            hold=self.steps,
            batch=worlds or self.worlds,
            physics=self.physics,
            field=field,
            traced=traced,
        )

    def _run(
        self,
        running: Episodes,
        row: _PlannedRow,
        progress: Callable[[int], None],
        keep: bool,
    ) -> Result:
        """Simulates a row, and keeps some episodes."""
        held: list[Episode] = []
        lost: list[Episode] = []

        def keep_some(batch: Batch, count: int) -> None:
            """Keeps the first episodes of each outcome."""
            for i in range(count):
                episodes = held if batch.sample.values["held"][i] > 0 else lost
                if len(episodes) < _MAX_KEPT_EPISODES:
                    episodes.append(batch.episode(i))

        visit = keep_some if keep else _ignore
        sample = self.sample(running, row.variation, row.plan, progress, visit)
        return Result(row.variation, sample, self.row(row.variation, sample), held, lost)

    def sample(
        self,
        running: Episodes,
        variation: Variation,
        plan: RowPlan,
        progress: Callable[[int], None],
        visit: Callable[[Batch, int], None] = _ignore,
        stressed: int = MIN_STRESSED_EPISODES,
    ) -> Sample:
        """Returns the episodes of a row; see `batches`.

        Args:
          running: simulator.
          variation: the row.
          plan: its episodes.
          progress: called with the number of simulated episodes; those of a running batch count by
            their share of control steps.
          visit: called with each batch, and the number of its episodes that count.
          stressed: least number of episodes that continue after the hold.
        """
        samples: list[Sample] = []
        finished = 0
        for batch, count in self.batches(running, variation, plan, stressed, progress):
            visit(batch, count)
            samples.append(batch.sample.first(count))
            finished += count
            progress(finished)
        return join_samples(samples)

    def batches(
        self,
        running: Episodes,
        variation: Variation,
        plan: RowPlan,
        stressed: int,
        progress: Callable[[int], None] = lambda done: None,
    ) -> Iterator[tuple[Batch, int]]:
        """Simulates the episodes of a row in batches; yields each, and the number of its episodes
        that count.

        Args:
          running: simulator of this experiment, or of one with the same policy and as many objects.
          variation: the row.
          plan: its episodes.
          stressed: least number of episodes that continue after the hold with lift and pushes;
            batches continue as a whole.
          progress: see `sample`.
        """
        self._use_objects(running, variation.objects(self.scaled))
        task = variation.task(self.task)
        bank = variation.bank(self)
        to_stress = min(plan.total, stressed) if running.stressable else 0
        finished = 0
        for planned, count in batches(self.hand, task, bank, plan, self.seed, running.batch):
            report = functools.partial(report_share, progress, finished, count)
            conditions = variation.episodes(planned, task.control_dt)
            stresses = finished < to_stress
            batch = running.run(conditions, stressed=stresses, progress=report)
            yield batch, count
            finished += count

    def row(self, variation: Variation, sample: Sample) -> Row:
        """Returns the row of a variation's episodes."""
        description = RowDescription(
            variation.constraint,
            self.hand.name,
            [obj.name for obj in self.objects],
            held_2s=self.steps == required_hold_steps(self.task),
            by_reference=self.constraints is not None and from_references(variation.constraint),
            group=variation.label,
            method=self.task.method,
            paper=self.paper,
        )
        return summarise(description, sample)
