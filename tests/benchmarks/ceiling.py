"""Ceiling of an exam: of the conditions that a policy loses, those that noise on its actions or a
search over them holds.
"""

import dataclasses
import json
import pathlib
import shlex
import sys
from collections.abc import Iterator
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console

from congrasp.actors.initial import InitialConditions
from congrasp.actors.physics import PhysicsName, resolve_physics
from congrasp.common.io.files import write_atomically
from congrasp.common.policy.pretrained import policy_file
from congrasp.common.runtime.engines import ENGINES, engine_title
from congrasp.services.cli.console import in_range, tracked
from congrasp.services.evaluate.choices import Exam
from congrasp.services.evaluate.exams import exam_pool
from congrasp.services.evaluate.experiment import Experiment, Track, Variation
from congrasp.services.evaluate.lineup import Entrant, facts, read_entrant
from congrasp.services.evaluate.plan import batches
from congrasp.services.evaluate.results import provenance
from tests.benchmarks import ceiling_search
from tests.benchmarks.ceiling_counts import Counts, Lost, by_object, by_row, counts_of, table
from tests.benchmarks.ceiling_rollouts import PHASES, Simulator, Trials, joined, rows_of

NOISE = (0.2, 0.35)
"""Standard deviations of the noise, each of half of the attempts."""
_POPULATION = 64
_ELITES = 6
_FIRST_STD = 0.25
"""Initial standard deviation of the search's offsets, in units of the action."""
_HELD_BONUS = 1e6
"""Score of a held episode, in addition to its return."""


@dataclasses.dataclass
class Findings:
    """State of the work, as far as it is done."""

    episodes: list[tuple[str, str]] = dataclasses.field(default_factory=list)
    """Row and object of every episode of the exam."""
    lost: list[Lost] = dataclasses.field(default_factory=list)
    conditions: list[InitialConditions] = dataclasses.field(default_factory=list)
    """Initial conditions of the lost episodes, in batches, in their order."""

    def open(self) -> np.ndarray:
        """Indices of the lost conditions that no stage has held."""
        return np.array([n for n, one in enumerate(self.lost) if not one.reached], int)

    def total(self) -> Counts:
        """Counts of all episodes."""
        return counts_of("all", len(self.episodes), self.lost)


