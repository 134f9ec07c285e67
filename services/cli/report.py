"""`congrasp report`: a policy's report and model card."""

import pathlib
from typing import TYPE_CHECKING, Annotated

import tyro

from congrasp.actors.physics import PhysicsName
from congrasp.common.errors import CongraspError

if TYPE_CHECKING:
    from congrasp.services.evaluate.report import HandCheck

_POOL = 64


def report(
    source: Annotated[pathlib.Path | None, tyro.conf.Positional] = None,
    out: pathlib.Path = pathlib.Path("report.html"),
    objects: pathlib.Path | None = None,
    episodes: int = 200,
    physics: PhysicsName = "auto",
    pool: int = _POOL,
    seed: int = 0,
    hand: str = "human",
    json: Annotated[pathlib.Path | None, tyro.conf.arg(name="json")] = None,
    check: pathlib.Path | None = None,
) -> int:
    """Write one HTML file about a policy: results and those of the paper, failures and successes, and its training.

    It evaluates the policy by the paper's protocol first, and draws some of these episodes. With 200 episodes per row
    that takes some minutes on a CPU; for a quick look pass --episodes 16.

    Args:
      source: A run's folder or a policy file; by default a pretrained policy.
      out: The file to write.
      objects: Objects to grasp, as for 'congrasp evaluate'; held-out procedural ones by default.
      episodes: Episodes in each row.
      physics: Engine; auto takes warp on an NVIDIA GPU and native (MuJoCo C) on a CPU.
      pool: Number of procedural objects.
      seed: Seed of constraints and episodes.
      hand: Hand of the pretrained policy.
      json: Also write the rows to this file.
      check: A file of 'congrasp hands check --json' to include in the report, with its --png of the same name.

    Examples:
      congrasp report runs/mine --episodes 16
      congrasp report --hand allegro --objects my-objects --out allegro.html
    """
    from congrasp.actors.physics import resolve_physics
    from congrasp.common.policy import bundle as bundles
    from congrasp.common.policy.pretrained import policy_file
    from congrasp.services.assets.objects.named import objects_of
    from congrasp.services.cli.console import at_least, tracked
    from congrasp.services.evaluate.experiment import Experiment
    from congrasp.services.evaluate.pools import exam_pool
    from congrasp.services.evaluate.report import report_on
    from congrasp.services.evaluate.scores import write_json

    at_least(1, episodes=episodes, pool=pool)
    if out.is_dir():
        raise CongraspError(f"--out is the folder {out}.", f"Pass a file in it: --out {out / 'report.html'}")
    run_dir = source if source is not None and source.is_dir() else None
    file = _policy_of_run(run_dir) if run_dir else policy_file(source, hand)
    checked = None if check is None else _checked(check)
    with tracked() as track:
        made = report_on(
            Experiment(
                bundles.load(file),
                objects_of(objects, track=track) if objects else exam_pool("figures", pool),
                episodes=episodes,
                physics=resolve_physics(physics),
                seed=seed,
                track=track,
            ),
            file.name,
            out,
            subject=f"--policy {file}" if source else f"--hand {hand}",
            objects=objects,
            run_dir=run_dir,
            check=checked,
        )
    if json is not None:
        about = {
            "policy": str(file),
            "content": bundles.content_hash(file.read_bytes()),
            "episodes": episodes,
            "pool": pool,
        }
        write_json(made.rows, json, {**about, "seed": seed})
    for error in made.left_out:
        print(f"Left out: {error}")
    print(f"The report is in {out}: open it in a browser.")
    return 0


def _checked(file: pathlib.Path) -> "HandCheck":
    """Returns the self-check of a file, with its picture."""
    from congrasp.services.assets.hands.check import read_findings
    from congrasp.services.evaluate.report import HandCheck

    picture = file.with_suffix(".png")
    if not picture.is_file():
        raise CongraspError(f"There is no picture {picture}.", "Create it with 'congrasp hands check --png'.")
    return HandCheck(read_findings(file), picture.read_bytes())


def _policy_of_run(run_dir: pathlib.Path) -> pathlib.Path:
    """Returns the policy file of a run's folder; raises a CongraspError if it has none."""
    from congrasp.learner.run_directory import POLICY_FILE

    if not (run_dir / POLICY_FILE).is_file():
        raise CongraspError(f"The folder {run_dir} holds no {POLICY_FILE}.", "Pass a run's folder, or a policy file.")
    return run_dir / POLICY_FILE


COMMAND = report
