"""Evaluates a policy and writes its report, for `congrasp report` and `congrasp hands train`."""

import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from congrasp.actors.physics import PhysicsName, resolve_physics
from congrasp.common.errors import CongraspError
from congrasp.common.policy import bundle as bundles
from congrasp.common.runtime.engines import engine_title
from congrasp.common.runtime.parallel import cores
from congrasp.services.assets.objects.named import objects_of
from congrasp.services.evaluate.evaluator import Evaluator
from congrasp.services.evaluate.exam import exam_pool
from congrasp.services.evaluate.failures import failure_sheets
from congrasp.services.evaluate.protocol import objects_label, two_seconds
from congrasp.services.evaluate.report import (
    Commands,
    HandCheck,
    Picture,
    count_causes,
    curves_of,
    template,
    write_report,
)
from congrasp.services.evaluate.scores import TABLES, Row, known_rows
from congrasp.services.evaluate.turntable import turntable
from congrasp.services.viz.sheets import png_of

_PICTURED = 4


class Reported(NamedTuple):
    """Content of a report."""

    rows: list[Row]
    left_out: list[CongraspError]
    """Reasons for missing rows."""


def report_on(
    file: pathlib.Path,
    out: pathlib.Path,
    *,
    subject: str,
    episodes: int,
    pool: int,
    physics: PhysicsName = "auto",
    seed: int = 0,
    objects: pathlib.Path | None = None,
    run_dir: pathlib.Path | None = None,
    check: HandCheck | None = None,
    track: Callable[[str, int | None], Callable[[int], None]],
) -> Reported:
    """Evaluates a policy by the paper's protocol and writes one HTML file about it.

    Args:
      file: file of the policy.
      out: the HTML file.
      subject: options of `congrasp evaluate` that select the policy.
      episodes: episodes of each row.
      pool: number of procedural objects.
      physics: engine.
      seed: seed of constraints and episodes.
      objects: objects to grasp, as for `congrasp evaluate`; held-out procedural ones by default.
      run_dir: run whose curves are shown.
      check: self-check of its hand.
      track: shows progress.

    Raises:
      CongraspError: a package is missing, or a file cannot be read or written.
    """
    template()  # fails before the evaluation if a package is missing
    policy, engine = bundles.load(file), resolve_physics(physics)
    curves = list(curves_of(run_dir)) if run_dir else []
    given = objects_of(objects, track=track) if objects else exam_pool("figures", pool)
    track("Generating constraints", None)
    evaluator = Evaluator(
        policy, given, physics=engine, threads=cores(), seed=seed, hold_steps=two_seconds(policy.task)
    )
    names, left_out = evaluator.allowed(known_rows(TABLES, policy.task))
    rows = evaluator.rows(names, episodes, track("Episodes", len(names) * episodes), keep=True)
    rules = ""
    if "heading" in names and policy.task.headings == "all":
        by_center, found = evaluator.row_by_center(episodes, track("Episodes with other rules for headings", episodes))
        rows.insert(names.index("heading") + 1, by_center)
        rules = f". {found.sentence(policy.spec.hand_name)}"
    advance = track("Pictures", len(names))
    sheets = []
    for name, sheet, causes in failure_sheets(evaluator, policy, names, _PICTURED, _PICTURED):
        sheets.append(Picture(name, png_of(sheet), count_causes(causes)))
        advance(len(sheets))
    subject += f" --objects {objects}" if objects else f" --pool {pool}"
    command = (
        f"congrasp evaluate --table single composed {subject} --episodes {episodes} --physics {engine} --seed {seed}"
    )
    commands = Commands(command, f"{command} --pictures pictures", f"congrasp plot {run_dir}" if curves else "")
    which = f"{len(given)} objects ({objects_label(policy, objects)})"
    how = f"{episodes} episodes a row on {which}, {engine_title(engine)}, seed {seed}{rules}"
    write_report(out, policy, file.name, rows, how, sheets, curves, commands, check, _motion(evaluator, names))
    return Reported(rows, left_out)


def _motion(evaluator: Evaluator, names: Sequence[str]) -> Mapping[str, Any] | None:
    """Returns the interactive view of a success of the first row that has one, or else of a failure."""
    for successes, failures in ((1, 0), (0, 1)):
        for name in names:
            for episode in evaluator.examples(name, successes, failures):
                return {**turntable(episode), "constraint": name}
    return None
