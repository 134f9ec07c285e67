"""Report and model card of a policy: one HTML file with tables, pictures, curves and the commands
that made them.
"""

import base64
import collections
import dataclasses
import functools
import pathlib
import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from congrasp.common.errors import need_package
from congrasp.common.io.files import write_atomically
from congrasp.common.policy.bundle import PolicyBundle, content_hash
from congrasp.common.runtime.engines import engine_title
from congrasp.common.shell import shell_command
from congrasp.common.task.config import SensingConfig, TaskConfig
from congrasp.common.task.constraints import optional
from congrasp.common.task.plausibility import CLEAN_MM
from congrasp.common.wire.codec import encode
from congrasp.services.evaluate.experiment import Experiment, Result, Variation
from congrasp.services.evaluate.pictures import failure_sheets, turntable
from congrasp.services.evaluate.plan import objects_label
from congrasp.services.evaluate.scores import Row
from congrasp.services.evaluate.table import (
    FORCES,
    FORCES_TITLE,
    RATE,
    Styled,
    Table,
    error_columns,
    paper_rate,
    verdict,
)
from congrasp.services.evaluate.tables import Found, evaluate_tables
from congrasp.services.record.reader import read_metrics
from congrasp.services.viz.plots import draw, encoded, figures
from congrasp.services.viz.sheets import png_of

_REPORT = pathlib.Path(__file__).with_suffix(".html")
_FEW = 100
"""Number of episodes of a row below which its figures are preliminary."""
_PICTURED = 4
_LEAST = 0.8
"""Rates below this are listed as limits."""
_WORST = 6
"""Most objects listed."""
_OVERLAPS = {
    "hand_hand_mm": "Its fingers pass through one another",
    "hand_table_mm": "It passes through the table",
    "hand_object_mm": "It passes through the object",
}
_FAST = 1.0  # m/s of a wrist, above which an arm hardly follows
_SIMULATED = (
    "It was trained and measured in simulation, never on a physical hand: success here implies "
    "nothing about the "
    "safety of a robot."
)
_MET = (
    "Its objects were rigid and fit the hand: no soft or articulated ones, no clutter and no "
    "obstacles."
)
_HEADINGS = {
    "all": "all headings",
    "above": "headings within 30° of straight down",
    "center": "headings with the hand's centre above the table",
}
_TRACKER_UNITS = {
    "period": "s",
    "delay": "s",
    "position_noise": "m",
    "rotation_noise": "rad",
    "dropout": "",
}


@dataclasses.dataclass(frozen=True)
class Picture:
    """A picture of the report."""

    title: str
    png: bytes
    caption: str = ""


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


def report_on(
    experiment: Experiment,
    name: str,
    out: pathlib.Path,
    *,
    subject: str,
    objects: pathlib.Path | None = None,
    run_dir: pathlib.Path | None = None,
    check: HandCheck | None = None,
) -> Found:
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
    template()  # fails before the evaluation if a package is missing
    policy, track = experiment.policy, experiment.track
    curves = list(curves_of(run_dir)) if run_dir else []
    found = evaluate_tables(experiment, ("single", "composed"), keep=True)
    results = found.of(Variation)
    advance = track("Pictures", len(results))
    sheets = []
    for row, sheet, causes in failure_sheets(experiment, results, _PICTURED, _PICTURED):
        sheets.append(Picture(row, png_of(sheet), count_causes(causes)))
        advance(len(sheets))
    subject += (
        f" --objects {shlex.quote(str(objects))}"
        if objects
        else f" --pool {len(experiment.objects)}"
    )
    numbers = (
        f"--episodes {experiment.episodes} --physics {experiment.physics} --seed {experiment.seed}"
    )
    command = f"congrasp evaluate --table single composed {subject} {numbers}"
    commands = Commands(
        command,
        f"{command} --pictures pictures",
        shell_command("congrasp", "plot", run_dir) if curves else "",
    )
    rules = (
        f". {found.heading_rules.sentence(policy.spec.hand_name)}" if found.heading_rules else ""
    )
    which = f"{len(experiment.objects)} objects ({objects_label(policy, objects)})"
    how = (
        f"{experiment.episodes} episodes a row on {which}, {engine_title(experiment.physics)}, "
        f"seed {experiment.seed}"
    )
    write_report(
        out,
        policy,
        name,
        found.rows,
        how + rules,
        sheets,
        curves,
        commands,
        check,
        _motion(results),
    )
    return found


