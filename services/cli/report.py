"""`congrasp report`: a policy's report and model card."""

import dataclasses
import pathlib
import shlex
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from congrasp.actors.physics import PhysicsName
from congrasp.common.errors import CongraspError
from congrasp.services.cli.console import in_range, tracked

if TYPE_CHECKING:
    from congrasp.common.policy.bundle import PolicyBundle
    from congrasp.services.evaluate.report import HandCheck

_DEFAULT_POOL = 64


@dataclasses.dataclass(frozen=True)
class Report:
    """Write an HTML report about a policy: its results next to those of the paper, its failures and
    successes, and its training.

    The command evaluates the policy by the paper's protocol, and draws some of the episodes. With
    200 episodes per row this takes some minutes on a CPU. For a quick report pass --episodes 16.

    Examples:
      congrasp report runs/mine --episodes 16
      congrasp report --hand allegro --objects my-objects --out allegro.html
    """

    source: Annotated[pathlib.Path | None, tyro.conf.Positional] = None
    """Folder of a run, or a policy file; by default the pretrained policy of --hand."""
    out: pathlib.Path = pathlib.Path("report.html")
    """The HTML file to write."""
    objects: pathlib.Path | None = None
    """Objects to grasp, as for 'congrasp evaluate'; by default held-out procedural objects."""
    episodes: int = 200
    """Number of episodes per row."""
    physics: PhysicsName = "auto"
    """Engine; auto takes warp on an NVIDIA GPU and native (MuJoCo C) on a CPU."""
    pool: int = _DEFAULT_POOL
    """Number of procedural objects."""
    seed: int = 0
    """Seed of constraints and episodes."""
    hand: str = "human"
    """Hand of the pretrained policy."""
    json: Annotated[pathlib.Path | None, tyro.conf.arg(name="json")] = None
    """Also write the rows to this JSON file."""
    check: pathlib.Path | None = None
    """File of 'congrasp hands check --json' to include in the report. The picture of --png must be
    next to it under the same name.
    """

    def __call__(self) -> int:
        """Evaluates, and writes the report."""
        from congrasp.actors.physics import resolve_physics
        from congrasp.common.policy import bundle as bundles
        from congrasp.common.policy.pretrained import policy_file
        from congrasp.services.assets.objects.named import objects_of
        from congrasp.services.evaluate.exams import exam_pool
        from congrasp.services.evaluate.experiment import Experiment
        from congrasp.services.evaluate.report import report_on
        from congrasp.services.evaluate.scores import write_json
        from congrasp.services.train.background import training_seconds

        in_range(1, episodes=self.episodes, pool=self.pool)
        run_dir = None
        if self.source is not None and self.source.is_dir():
            run_dir = self.source
        file = _policy_of_run(run_dir) if run_dir else policy_file(self.source, self.hand)
        hand_check = _hand_check(self.check) if self.check is not None else None
        with tracked() as track:
            bundle = bundles.load(file)
            if self.objects:
                objects = objects_of(self.objects, track=track)
            else:
                objects = exam_pool("figures", self.pool)
            experiment = Experiment(
                bundle,
                objects,
                episodes=self.episodes,
                physics=resolve_physics(self.physics),
                seed=self.seed,
                track=track,
            )
            evaluation = report_on(
                experiment,
                file.name,
                self.out,
                subject=self._subject(file),
                objects=self.objects,
                run_dir=run_dir,
                check=hand_check,
            )
        if self.json is not None:
            about = {**self._about(file, bundle), "physics": experiment.physics}
            if run_dir is not None:
                about["training_seconds"] = training_seconds(run_dir)
            write_json(evaluation.rows, self.json, about)
        for error in evaluation.left_out:
            print(f"Left out: {error}")
        print(f"The report is in {self.out}: open it in a browser.")
        return 0

    def _about(self, file: pathlib.Path, bundle: "PolicyBundle") -> dict[str, Any]:
        """Provenance, policy, hand and settings, for the JSON file."""
        from congrasp.common.hands import get_hand
        from congrasp.common.hands.files import hand_sha256
        from congrasp.common.policy import bundle as bundles
        from congrasp.services.evaluate.results import provenance

        hand = get_hand(bundle.spec.hand)
        return {
            **provenance(),
            "policy": str(file),
            "content": bundles.content_hash(file.read_bytes()),
            "transitions": bundle.transitions,
            "hand": hand.name,
            "hand_sha256": hand_sha256(hand),
            "episodes": self.episodes,
            "pool": self.pool,
            "seed": self.seed,
        }

    def _subject(self, file: pathlib.Path) -> str:
        """Options of 'congrasp evaluate' that select the policy."""
        if self.source:
            return f"--policy {shlex.quote(str(file))}"
        return f"--hand {self.hand}"


def _hand_check(file: pathlib.Path) -> "HandCheck":
    """Returns the self-check of a file, with its picture."""
    from congrasp.services.assets.hands.findings import read_findings
    from congrasp.services.evaluate.report import HandCheck

    picture = file.with_suffix(".png")
    if not picture.is_file():
        raise CongraspError(
            f"There is no picture {picture}.", "Create it with 'congrasp hands check --png'."
        )
    return HandCheck(read_findings(file), picture.read_bytes())


def _policy_of_run(run_dir: pathlib.Path) -> pathlib.Path:
    """Returns the policy file of a run's folder; raises a CongraspError if it has none."""
    from congrasp.learner.run_directory import POLICY_FILE

    if not (run_dir / POLICY_FILE).is_file():
        raise CongraspError(
            f"The folder {run_dir} holds no {POLICY_FILE}.",
            "Pass a run's folder, or a policy file.",
        )
    return run_dir / POLICY_FILE


COMMAND = Report
