"""`congrasp evaluate`: policies by the paper's protocol."""

import dataclasses
import pathlib
import shutil
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console

from congrasp.actors.physics import PhysicsName, resolve_physics
from congrasp.common.config import Split
from congrasp.common.errors import CongraspError, need_package
from congrasp.common.runtime.engines import engine_title
from congrasp.services.cli.console import in_range, say, tracked
from congrasp.services.evaluate.choices import Exam, Table

if TYPE_CHECKING:
    from congrasp.common.objects.spec import GraspObject
    from congrasp.services.evaluate.experiment import Experiment, Track
    from congrasp.services.evaluate.lineup import Entrant, Lineup
    from congrasp.services.evaluate.pools import PoolLoaders
    from congrasp.services.evaluate.scores import Row
    from congrasp.services.evaluate.tables import Evaluation

_PICTURES_OF_EACH_KIND = 4
"""Most failures, and most successes, drawn for a row."""
_PIPE_WIDTH = 160
"""Width of tables that are not printed to a terminal, characters."""


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Evaluate policies by the paper's protocol, with the paper's figures for comparison.

    An episode has as many control steps with the table as the policy was trained with, and then 2 s
    without the table. It is a success if the object is held for the paper's 25 steps without the
    table, and counts as held if it is held for the 2 s. Rates have 95 % confidence intervals, with
    objects (or captured sequences) as clusters. The column 'of all objects' counts objects on which
    the constraint is impossible as failures. Errors and forces are means over the successful
    episodes, in the paper's window of 25 steps. The policy acts with the mean of its action
    distribution. Within a row, every object has the same number of episodes; they do not depend on
    the other requested rows. Reference poses and trajectories are at most 20 grasps per object of a
    reference policy, which was trained without reference poses and trajectories.

    Examples:
      congrasp evaluate --table single composed --episodes 200
      congrasp evaluate --policy runs/mine/policy.safetensors --json evaluation.json
    """

    policy: tuple[str, ...] = ()
    """Policy files (policy.safetensors of a run), as FILE or METHOD=FILE, or folders of runs; by
    default the pretrained policy of --hand."""
    table: tuple[Table, ...] = ("single",)
    """Tables to compute, one or several. single: one constraint per row; composed: two constraints
    per row; cross: the rows of the paper's cross-dataset table; hands: single constraints for all
    hands with a pretrained policy, or for the hands of --policy; ablation: the full system and
    variants without one of its components, which need a policy each in --policy; objects: the
    heading alone on any number of objects, by size, mass and family; noise: poses and trajectories
    with errors as in captured data; sensing: a student and the pretrained policy under the heading
    alone, with object poses from a tracker, by noise, delay, rate and losses of the poses, by
    friction, by errors of the servo gains and by latency of the targets; payload: the heading alone
    by the objects' mass, from 0.05 to 2 kg; peers: the heading alone at the masses and frictions of
    RobustDexGrasp and of Isaac Lab's dexsuite; all: every table of one policy."""
    exam: Exam = "figures"
    """Set of procedural test objects, of all families. figures has seeds from 2,000,000 and is for
    published figures only; development has seeds from 1,000,000. Training uses neither."""
    objects: pathlib.Path | None = None
    """Folder of objects or meshes to grasp instead of the procedural objects, as for 'congrasp
    objects import'."""
    constraints: pathlib.Path | None = None
    """Folder of constraint sets of --objects, from 'congrasp constraints generate' or 'import'. Its
    references replace those of the reference policy. Objects without a set are left out."""
    split: Split = "all"
    """Part of the constraint sets: all constraints, the 80 % for training, or the held-out ones.
    Objects without a heading in this part are left out. Rows of poses and trajectories cover the
    objects that have a pose or a trajectory in it."""
    episodes: int = 1000
    """Number of episodes per row; for the table 'objects', the total number."""
    physics: PhysicsName = "auto"
    """Physics engine; auto takes warp on an NVIDIA GPU and native (MuJoCo C) on a CPU."""
    reference_physics: PhysicsName = "auto"
    """Physics engine of the reference policy's grasps; auto takes that of --physics. To compare
    engines on the same episodes, pass the same reference engine to each evaluation."""
    pool: int = 0
    """Number of procedural objects. 0 uses one object of each family, and for the table 'objects'
    one object per episode, at most 50,000."""
    batch: int = 0
    """Number of environments that are simulated in parallel; 0 uses the engine's default."""
    seed: int = 0
    """Seed of constraints and episodes."""
    json: Annotated[pathlib.Path | None, tyro.conf.arg(name="json")] = None
    """Also write the rows to this JSON file. A stopped evaluation resumes from the rows in
    FILE.parts, unless --pictures is set."""
    pictures: pathlib.Path | None = None
    """Folder for pictures of failures, with their causes, and of successes under every
    constraint."""
    hand: str = "human"
    """Hand of the pretrained policy."""
    method: str | None = None
    """Method to evaluate: ours, pd (no learning: PD control along the guidance), graspxl, dgrasp,
    no-dynamic-center, no-feedforward, two-phase, single-stage, student or camera. A policy of
    another method is refused. By default the method of the policy."""
    by: Literal["object"] | None = None
    """object: also print the rates of each object. The file of --json always contains them."""
    friction: float = 1.0
    """Sliding friction between hand and object. The published code of GraspXL, the paper's
    predecessor, uses 3.
    """

    def __call__(self) -> int:
        """Evaluates, and prints and writes the results."""
        from congrasp.services.evaluate.lineup import line_up, read_entrants
        from congrasp.services.evaluate.tables import evaluate_tables

        self._check()
        entrants = read_entrants(self.policy, self.method)
        lineup = line_up(self.table, entrants, self.hand, self.method)
        engine = resolve_physics(self.physics)
        if self.reference_physics != "auto":
            resolve_physics(self.reference_physics)
        many_objects = self._many_objects(engine)
        with tracked() as track:
            experiment, without_set = self._experiment(lineup, engine, track)
            evaluations = []
            for entrant, requested in lineup.entrants:
                evaluations.append(
                    evaluate_tables(
                        dataclasses.replace(experiment, policy=entrant.policy),
                        requested,
                        many_objects,
                        self._folder_of_rows(entrant),
                        keep=self.pictures is not None,
                    )
                )
        self._print(evaluations, lineup, engine)
        if without_set:
            print(
                "Left out: objects without a constraint set, or without a heading in the split "
                f"'{self.split}': "
                f"{', '.join(without_set)}."
            )
        if self.json is not None:
            self._write(self.json, evaluations, lineup, engine)
            shutil.rmtree(_partial_results(self.json), ignore_errors=True)
        if self.pictures is not None:
            self._draw(self.pictures, evaluations, lineup)
        return 0

    def _check(self) -> None:
        """Raises a CongraspError if an option is out of range, or needs another one."""
        in_range(1, episodes=self.episodes)
        in_range(0, pool=self.pool, batch=self.batch)
        in_range(0.05, 10.0, friction=self.friction)
        if self.pictures is not None and {"noise", "all"} & set(self.table):
            need_package("--pictures", "matplotlib")
        if self.constraints is not None and not self.objects:
            raise CongraspError(
                "--constraints needs the objects of the constraint sets.",
                "Pass the objects' folder with --objects.",
            )

    def _many_objects(self, engine: PhysicsName) -> "PoolLoaders | None":
        """Returns the pools of the table `objects`; None if it is not requested."""
        from congrasp.services.evaluate import exams, pools

        if not {"objects", "all"} & set(self.table):
            return None
        if self.objects:
            return pools.folder_pools(self.objects, engine)
        count = self.pool or min(self.episodes, exams.MANY)
        return pools.procedural_pools(count, engine, self.exam)

    def _experiment(
        self, lineup: "Lineup", engine: PhysicsName, track: "Track"
    ) -> "tuple[Experiment, list[str]]":
        """Returns the experiment of the first policy, and names of objects without a constraint
        set.
        """
        from congrasp.services.evaluate.captured import captured_objects
        from congrasp.services.evaluate.experiment import Experiment

        objects: list[GraspObject] = []
        if self.constraints is not None or set(self.table) != {"objects"}:
            objects = self._objects(track)
        first, _ = lineup.entrants[0]
        experiment = Experiment(
            first.policy,
            objects,
            episodes=self.episodes,
            track=track,
            **self._settings(engine),
        )
        if self.constraints is None:
            return experiment, []
        captured = captured_objects(self.constraints, self.split, objects)
        lineup.require(captured.hand)
        without_set = {obj.name for obj in objects} - {obj.name for obj in captured.objects}
        experiment = dataclasses.replace(
            experiment,
            objects=captured.objects,
            constraints=captured.bank,
            paper=captured.paper,
        )
        return experiment, sorted(without_set)

    def _objects(self, track: "Track") -> "list[GraspObject]":
        """Returns the objects of all tables but `objects`."""
        from congrasp.services.assets.objects.named import objects_of
        from congrasp.services.evaluate.exams import exam_pool

        if self.objects:
            return objects_of(self.objects, track=track)
        return exam_pool(self.exam, self.pool)

    def _folder_of_rows(self, entrant: "Entrant") -> pathlib.Path | None:
        """Folder for a policy's rows, from which a stopped evaluation resumes."""
        if self.json is None:
            return None
        return _partial_results(self.json) / f"{entrant.hand}-{entrant.method}"

    def _settings(self, engine: PhysicsName) -> dict[str, Any]:
        """Settings of all episodes."""
        reference_engine = engine
        if self.reference_physics != "auto":
            reference_engine = self.reference_physics
        return {
            "physics": engine,
            "reference_physics": reference_engine,
            "batch": self.batch,
            "seed": self.seed,
            "friction": self.friction,
        }

    def _print(
        self, evaluations: "Sequence[Evaluation]", lineup: "Lineup", engine: PhysicsName
    ) -> None:
        """Prints the tables, the effect of the rules for headings, the references' source, and
        skipped rows.
        """
        from congrasp.services.evaluate.columns import object_table, tables_of

        width = None if sys.stdout.isatty() else _PIPE_WIDTH
        console = Console(highlight=False, markup=False, width=width)
        rows = _rows(evaluations)
        title = (
            f"{lineup.title}, on {lineup.objects(self.objects, self.exam)}, "
            f"{engine_title(engine)}, friction {self.friction:g}"
        )
        printed_tables = tables_of(rows, title, lineup.missing)
        if self.by == "object":
            printed_tables.append(object_table(rows))
        for table in printed_tables:
            console.print(table.terminal())
        for (entrant, _), evaluation in zip(lineup.entrants, evaluations, strict=True):
            if evaluation.heading_rules:
                say(evaluation.heading_rules.sentence(entrant.hand))
        references = [evaluation.references for evaluation in evaluations]
        say(*dict.fromkeys(filter(None, references)))
        left_out = []
        for evaluation in evaluations:
            left_out += [f"Left out: {error}" for error in evaluation.left_out]
        say(*dict.fromkeys(left_out))

    def _write(
        self,
        file: pathlib.Path,
        evaluations: "Sequence[Evaluation]",
        lineup: "Lineup",
        engine: PhysicsName,
    ) -> None:
        """Writes the rows, with policies, settings and provenance, to a JSON file."""
        from congrasp.services.evaluate.lineup import facts
        from congrasp.services.evaluate.results import provenance
        from congrasp.services.evaluate.scores import write_json

        policies = [facts(entrant) for entrant, _ in lineup.entrants]
        heading_rules = {}
        for (entrant, _), evaluation in zip(lineup.entrants, evaluations, strict=True):
            if evaluation.heading_rules:
                heading_rules[entrant.hand] = dataclasses.asdict(evaluation.heading_rules)
        about = {
            **provenance(),
            "policy": policies[0],
            "policies": policies,
            "missing": [missing._asdict() for missing in lineup.missing],
            "headings": lineup.entrants[0][0].policy.task.headings,
            "heading_rules": heading_rules,
            "objects": lineup.objects(self.objects, self.exam),
            "exam": None if self.objects else self.exam,
            "constraints": str(self.constraints) if self.constraints else None,
            "split": self.split if self.constraints else None,
            **self._settings(engine),
        }
        write_json(_rows(evaluations), file, about)

    def _draw(
        self, folder: pathlib.Path, evaluations: "Sequence[Evaluation]", lineup: "Lineup"
    ) -> None:
        """Draws the episodes of each policy, of several into a folder each."""
        for (entrant, _), evaluation in zip(lineup.entrants, evaluations, strict=True):
            policy_folder = folder
            if len(evaluations) > 1:
                policy_folder = folder / f"{entrant.hand}-{entrant.method}"
            _draw_evaluation(evaluation, policy_folder)


