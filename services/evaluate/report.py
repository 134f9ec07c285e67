"""Report and model card of a policy: one HTML file with tables, pictures, curves and the commands that made them."""

import base64
import collections
import dataclasses
import functools
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from congrasp.common.errors import need_package
from congrasp.common.io.files import write_atomically
from congrasp.common.policy.bundle import PolicyBundle, content_hash
from congrasp.common.wire.codec import encode
from congrasp.services.evaluate.cells import FORCES, error_title, force_cells, paper_cells, rate_cells, scaled
from congrasp.services.evaluate.model_card import model_card
from congrasp.services.evaluate.scores import ERRORS, Row
from congrasp.services.record.reader import read_metrics
from congrasp.services.viz.plots import draw, encoded, figures

_REPORT = pathlib.Path(__file__).with_suffix(".html")
_FEW = 100
"""Number of episodes of a row below which its figures are preliminary."""


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


def write_report(
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
      motion: an interactive grasp (`services.evaluate.turntable`).

    Raises:
      CongraspError: jinja2 is not installed, or the file cannot be written.
    """
    errors = [name for names in ERRORS.values() for name in names.values() if _measured(name, rows)]
    text = template().render(
        title=f"Grasping policy of the {policy.spec.hand} hand, version {policy.version}",
        summary=_summary(rows),
        conditions=conditions,
        warning=_warning(rows),
        errors=[error_title(name) for name in errors],
        rates=[_compared(row, errors) for row in rows],
        forces={"columns": FORCES, "rows": [force_cells(row) for row in rows]},
        command=commands.table,
        sheets=[embedded(sheet) for sheet in sheets],
        pictures_command=commands.pictures,
        curves=[embedded(curve) for curve in curves],
        curves_command=commands.curves,
        check=check and {**vars(check), "sheet": embedded(Picture("self-check", check.sheet))},
        facts=_facts(policy, name),
        motion=motion,
        card=model_card(policy, rows),
    )
    write_atomically(out, text.encode())


@functools.cache
def template(path: pathlib.Path = _REPORT) -> Any:
    """Returns a page template, which may extend `base.html`; raises a CongraspError if jinja2 is not installed."""
    need_package("A report", "jinja2")
    import jinja2

    loader = jinja2.FileSystemLoader([path.parent, _REPORT.parent])
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, loader=loader)
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


def _measured(error: str, rows: Sequence[Row]) -> bool:
    """True if one of the rows has this error."""
    return any(row.errors.get(error) is not None for row in rows)


def _warning(rows: Sequence[Row]) -> str:
    """Warning that rows have too few episodes to be quoted; empty if they have enough."""
    fewest = min((row.episodes for row in rows), default=_FEW)
    if fewest >= _FEW:
        return ""
    width = max(row.success_high - row.success_low for row in rows)
    return (
        f"Preliminary: rows of {fewest} episodes, fewer than {_FEW}, with intervals of {100 * width:.0f} points. "
        "Do not quote these figures or compare policies by them. Pass --episodes 200 for better ones."
    )


def _summary(rows: Sequence[Row]) -> str:
    """Numbers of rows that are better and worse than the paper's."""
    compared = [row for row in rows if row.paper]
    above = sum(row.success >= row.paper.success for row in compared if row.paper)
    clear = collections.Counter(_verdict(row) for row in compared)
    return (
        f"{sum(row.episodes for row in rows)} episodes in simulation. Success is at or above the paper's in "
        f"{above} of its {len(compared)} rows; the 95 % interval is above it in {clear['better']} and below it in "
        f"{clear['worse']}."
    )


def _compared(row: Row, errors: Sequence[str]) -> Mapping[str, Any]:
    """Row for the template: its rates, the paper's success, and pairs of our and the paper's errors."""
    name, episodes, objects, success, held, *_ = rate_cells(row)
    paper = row.paper.errors if row.paper else {}
    pairs = [(scaled(error, row.errors.get(error)), scaled(error, paper.get(error))) for error in errors]
    cells = {"name": name, "episodes": episodes, "objects": objects, "success": success, "held": held}
    return {**cells, "paper": paper_cells(row)[0], "errors": pairs, "verdict": _verdict(row)}


def _verdict(row: Row) -> str:
    """ "better" or "worse" if the whole interval is, else empty."""
    if row.paper is None or row.success_low <= row.paper.success <= row.success_high:
        return ""
    return "better" if row.success_low > row.paper.success else "worse"


def embedded(picture: Picture) -> Mapping[str, Any]:
    """Picture for the template."""
    return {"title": picture.title, "caption": picture.caption, "image": base64.b64encode(picture.png).decode()}


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
