"""`congrasp report`: a policy's report and model card."""

import pathlib
import tempfile
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Annotated

import tyro

from common.config import PhysicsName
from common.errors import CongraspError

if TYPE_CHECKING:
    from common.policy.bundle import PolicyBundle
    from services.evaluation.evaluate import Evaluator
    from services.evaluation.report import Picture

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
) -> int:
    """Write one HTML file about a policy: results beside the paper's, episodes that fail and succeed, and its training.

    It evaluates the policy by the paper's protocol first, which takes minutes on a CPU.

    Args:
      source: A run's folder or a policy file; by default the policy that comes with congrasp.
      out: The file to write.
      objects: Objects to grasp, as 'congrasp evaluate' takes them; held-out procedural ones by default.
      episodes: Episodes in each row.
      physics: Engine; auto takes warp on an NVIDIA GPU and native on a CPU.
      pool: Number of procedural objects.
      seed: Seed of constraints and episodes.
    """
    import os

    from rich.progress import Progress

    from actors.physics import resolve_physics
    from common.config import ObjectsConfig
    from common.objects.pool import HELD_OUT_SEED, load_pool
    from common.policy import bundle as bundles
    from common.policy.shipped import policy_file
    from learner.run_directory import POLICY_FILE
    from services.evaluation.evaluate import Evaluator, two_seconds
    from services.evaluation.report import Made, write_report
    from services.evaluation.scores import TABLES
    from services.grasping.objects import objects_of

    for name, value in (("episodes", episodes), ("pool", pool)):
        if value < 1:
            raise CongraspError(f"--{name} is {value}.", "It must be at least 1.")
    run_dir = source if source is not None and source.is_dir() else None
    file = run_dir / POLICY_FILE if run_dir else policy_file(source)
    policy, engine = bundles.load(file), resolve_physics(physics)
    names = [name for table in TABLES.values() for name in table]
    with Progress(transient=True) as progress:

        def track(text: str, total: int | None) -> Callable[[int], None]:
            task = progress.add_task(text, total=total)
            return lambda done: progress.update(task, completed=done)

        curves = list(_curves(run_dir)) if run_dir else []
        given = objects_of(objects, track) if objects else load_pool(ObjectsConfig(count=pool, seed=HELD_OUT_SEED))
        track("Making constraints", None)
        evaluator = Evaluator(
            policy,
            given,
            physics=engine,
            threads=os.cpu_count() or 1,
            seed=seed,
            hold_steps=two_seconds(policy.task),
        )
        rows = evaluator.rows(names, episodes, track("Episodes", len(names) * episodes))
        advance = track("Pictures", len(names))
        sheets: list[Picture] = []
        for done, name in enumerate(names):
            sheets += _sheet(evaluator, policy, name)
            advance(done + 1)
    flags = [
        *([f"--policy {file}"] if source else []),
        *([f"--objects {objects}"] if objects else [f"--pool {pool}"]),
        f"--episodes {episodes} --physics {engine} --seed {seed}",
    ]
    command = f"congrasp evaluate --table single composed {' '.join(flags)}"
    made = Made(command, f"{command} --pictures pictures", f"congrasp plot {run_dir}" if curves else "")
    where = str(objects) if objects else "held-out procedural objects"
    conditions = f"{episodes} episodes a row on {len(given)} objects ({where}), engine {engine}, seed {seed}"
    write_report(out, policy, file.name, rows, conditions, sheets, curves, made)
    print(out)
    return 0


def _curves(run_dir: pathlib.Path) -> "Iterator[Picture]":
    """Figures of a run's recordings, if it has any."""
    from common.logs.reader import read_metrics
    from services.evaluation.report import Picture
    from services.pictures.plots import draw, figures

    if any(run_dir.rglob("*.mcap")):
        series = read_metrics(run_dir)
        for title, panels in figures(series).values():
            yield Picture(title, draw(title, panels, series))


def _sheet(evaluator: "Evaluator", policy: "PolicyBundle", constraint: str) -> "Iterator[Picture]":
    from services.evaluation.failures import failure_sheet
    from services.evaluation.report import Picture, causes_in_words

    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder, "sheet.png")
        causes = failure_sheet(evaluator, policy, constraint, path, _PICTURED, _PICTURED)
        if causes:
            yield Picture(constraint, path.read_bytes(), causes_in_words(causes))


COMMAND = report
