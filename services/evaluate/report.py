"""Report of a policy: one HTML file with tables, pictures, curves, its model card and the commands
that made them.
"""

import collections
import dataclasses
import pathlib
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from congrasp.common.io.files import write_atomically
from congrasp.common.policy.bundle import PolicyBundle, content_hash
from congrasp.common.runtime.engines import engine_title
from congrasp.common.shell import shell_command
from congrasp.common.wire.codec import encode
from congrasp.services.evaluate.columns import (
    FORCES,
    FORCES_TITLE,
    SCORE_CELLS,
    error_columns,
    paper_rate,
)
from congrasp.services.evaluate.experiment import Experiment, Result, Variation
from congrasp.services.evaluate.model_card import model_card
from congrasp.services.evaluate.pages import Picture, count_causes, curves_of, embed, template
from congrasp.services.evaluate.pictures import failure_sheets, turntable
from congrasp.services.evaluate.plan import objects_label
from congrasp.services.evaluate.scores import Row
from congrasp.services.evaluate.tables import Evaluation, evaluate_tables
from congrasp.services.evaluate.text_table import Styled, Table, verdict
from congrasp.services.viz.sheets import png_of

_MIN_EPISODES = 100
"""Number of episodes of a row below which its figures are preliminary."""
_PICTURES_OF_EACH_KIND = 4
"""Most failures, and most successes, drawn for a row."""


@dataclasses.dataclass(frozen=True)
class Commands:
    """Command lines that reproduce the parts of a report."""

    table: str
    pictures: str
    curves: str = ""


@dataclasses.dataclass(frozen=True)
class HandCheck:
    """Self-check of the policy's hand in a report."""

    findings: Sequence[tuple[str, str, str, str]]
    """Check, verdict, measurement and remedy of each line."""
    sheet: bytes
    """PNG of the grips and joints."""


@dataclasses.dataclass(frozen=True)
class ReportContent:
    """Content of a report."""

    policy: PolicyBundle
    name: str
    """Name of the policy's file."""
    rows: Sequence[Row]
    conditions: str
    """A sentence on objects, engine and seed of the evaluation."""
    commands: Commands
    sheets: Sequence[Picture] = ()
    """Pictures of episodes of each row."""
    curves: Sequence[Picture] = ()
    """Curves of the training, if it was recorded."""
    check: HandCheck | None = None
    """Self-check of the hand, if it was run."""
    motion: Mapping[str, Any] | None = None
    """An interactive grasp (`services.evaluate.pictures.turntable`)."""


def report_on(
    experiment: Experiment,
    name: str,
    out: pathlib.Path,
    *,
    subject: str,
    objects: pathlib.Path | None = None,
    run_dir: pathlib.Path | None = None,
    check: HandCheck | None = None,
) -> Evaluation:
    """Evaluates a policy by the paper's protocol and writes one HTML file about it.

    Args:
      experiment: policy, objects, engine and numbers.
      name: name of the policy's file.
      out: the HTML file.
      subject: options of `congrasp evaluate` that select the policy.
      objects: path of the objects; None if they are procedural.
      run_dir: run whose curves are shown.
      check: self-check of its hand.

    Raises:
      CongraspError: a package is missing, or a file cannot be read or written.
    """
    _report_template()  # fails before the evaluation if a package is missing
    curves = [] if run_dir is None else list(curves_of(run_dir))
    evaluation = evaluate_tables(experiment, ("single", "composed"), keep=True)
    results = evaluation.of(Variation)
    table_command = _evaluate_command(experiment, subject, objects)
    curves_command = ""
    if curves:
        curves_command = shell_command("congrasp", "plot", run_dir)
    content = ReportContent(
        policy=experiment.policy,
        name=name,
        rows=evaluation.rows,
        conditions=_conditions(evaluation, objects),
        commands=Commands(table_command, f"{table_command} --pictures pictures", curves_command),
        sheets=_draw_sheets(experiment, results),
        curves=curves,
        check=check,
        motion=_motion(results),
    )
    write_report(out, content)
    return evaluation


def _evaluate_command(experiment: Experiment, subject: str, objects: pathlib.Path | None) -> str:
    """Returns the `congrasp evaluate` command that repeats the evaluation."""
    which = f"--pool {len(experiment.objects)}"
    if objects is not None:
        which = f"--objects {shlex.quote(str(objects))}"
    return (
        f"congrasp evaluate --table single composed {subject} {which} "
        f"--episodes {experiment.episodes} --physics {experiment.physics} --seed {experiment.seed}"
    )


def _conditions(evaluation: Evaluation, objects: pathlib.Path | None) -> str:
    """Returns a sentence on the objects, the engine and the seed, and one on headings."""
    experiment = evaluation.experiment
    policy = experiment.policy
    text = (
        f"{experiment.episodes} episodes a row on {len(experiment.objects)} objects "
        f"({objects_label(policy, objects)}), {engine_title(experiment.physics)}, "
        f"seed {experiment.seed}"
    )
    if evaluation.heading_rules is None:
        return text
    return f"{text}. {evaluation.heading_rules.sentence(policy.spec.hand_name)}"


