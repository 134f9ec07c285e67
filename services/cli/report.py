"""`congrasp report`: a policy's report and model card."""

import pathlib
from typing import Annotated

import tyro

from actors.physics import PhysicsName
from common.errors import CongraspError

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
) -> int:
    """Write one HTML file about a policy: results beside the paper's, failed and successful episodes, and its training.

    It evaluates the policy by the paper's protocol first, and draws some of those very episodes. With 200 episodes a
    row that takes some minutes on a CPU; a first look: --episodes 16.

    Examples: congrasp report runs/mine; congrasp report --hand allegro --objects my-objects --out allegro.html

    Args:
      source: A run's folder or a policy file; by default a pretrained policy.
      out: The file to write.
      objects: Objects to grasp, as 'congrasp evaluate' takes them; held-out procedural ones by default.
      episodes: Episodes in each row.
      physics: Engine; auto takes warp on an NVIDIA GPU and native (MuJoCo C) on a CPU.
      pool: Number of procedural objects.
      seed: Seed of constraints and episodes.
      hand: Whose pretrained policy.
    """
    from common.policy.pretrained import policy_file
    from services.cli.console import at_least, tracked
    from services.evaluate.reporting import report_on

    at_least(1, episodes=episodes, pool=pool)
    if out.is_dir():
        raise CongraspError(f"--out is the folder {out}.", f"Name a file in it: --out {out / 'report.html'}")
    run_dir = source if source is not None and source.is_dir() else None
    file = _policy_of_run(run_dir) if run_dir else policy_file(source, hand)
    with tracked() as track:
        made = report_on(
            file,
            out,
            subject=f"--policy {file}" if source else f"--hand {hand}",
            episodes=episodes,
            pool=pool,
            physics=physics,
            seed=seed,
            objects=objects,
            run_dir=run_dir,
            track=track,
        )
    for error in made.left_out:
        print(f"Left out: {error}")
    print(f"The report is in {out}: open it in a browser.")
    return 0


def _policy_of_run(run_dir: pathlib.Path) -> pathlib.Path:
    """The policy file of a run's folder; a CongraspError if it has none."""
    from learner.run_directory import POLICY_FILE

    if not (run_dir / POLICY_FILE).is_file():
        raise CongraspError(f"The folder {run_dir} holds no {POLICY_FILE}.", "Name a run's folder, or a policy file.")
    return run_dir / POLICY_FILE


COMMAND = report