def _partial_results(file: pathlib.Path) -> pathlib.Path:
    """Folder of the rows of an unfinished evaluation that writes a JSON file."""
    return file.with_name(f"{file.name}.parts")


def _rows(evaluations: "Sequence[Evaluation]") -> "list[Row]":
    """The rows of all policies."""
    rows = []
    for evaluation in evaluations:
        rows += evaluation.rows
    return rows


def _draw_evaluation(evaluation: "Evaluation", folder: pathlib.Path) -> None:
    """Draws curves and examples of noisy references, and episodes of the rows without a change."""
    from congrasp.services.evaluate.experiment import Variation
    from congrasp.services.evaluate.pictures import failure_sheets, save_noise_examples
    from congrasp.services.evaluate.plots import draw_noise
    from congrasp.services.evaluate.variations import Noise
    from congrasp.services.viz.sheets import save_png

    experiment = evaluation.experiment
    policy = experiment.policy
    noisy = evaluation.of(Noise)
    if noisy:
        title = (
            f"{policy.spec.hand_name} hand, version {policy.version}: {experiment.episodes} "
            f"episodes a level"
        )
        draw_noise([result.row for result in noisy], folder / "noise.png", title)
        save_noise_examples(noisy, folder / "noise_examples.png")
        print(f"Curves and examples of noisy references are drawn in {folder}.")
    sheets = failure_sheets(
        experiment, evaluation.of(Variation), _PICTURES_OF_EACH_KIND, _PICTURES_OF_EACH_KIND
    )
    for name, sheet, _ in sheets:
        save_png(folder / f"{name}.png", sheet)
        print(f"Episodes of '{name}' are drawn in {folder}.")


COMMAND = Evaluate