def _motion(results: Sequence[Result]) -> Mapping[str, Any] | None:
    """Returns the interactive view of a success of the first row that has one, or else of a
    failure.
    """
    episodes = [(result, episode) for result in results for episode in result.held]
    episodes += [(result, episode) for result in results for episode in result.lost]
    for result, episode in episodes[:1]:
        return {**turntable(episode), "constraint": result.variation.constraint}
    return None


def write_report(  # noqa: PLR0913
    out: pathlib.Path,
    policy: PolicyBundle,
    name: str,
    rows: Sequence[Row],
    conditions: str,
    sheets: Sequence[Picture],
    curves: Sequence[Picture],
    commands: Commands,
    check: HandCheck | None = None,
    motion: Mapping[str, Any] | None = None,
) -> None:
    """Writes the report atomically.

    Args:
      out: self-contained HTML file.
      policy: policy of the report.
      name: name of the policy's file.
      rows: rows of the evaluation.
      conditions: a sentence on objects, engine and seed of the evaluation.
      sheets: pictures of episodes of each row.
      curves: curves of the training, if it was recorded.
      commands: commands that reproduce its parts.
      check: self-check of the hand, if it was run.
      motion: an interactive grasp (`services.evaluate.pictures.turntable`).

    Raises:
      CongraspError: jinja2 is not installed, or the file cannot be written.
    """
    text = template().render(
        title=f"Grasping policy of the {policy.spec.hand} hand, version {policy.version}",
        summary=_summary(rows),
        warning=_warning(rows),
        rates=_rates(rows, conditions).html(),
        forces=Table.of(FORCES_TITLE, rows, FORCES).html(),
        command=commands.table,
        sheets=[embedded(sheet) for sheet in sheets],
        pictures_command=commands.pictures,
        curves=[embedded(curve) for curve in curves],
        curves_command=commands.curves,
        findings=check and _findings(check).html(),
        check=check and embedded(Picture("self-check", check.sheet)),
        facts=_facts(policy, name),
        motion=motion,
        card=model_card(policy, rows),
    )
    write_atomically(out, text.encode())


@functools.cache
def template(path: pathlib.Path = _REPORT) -> Any:
    """Returns a page template, which may extend `base.html`; raises a CongraspError if jinja2 is
    not installed.
    """
    need_package("A report", "jinja2")
    import jinja2

    loader = jinja2.FileSystemLoader([path.parent, _REPORT.parent])
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, loader=loader
    )
    return environment.get_template(path.name)


def curves_of(run_dir: pathlib.Path) -> Iterator[Picture]:
    """Yields the figures of a run's recordings, if it has any."""
    if any(run_dir.rglob("*.mcap")):
        runs = {run_dir.name: read_metrics(run_dir)}
        for title, panels in figures(runs).values():
            yield Picture(title, encoded(draw(title, panels, runs)))


def count_causes(causes: Sequence[str]) -> str:
    """Counts causes, such as "2 held, 1 slipped 0.82 s after the table was removed"."""
    return ", ".join(f"{count} {cause}" for cause, count in collections.Counter(causes).items())


def _warning(rows: Sequence[Row]) -> str:
    """Warning that rows have too few episodes to be quoted; empty if they have enough."""
    fewest = min((row.episodes for row in rows), default=_FEW)
    if fewest >= _FEW:
        return ""
    width = max(row.success_high - row.success_low for row in rows)
    return (
        f"Preliminary: rows of {fewest} episodes, fewer than {_FEW}, with intervals of "
        f"{100 * width:.0f} points. "
        "Do not quote these figures or compare policies by them. Pass --episodes 200 for better "
        "ones."
    )