def _draw_sheets(experiment: Experiment, results: Sequence[Result]) -> list[Picture]:
    """Draws failures and successes of each row."""
    advance = experiment.track("Pictures", len(results))
    sheets: list[Picture] = []
    for row, sheet, causes in failure_sheets(
        experiment, results, _PICTURES_OF_EACH_KIND, _PICTURES_OF_EACH_KIND
    ):
        sheets.append(Picture(row, png_of(sheet), count_causes(causes)))
        advance(len(sheets))
    return sheets


def _motion(results: Sequence[Result]) -> Mapping[str, Any] | None:
    """Returns the interactive view of a success of the first row that has one, or else of a
    failure.
    """
    for result in results:
        if result.held:
            return {**turntable(result.held[0]), "constraint": result.variation.constraint}
    for result in results:
        if result.lost:
            return {**turntable(result.lost[0]), "constraint": result.variation.constraint}
    return None


def write_report(out: pathlib.Path, content: ReportContent) -> None:
    """Writes a self-contained HTML file atomically.

    Raises:
      CongraspError: jinja2 is not installed, or the file cannot be written.
    """
    policy = content.policy
    findings = None
    check = None
    if content.check is not None:
        findings = _findings(content.check).html()
        check = embed(Picture("self-check", content.check.sheet))
    text = _report_template().render(
        title=f"Grasping policy of the {policy.spec.hand} hand, version {policy.version}",
        summary=_summary(content.rows),
        warning=_warning(content.rows),
        rates=_rates(content.rows, content.conditions).html(),
        forces=Table.of(FORCES_TITLE, content.rows, FORCES).html(),
        command=content.commands.table,
        sheets=[embed(sheet) for sheet in content.sheets],
        pictures_command=content.commands.pictures,
        curves=[embed(curve) for curve in content.curves],
        curves_command=content.commands.curves,
        findings=findings,
        check=check,
        facts=_facts(policy, content.name),
        motion=content.motion,
        card=model_card(policy, content.rows),
    )
    write_atomically(out, text.encode())


def _report_template() -> Any:
    """Returns the page's template; raises a CongraspError if jinja2 is not installed."""
    return template(pathlib.Path(__file__).with_suffix(".html"))


def _warning(rows: Sequence[Row]) -> str:
    """Warning that rows have too few episodes to be quoted; empty if they have enough."""
    fewest = min((row.episodes for row in rows), default=_MIN_EPISODES)
    if fewest >= _MIN_EPISODES:
        return ""
    widest = max(row.success_high - row.success_low for row in rows)
    return (
        f"Preliminary: rows of {fewest} episodes, fewer than {_MIN_EPISODES}, with intervals of "
        f"{100 * widest:.0f} points. Do not quote these figures or compare policies by them. Pass "
        "--episodes 200 for better ones."
    )


def _summary(rows: Sequence[Row]) -> str:
    """Numbers of rows that are better and worse than the paper's."""
    compared = [row for row in rows if row.paper]
    above = sum(row.success >= row.paper.success for row in compared if row.paper)
    verdicts = collections.Counter(_verdict(row) for row in compared)
    return (
        f"{sum(row.episodes for row in rows)} episodes in simulation. Success is at or above the "
        f"paper's in {above} of its {len(compared)} rows; the 95 % interval is above it in "
        f"{verdicts['better']} and below it in {verdicts['worse']}."
    )


def _verdict(row: Row) -> str:
    """Verdict on the success of a row; empty if the paper has none."""
    return verdict(row.success_low, row.success_high, row.paper.success) if row.paper else ""


def _rates(rows: Sequence[Row], conditions: str) -> Table:
    """Rates and errors, with those of the paper."""
    columns = [
        ("constraint", SCORE_CELLS["constraint"]),
        ("episodes", SCORE_CELLS["episodes"]),
        ("objects", SCORE_CELLS["objects"]),
        ("success", lambda row: Styled(SCORE_CELLS["success"](row), _verdict(row))),
        ("paper", lambda row: Styled(paper_rate(row), "paper")),
        ("held for 2 s", SCORE_CELLS["held 2 s"]),
        *error_columns(rows),
    ]
    return Table.of(conditions, rows, columns)


def _findings(check: HandCheck) -> Table:
    """Findings of a hand's self-check."""
    styles = {"passed": "better", "failed": "worse"}
    lines = []
    for name, result, measurement, remedy in check.findings:
        lines.append(
            (
                name,
                Styled(result, styles.get(result, "")),
                Styled(measurement, "text"),
                Styled(remedy, "text"),
            )
        )
    title = "Its self-check: whether it can grasp at all, by geometry and physics"
    return Table(title, ("check", "", "measured", "remedy"), lines)


def _facts(policy: PolicyBundle, name: str) -> list[tuple[str, str]]:
    """Names and values of the last table."""
    task = policy.task
    network = policy.spec.network
    observation_size = sum(size for _, size in policy.spec.layout)
    return [
        ("file", name),
        ("content", content_hash(encode(policy.to_message()))),
        ("hand", policy.spec.hand),
        ("trained on", f"{policy.transitions:,} environment steps, version {policy.version}"),
        ("observation", f"{observation_size} numbers"),
        ("action", f"{policy.spec.action_size} numbers, {1 / task.control_dt:g} times a second"),
        ("network", f"{' - '.join(map(str, network.hidden))}, encoders of {network.encoder}"),
        ("method", "ConGraspXL: decoupled PPO in MuJoCo; this implementation, Apache-2.0"),
    ]
