"""`congrasp report`: a policy's report and model card."""

import pathlib
from typing import Annotated

import tyro

from actors.physics import PhysicsName
from common.errors import CongraspError

_POOL = 64
_PICTURED = 4


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
    from actors.physics import resolve_physics
    from common.config import ObjectsConfig
    from common.objects.pool import HELD_OUT_SEED, load_pool
    from common.parallel import cores
    from common.policy import bundle as bundles
    from common.policy.pretrained import policy_file
    from services.assets.objects.named import objects_of
    from services.cli.console import at_least, tracked
    from services.evaluate.evaluator import Evaluator
    from services.evaluate.failures import failure_sheets
    from services.evaluate.protocol import objects_label, two_seconds
    from services.evaluate.report import Commands, Picture, count_causes, curves_of, template, write_report
    from services.evaluate.scores import TABLES, known_rows
    from services.viz.sheets import png_of

    at_least(1, episodes=episodes, pool=pool)
    if out.is_dir():
        raise CongraspError(f"--out is the folder {out}.", f"Name a file in it: --out {out / 'report.html'}")
    template()  # fails before the evaluation if a package is missing
    run_dir = source if source is not None and source.is_dir() else None
    file = _policy_of_run(run_dir) if run_dir else policy_file(source, hand)
    policy, engine = bundles.load(file), resolve_physics(physics)
    names = known_rows(TABLES, policy.task)
    with tracked() as track:
        curves = list(curves_of(run_dir)) if run_dir else []
        given = (
            objects_of(objects, track=track) if objects else load_pool(ObjectsConfig(count=pool, seed=HELD_OUT_SEED))
        )
        track("Making constraints", None)
        held, threads = two_seconds(policy.task), cores()
        evaluator = Evaluator(policy, given, physics=engine, threads=threads, seed=seed, hold_steps=held)
        names, left_out = evaluator.allowed(names)
        rows = evaluator.rows(names, episodes, track("Episodes", len(names) * episodes), keep=True)
        advance = track("Pictures", len(names))
        sheets = []
        for name, sheet, causes in failure_sheets(evaluator, policy, names, _PICTURED, _PICTURED):
            sheets.append(Picture(name, png_of(sheet), count_causes(causes)))
            advance(len(sheets))
    subject = f"--policy {file}" if source else f"--hand {hand}"
    subject += f" --objects {objects}" if objects else f" --pool {pool}"
    flags = f"{subject} --episodes {episodes} --physics {engine} --seed {seed}"
    command = f"congrasp evaluate --table single composed {flags}"
    commands = Commands(command, f"{command} --pictures pictures", f"congrasp plot {run_dir}" if curves else "")
    which = f"{len(given)} objects ({objects_label(policy, objects)})"
    how = f"{episodes} episodes a row on {which}, engine {engine}, seed {seed}"
    write_report(out, policy, file.name, rows, how, sheets, curves, commands)
    for error in left_out:
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