def _summary(rows: Sequence[Row]) -> str:
    """Numbers of rows that are better and worse than the paper's."""
    compared = [row for row in rows if row.paper]
    above = sum(row.success >= row.paper.success for row in compared if row.paper)
    clear = collections.Counter(_verdict(row) for row in compared)
    return (
        f"{sum(row.episodes for row in rows)} episodes in simulation. Success is at or above the "
        f"paper's in "
        f"{above} of its {len(compared)} rows; the 95 % interval is above it in {clear['better']} "
        f"and below it in "
        f"{clear['worse']}."
    )


def _verdict(row: Row) -> str:
    """Verdict on the success of a row; empty if the paper has none."""
    return verdict(row.success_low, row.success_high, row.paper.success) if row.paper else ""


def _rates(rows: Sequence[Row], conditions: str) -> Table:
    """Rates and errors, with those of the paper."""
    columns = [(name, RATE[name]) for name in ("constraint", "episodes", "objects")]
    columns += [
        ("success", lambda row: Styled(RATE["success"](row), _verdict(row))),
        ("paper", lambda row: Styled(paper_rate(row), "paper")),
        ("held for 2 s", RATE["held 2 s"]),
    ]
    return Table.of(conditions, rows, [*columns, *error_columns(rows)])


def _findings(check: HandCheck) -> Table:
    """Findings of a hand's self-check."""
    styles = {"passed": "better", "failed": "worse"}
    lines = [
        (name, Styled(found, styles.get(found, "")), *(Styled(text, "text") for text in texts))
        for name, found, *texts in check.findings
    ]
    title = "Its self-check: whether it can grasp at all, by geometry and physics"
    return Table(title, ("check", "", "measured", "remedy"), lines)


def embedded(picture: Picture) -> Mapping[str, Any]:
    """Picture for the template."""
    return {
        "title": picture.title,
        "caption": picture.caption,
        "image": base64.b64encode(picture.png).decode(),
    }


def _facts(policy: PolicyBundle, name: str) -> list[tuple[str, str]]:
    """Names and values of the last table."""
    task, network = policy.task, policy.spec.network
    return [
        ("file", name),
        ("content", content_hash(encode(policy.to_message()))),
        ("hand", policy.spec.hand),
        ("trained on", f"{policy.transitions:,} environment steps, version {policy.version}"),
        ("observation", f"{sum(size for _, size in policy.spec.layout)} numbers"),
        ("action", f"{policy.spec.action_size} numbers, {1 / task.control_dt:g} times a second"),
        ("network", f"{' - '.join(map(str, network.hidden))}, encoders of {network.encoder}"),
        ("method", "ConGraspXL: decoupled PPO in MuJoCo; this implementation, Apache-2.0"),
    ]


def model_card(policy: PolicyBundle, rows: Sequence[Row]) -> Mapping[str, Any]:
    """Returns the sections of a policy's model card.

    Args:
      policy: policy of the card.
      rows: rows of its evaluation.

    Returns:
      `hand`; `constraints`: names; `data`: sentences; `limits`: sentences, those from the rows
      first. The rest
        of a card is the same for all policies.
    """
    return {
        "hand": policy.spec.hand_name,
        "constraints": policy.task.constraints,
        "data": (
            "It was trained by reinforcement learning in simulation. Objects are procedural, or "
            "those of the "
            "run's folder; constraints are sampled, or those of the run's constraint sets.",
            _trained(policy.task),
        ),
        "limits": (*limits(rows), _SIMULATED, _observed(policy.task), _MET),
    }