@dataclasses.dataclass(frozen=True)
class Ceiling:
    """Counts the conditions of an exam that a policy loses, and those of them that can be held.

    The policy acts with its mean on the episodes of 'congrasp evaluate'. Each lost condition is
    repeated with noise on the actions, half of the attempts with a standard deviation of 0.2 and
    half of 0.35. Where none of them holds the object for two seconds, the cross-entropy method
    searches for offsets of every action in each of three phases: both halves of the steps with the
    table, and those without it. 'unreached' are conditions that no attempt held, which is not a
    proof that none exists.

    Examples:
      python -m tests.benchmarks ceiling --rows heading pose trajectory --json ceiling.json
      python -m tests.benchmarks ceiling --hand allegro --episodes 74 --physics native
    """

    hand: str = "human"
    """Hand of the pretrained policy."""
    policy: pathlib.Path | None = None
    """Policy file instead of the pretrained one."""
    rows: tuple[str, ...] = ("heading",)
    """Constraints of each row, as in 'congrasp evaluate': heading, affordance, pose+trajectory."""
    exam: Exam = "figures"
    """Procedural objects of all families."""
    episodes: int = 365
    """Least number of episodes of each row."""
    attempts: int = 64
    """Attempts with noise at each lost condition."""
    iterations: int = 6
    """Iterations of the search, of 64 episodes a condition; 0 skips it."""
    physics: PhysicsName = "auto"
    """Engine; auto takes warp on an NVIDIA GPU and native (MuJoCo C) on a CPU."""
    batch: int = 0
    """Number of parallel worlds; 0 uses the engine's default."""
    seed: int = 0
    """Seed of constraints, episodes, noise and search."""
    json: Annotated[pathlib.Path | None, tyro.conf.arg(name="json")] = None
    """Also write the results to this file, after each stage and each iteration of the search."""

    def __call__(self) -> int:
        """Runs the stages, and prints and writes the results."""
        in_range(1, episodes=self.episodes)
        in_range(0, attempts=self.attempts, iterations=self.iterations, batch=self.batch)
        entrant = read_entrant(self.policy or policy_file(None, self.hand))
        engine = resolve_physics(self.physics)
        findings = Findings()
        with tracked() as track:
            experiment = Experiment(
                entrant.policy,
                exam_pool(self.exam),
                episodes=self.episodes,
                physics=engine,
                batch=self.batch,
                seed=self.seed,
                measured=False,
                track=track,
            )
            variations = [Variation(row) for row in self.rows]
            plans = [experiment.plan(variation) for variation in variations]
            advance = track("Exam", sum(plan.total for plan in plans))
            with Simulator(experiment, self.batch or ENGINES[engine].batch) as simulator:

                def write(stage: str) -> None:
                    self._write(stage, findings, entrant, experiment, simulator)

                for variation in variations:
                    _examine(simulator, experiment, variation, findings)
                    advance(len(findings.episodes))
                    write("exam")
                if findings.lost:
                    conditions = joined(findings.conditions)
                    _repeat(simulator, conditions, findings)
                    write("repeat")
                    self._add_noise(simulator, conditions, findings, track)
                    write("noise")
                    for iteration in self._search(simulator, conditions, findings, track):
                        write(f"search, iteration {iteration} of {self.iterations}")
                write("complete")
        self._show(findings, entrant, engine)
        return 0

    def _add_noise(
        self, simulator: Simulator, conditions: InitialConditions, findings: Findings, track: Track
    ) -> None:
        """Attempts each lost condition with noise on the policy's actions."""
        count = len(findings.lost)
        levels = np.array(NOISE)[np.arange(self.attempts) * len(NOISE) // max(self.attempts, 1)]
        # A batch mixes all conditions, so that its objects fill the engine's buffers evenly.
        condition = np.tile(np.arange(count), self.attempts)
        offset = np.zeros((len(condition), len(PHASES), simulator.action_size), np.float32)
        trials = Trials(condition, offset, np.repeat(levels, count))
        if not self.attempts:
            return
        outcomes = simulator.run(conditions, trials, track("Noise", len(condition)))
        held = outcomes.held.reshape(self.attempts, count).sum(0)
        for one, times in zip(findings.lost, held, strict=True):
            one.noise_attempts = self.attempts
            one.noise_held = int(times)

    def _search(
        self, simulator: Simulator, conditions: InitialConditions, findings: Findings, track: Track
    ) -> Iterator[int]:
        """Searches for offsets that hold the open conditions; yields the number of each completed
        iteration.
        """
        rng = np.random.default_rng(self.seed)
        opened = findings.open()
        size = len(PHASES) * simulator.action_size
        search = ceiling_search.begin(len(opened), size, _FIRST_STD)
        advance = track("Search, iterations", self.iterations)
        for iteration in range(1, self.iterations + 1):
            if not len(opened):
                return
            drawn = ceiling_search.candidates(search, _POPULATION, rng)
            # Candidates of one condition are spread over the batches, as in `_add_noise`.
            flat = drawn.swapaxes(0, 1).reshape(-1, len(PHASES), simulator.action_size)
            trials = Trials(np.tile(opened, _POPULATION), flat, np.zeros(len(flat)))
            outcomes = simulator.run(conditions, trials)
            held = outcomes.held.reshape(_POPULATION, len(opened)).T
            total = outcomes.total.reshape(_POPULATION, len(opened)).T
            for index, times in zip(opened, held.sum(1), strict=True):
                findings.lost[index].search_attempts += _POPULATION
                findings.lost[index].search_held += int(times)
            search = ceiling_search.refined(search, drawn, total + _HELD_BONUS * held, _ELITES)
            remaining = ~held.any(1)
            search = search.rows(remaining)
            opened = opened[remaining]
            advance(iteration)
            yield iteration

    def _write(
        self,
        stage: str,
        findings: Findings,
        entrant: Entrant,
        experiment: Experiment,
        simulator: Simulator,
    ) -> None:
        """Writes what is done so far to the JSON file, if there is one."""
        if self.json is None:
            return
        command = shlex.join(["python", "-m", "tests.benchmarks", *sys.argv[1:]])
        objects = [one.to_json() for one in by_object(findings.episodes, findings.lost)]
        rows = [one.to_json() for one in by_row(findings.episodes, findings.lost)]
        conditions = []
        for one in findings.lost:
            conditions.append({**dataclasses.asdict(one), "reached": one.reached})
        about = {
            **provenance(),
            "command": command,
            "stage": stage,
            "policy": facts(entrant),
            "objects": f"procedural objects ({self.exam})",
            "exam": self.exam,
            "physics": experiment.physics,
            "batch": simulator.batch,
            "fullest_buffer": simulator.fullest,
            "seed": self.seed,
            "friction": experiment.friction,
            "noise": {"attempts": self.attempts, "std": NOISE},
            "search": {
                "iterations": self.iterations,
                "population": _POPULATION,
                "elites": _ELITES,
                "std": _FIRST_STD,
            },
            "repeat_held": sum(one.repeat_held for one in findings.lost),
            "total": findings.total().to_json(),
            "rows": rows,
            "by_object": objects,
            "lost": conditions,
        }
        write_atomically(self.json, (json.dumps(about, indent=1) + "\n").encode())

    def _show(self, findings: Findings, entrant: Entrant, engine: str) -> None:
        """Prints the lost conditions, the tables and the ceiling."""
        console = Console(highlight=False, width=None if sys.stdout.isatty() else 160)
        for one in findings.lost:
            when = "after" if one.success else "within"
            print(
                f"{one.row} {one.episode}, {one.object}: lost {when} 0.25 s; noise "
                f"{one.noise_held} of {one.noise_attempts}, search {one.search_held} of "
                f"{one.search_attempts}"
            )
        repeated = sum(one.repeat_held for one in findings.lost)
        print(f"Held when repeated unchanged: {repeated} of {len(findings.lost)} lost episodes.")
        losing = [one for one in by_object(findings.episodes, findings.lost) if one.lost]
        title = f"{entrant.file.name}, version {entrant.policy.version}, {engine_title(engine)}"
        console.print(table(f"{title}: objects with a loss", losing).terminal())
        rows = [*by_row(findings.episodes, findings.lost), findings.total()]
        console.print(table(f"{title}: all objects", rows).terminal())


def _examine(
    simulator: Simulator, experiment: Experiment, variation: Variation, findings: Findings
) -> None:
    """Simulates a row under the policy alone, and notes its lost conditions."""
    plan = experiment.plan(variation)
    bank = variation.bank(experiment)
    names = [obj.name for obj in experiment.objects]
    done = 0
    for begun, count in batches(
        experiment.hand, experiment.task, bank, plan, experiment.seed, simulator.batch
    ):
        outcomes = simulator.run(begun, simulator.unmodified(count))
        lost = np.flatnonzero(~outcomes.held)
        objects = [names[index] for index in plan.episodes.objects[done : done + count]]
        findings.episodes.extend((variation.constraint, name) for name in objects)
        for index in lost.tolist():
            success = bool(outcomes.success[index])
            one = Lost(variation.constraint, objects[index], done + index, success)
            findings.lost.append(one)
        findings.conditions.append(rows_of(begun, lost))
        done += count


def _repeat(simulator: Simulator, conditions: InitialConditions, findings: Findings) -> None:
    """Repeats the lost episodes unchanged, and notes those in which the object is now held."""
    outcomes = simulator.run(conditions, simulator.unmodified(len(findings.lost)))
    for one, held in zip(findings.lost, outcomes.held, strict=True):
        one.repeat_held = bool(held)


ceiling = Ceiling
"""Name of the command."""
