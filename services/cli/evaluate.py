"""`congrasp evaluate`: policies by the paper's protocol."""

import dataclasses
import pathlib
import shutil
import sys
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from congrasp.actors.physics import PhysicsName, resolve_physics
from congrasp.common.config import Split
from congrasp.common.errors import CongraspError, need_package
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.engines import engine_title
from congrasp.services.assets.objects import named
from congrasp.services.cli.console import in_range, say, tracked
from congrasp.services.evaluate import pools, tables
from congrasp.services.evaluate.experiment import Experiment, Variation
from congrasp.services.evaluate.lineup import Lineup, Table, facts, line_up, read_entrants
from congrasp.services.evaluate.results import provenance
from congrasp.services.evaluate.scores import Row, write_json
from congrasp.services.evaluate.table import object_table, tables_of
from congrasp.services.viz.sheets import save_png

_PICTURED = 4


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Evaluate policies by the paper's protocol, with the paper's figures for comparison.

    An episode has as many control steps with the table as the policy was trained with, and 2 s
    without it. Success is counted after the paper's 25 steps without the table, and again after the
    2 s (held). Rates come with 95 % intervals whose clusters are objects (captured sequences); 'of
    all objects' counts uncovered objects as failures. Errors and forces are those of successful
    episodes in the paper's window of 25 steps. The policy acts with its mean. Every object has the
    same number of episodes in a row, independent of other requested rows. Reference poses and
    trajectories are grasps of a reference policy trained without any, at most 20 of each object.

    Examples:
      congrasp evaluate --table single composed --episodes 200
      congrasp evaluate --policy runs/mine/policy.safetensors --json evaluation.json
    """

    policy: tuple[str, ...] = ()
    """Policy files (policy.safetensors of a run), as FILE or METHOD=FILE, or folders of runs; by
    default a pretrained one."""
    table: tuple[Table, ...] = ("single",)
    """single: one constraint a row; composed: two; cross: the rows of the paper's cross-dataset
    table; hands: single constraints for all hands with a pretrained policy, or those of --policy;
    ablation: the full system and variants without one of its parts, if --policy has policies of
    them; objects: the heading alone on any number of objects, by size, mass and family; noise:
    poses and trajectories with errors like captured ones; sensing: the heading alone with a
    tracker's object poses, by their noise, delay, rate and losses, by friction, by errors of gains
    and by late targets, a student and the pretrained policy; payload: the heading alone by the
    objects' mass, from 0.05 to 2 kg; peers: the heading alone at the masses and frictions of
    RobustDexGrasp and of Isaac Lab's dexsuite; all: every table of one policy. Several may be
    named."""
    exam: pools.Exam = "figures"
    """Procedural objects of all families: figures has seeds from 2,000,000, to be used only for
    published figures; development has seeds from 1,000,000. Training uses neither."""
    objects: pathlib.Path | None = None
    """Objects to grasp instead: a folder accepted or created by 'congrasp objects import'."""
    constraints: pathlib.Path | None = None
    """Folder of constraint sets of these objects, from 'congrasp constraints generate' or 'import';
    its references are used instead of the reference policy's. Objects without a set are left
    out."""
    split: Split = "all"
    """Split of these sets: all constraints, the 80 % for training, or the held-out ones. Objects
    without a heading in the split are left out, and rows of poses and trajectories cover the
    objects that have one in the split."""
    episodes: int = 1000
    """Episodes of each row; for the table 'objects', the total."""
    physics: PhysicsName = "auto"
    """Engine; auto takes warp on an NVIDIA GPU and native (MuJoCo C) on a CPU."""
    pool: int = 0
    """Number of procedural objects; 0 uses one of each family, and for the table 'objects' one per
    episode, at most 50,000."""
    batch: int = 0
    """Number of parallel worlds; 0 uses the engine's default."""
    seed: int = 0
    """Seed of constraints and episodes."""
    json: Annotated[pathlib.Path | None, tyro.conf.arg(name="json")] = None
    """Also write the rows to this file. A stopped evaluation resumes from the rows in FILE.parts,
    unless it also draws --pictures."""
    pictures: pathlib.Path | None = None
    """Also draw failures, with their causes, and successes of every constraint into this folder."""
    hand: str = "human"
    """Hand of the pretrained policy."""
    method: str | None = None
    """ours, pd (no learning: PD control along the guidance), graspxl, dgrasp, no-dynamic-center,
    no-feedforward, two-phase, single-stage, student or camera. A policy of another method is
    refused; default: that of the policy."""
    by: Literal["object"] | None = None
    """object: also print the rates of each object; --json always has them."""
    friction: float = 1.0
    """Sliding friction between hand and object. The published code of the paper's predecessor
    (GraspXL) simulates 3.
    """

    def __call__(self) -> int:  # noqa: C901
        """Evaluates, and prints and writes the results."""
        in_range(1, episodes=self.episodes)
        in_range(0, pool=self.pool, batch=self.batch)
        in_range(0.05, 10.0, friction=self.friction)
        lineup = line_up(
            self.table, read_entrants(self.policy, self.method), self.hand, self.method
        )
        if self.pictures is not None and {"noise", "all"} & set(self.table):
            need_package("--pictures", "matplotlib")
        if self.constraints is not None and not self.objects:
            raise CongraspError(
                "--constraints needs the sets' objects.", "Pass their folder with --objects."
            )
        engine = resolve_physics(self.physics)
        kept = self.json and self.json.with_name(f"{self.json.name}.parts")
        divided = None
        if {"objects", "all"} & set(self.table):
            many = self.pool or min(self.episodes, pools.MANY)
            if self.objects:
                divided = pools.folder_pools(self.objects, engine)
            else:
                divided = pools.procedural_pools(many, engine, self.exam)
        without: list[str] = []
        with tracked() as track:
            given: list[GraspObject] = []
            if self.constraints is not None or set(self.table) != {"objects"}:
                if self.objects:
                    given = named.objects_of(self.objects, track=track)
                else:
                    given = pools.exam_pool(self.exam, self.pool)
            experiment = Experiment(
                lineup.entrants[0][0].policy,
                given,
                episodes=self.episodes,
                track=track,
                **self._settings(engine),
            )
            if self.constraints is not None:
                sets = tables.captured(self.constraints, self.split, given)
                lineup.require(sets.hand)
                without = sorted({obj.name for obj in given} - {obj.name for obj in sets.objects})
                experiment = dataclasses.replace(
                    experiment, objects=sets.objects, constraints=sets.bank, paper=sets.paper
                )
            results = []
            for one, wanted in lineup.entrants:
                own = dataclasses.replace(experiment, policy=one.policy)
                folder = kept and kept / f"{one.hand}-{one.method}"
                results.append(
                    tables.evaluate_tables(
                        own, wanted, divided, folder, keep=self.pictures is not None
                    )
                )
        self._show(results, lineup, engine)
        if without:
            words = f"objects without a constraint set, or a heading in it ({self.split})"
            print(f"Left out: {words}: {', '.join(without)}.")
        if self.json and kept:
            self._write(results, lineup, engine)
            shutil.rmtree(kept, ignore_errors=True)
        if self.pictures is not None:
            for (one, _), found in zip(lineup.entrants, results, strict=True):
                _draw(
                    found,
                    self.pictures
                    if len(results) == 1
                    else self.pictures / f"{one.hand}-{one.method}",
                )
        return 0

    def _settings(self, engine: str) -> dict[str, Any]:
        """Settings of all episodes."""
        return {
            "physics": engine,
            "batch": self.batch,
            "seed": self.seed,
            "friction": self.friction,
        }

    def _show(self, results: Sequence[tables.Found], lineup: Lineup, engine: str) -> None:
        """Prints the tables, the effect of the rules for headings, the references' source, and
        skipped rows.
        """
        console, rows = (
            Console(highlight=False, markup=False, width=None if sys.stdout.isatty() else 160),
            _rows(results),
        )
        where = (
            f"{lineup.objects(self.objects, self.exam)}, {engine_title(engine)}, friction "
            f"{self.friction:g}"
        )
        what = f"{lineup.title}, on {where}"
        for shown in tables_of(rows, what, lineup.missing) + (
            [object_table(rows)] if self.by == "object" else []
        ):
            console.print(shown.terminal())
        for (one, _), found in zip(lineup.entrants, results, strict=True):
            if found.heading_rules:
                say(found.heading_rules.sentence(one.hand))
        say(*dict.fromkeys(found.references for found in results if found.references))
        say(*dict.fromkeys(f"Left out: {error}" for found in results for error in found.left_out))

    def _write(self, results: Sequence[tables.Found], lineup: Lineup, engine: str) -> None:
        """Writes the rows, with policies, settings and provenance, to the JSON file."""
        policies = [facts(one) for one, _ in lineup.entrants]
        rules = {
            one.hand: dataclasses.asdict(found.heading_rules)
            for (one, _), found in zip(lineup.entrants, results, strict=True)
            if found.heading_rules
        }
        about = {
            **provenance(),
            "policy": policies[0],
            "policies": policies,
            "missing": [one._asdict() for one in lineup.missing],
            "headings": lineup.entrants[0][0].policy.task.headings,
            "heading_rules": rules,
            "objects": lineup.objects(self.objects, self.exam),
            "exam": None if self.objects else self.exam,
            "constraints": str(self.constraints) if self.constraints else None,
            "split": self.split if self.constraints else None,
            **self._settings(engine),
        }
        assert self.json is not None
        write_json(_rows(results), self.json, about)


def _rows(results: Sequence[tables.Found]) -> list[Row]:
    """The rows of all policies."""
    return [row for found in results for row in found.rows]


def _draw(found: tables.Found, pictures: pathlib.Path) -> None:
    """Draws curves and examples of noisy references, and episodes of the rows without a change."""
    from congrasp.services.evaluate.pictures import failure_sheets, save_noise_examples
    from congrasp.services.evaluate.plots import draw_noise

    policy = found.experiment.policy
    if noisy := found.of(tables.Noise):
        who = f"{policy.spec.hand_name} hand, version {policy.version}"
        title = f"{who}: {found.experiment.episodes} episodes a level"
        draw_noise([result.row for result in noisy], pictures / "noise.png", title)
        save_noise_examples(noisy, pictures / "noise_examples.png")
        print(f"Curves and examples of noisy references are drawn in {pictures}.")
    for name, sheet, _ in failure_sheets(
        found.experiment, found.of(Variation), _PICTURED, _PICTURED
    ):
        save_png(pictures / f"{name}.png", sheet)
        print(f"Episodes of '{name}' are drawn in {pictures}.")


COMMAND = Evaluate