def limits(rows: Sequence[Row]) -> list[str]:
    """Limits shown by the figures: rows below the paper's or below 80 %, lost objects, implausible
    motions.
    """
    found = []
    for row in rows:
        name = f"{row.constraint} ({row.group})" if row.group else row.constraint
        rates = [("success", row.success), ("held for 2 s", row.held_2s)]
        low = [
            f"{100 * rate:.1f} % {what}"
            for what, rate in rates
            if rate is not None and rate < _LEAST
        ]
        if row.paper and row.success < row.paper.success:
            below = 100 * (row.paper.success - row.success)
            low.append(
                f"success {below:.1f} points below the paper's {100 * row.paper.success:.1f} %"
            )
        if low:
            found.append(f"{name.capitalize()}: {', '.join(low)}.")
    if not found:
        found.append("No row is below the paper's success, or below 80 %.")
    if worst := _worst(rows):
        found.append(f"Objects with the most losses: {', '.join(worst)}.")
    for measure, words in _OVERLAPS.items():
        deepest = max((row.plausibility.get(measure) or 0.0 for row in rows), default=0.0)
        if deepest > CLEAN_MM[measure]:
            found.append(f"{words}: {deepest:.1f} mm at the deepest, mean of the worst row.")
    fastest = max((row.plausibility.get("wrist_speed") or 0.0 for row in rows), default=0.0)
    if fastest > _FAST:
        found.append(f"Its wrist peaks at {fastest:.1f} m/s, in the mean of the fastest row.")
    return found


def _worst(rows: Sequence[Row]) -> list[str]:
    """Objects with a success below 80 % over all rows, the worst first, with their rates."""
    episodes: dict[str, int] = {}
    held: dict[str, float] = {}
    for row in rows:
        for of in row.objects:
            episodes[of["name"]] = episodes.get(of["name"], 0) + of["episodes"]
            held[of["name"]] = held.get(of["name"], 0.0) + of["episodes"] * of["success"]
    rates = sorted((held[name] / count, name) for name, count in episodes.items())
    return [
        f"{name} ({100 * rate:.0f} % of {episodes[name]})" for rate, name in rates if rate < _LEAST
    ][:_WORST]


def _trained(task: TaskConfig) -> str:
    """Describes the distribution of the episodes in training."""
    parts = [
        f"{part.title} in {100 * getattr(task, f'p_{part.name}'):.0f} %" for part in optional(task)
    ]
    ranges = [
        f"mass x {_range(task.mass_range)}",
        f"sliding friction {_range(task.friction_range)}",
    ]
    if task.gain_range != (1.0, 1.0):
        ranges.append(f"servo gains x {_range(task.gain_range)}")
    ranges += _tracker(task.sensing)
    return (
        f"In training: {_HEADINGS[task.headings]}; {', '.join(parts) or 'no other constraint'}; "
        f"{', '.join(ranges)}."
    )


def _tracker(sensing: SensingConfig) -> list[str]:
    """Describes the tracker's ranges in training, with units, omitting those that were always
    zero.
    """
    ranges = {name: (getattr(sensing, name), unit) for name, unit in _TRACKER_UNITS.items()}
    return [
        f"tracker's {name.replace('_', ' ')} {_range(limits)} {unit}".rstrip()
        for name, (limits, unit) in ranges.items()
        if any(limits)
    ]


def _range(limits: tuple[float, float]) -> str:
    """Formats a range such as "0.8 to 1.2"; one number if both are equal."""
    low, high = limits
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _observed(task: TaskConfig) -> str:
    """Describes the observation of the policy."""
    robot = (
        f"It observes the last {task.history} control steps of joint angles, the wrist, their "
        f"targets"
    )
    if task.observation == "camera":
        return (
            f"{robot}, and a partial cloud of the object from a depth camera; no pose, velocities "
            f"or contact forces."
        )
    if task.observation == "tracked":
        return f"{robot} and the object's pose from a tracker; no velocities and no contact forces."
    pose = "exact poses" if task.sensing == SensingConfig() else "the object's pose from a tracker"
    return f"It observes {pose}, velocities and contact forces."
