"""Figures of an evaluation's rows: comparison with the paper, rates with intervals, errors, and the
effect of noise.
"""

import functools
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import read_json
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.services.evaluate.columns import RATE, paper_rate, row_title
from congrasp.services.evaluate.scores import ERRORS, Row
from congrasp.services.evaluate.text_table import Table, percent
from congrasp.services.evaluate.variations import NOISE
from congrasp.services.record.palette import INK
from congrasp.services.viz.plots import COLOURS, QUIET, new_figure, panel_grid, save, style

_TITLES = {
    spec.column or spec.name: (f"{constraint.title.capitalize()} error", spec.unit or "share")
    for constraint in CONSTRAINTS
    for spec in constraint.errors
}
"""Title and unit of each error, by its name in the rows."""
_NOISES = {
    "joints": "Pose: normal error of every finger joint",
    "depth": "Pose: depth that it sinks into the object",
    "jitter": "Trajectory: normal error of every waypoint",
}
_LARGEST = 64 << 20  # limit of a JSON file in bytes


def plot_evaluation(
    path: pathlib.Path, out: pathlib.Path, formats: Sequence[str]
) -> list[pathlib.Path]:
    """Plots the result of `congrasp evaluate --json`.

    Args:
      path: the file.
      out: folder for the figures.
      formats: formats of the files: png, pdf.

    Returns:
      The files written: table, success, and errors if the file has their quantiles.

    Raises:
      CongraspError: it is not such a file.
    """
    try:
        rows = [Row.from_json(row) for row in read_json(path, _LARGEST)["rows"]]
        figures = {"table": _table(compared(rows)), "success": _success(rows)}
        if any(row.quantiles for row in rows):
            figures["errors"] = _errors(rows)
    except (CongraspError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise CongraspError(
            f"{path} is not the result of an evaluation ({type(error).__name__}: {error}).",
            "Pass a file that 'congrasp evaluate --json FILE' wrote, or a run's folder.",
        ) from None
    return [file for name, figure in figures.items() for file in save(figure, out / name, formats)]


def compared(rows: Sequence[Row]) -> Table:
    """Rates and all errors of rows, each with the paper's."""
    labels = _labels(rows)
    columns: list[tuple[str, Callable[[Row], str]]] = [
        ("constraint", lambda row: labels[rows.index(row)]),
        ("episodes", lambda row: str(row.episodes)),
        ("success", RATE["success"]),
        ("paper", paper_rate),
        ("held 2 s", lambda row: percent(row.held_2s)),
    ]
    for name, (title, unit) in _TITLES.items():
        if any(row.errors.get(name) is not None for row in rows):
            columns += [
                (f"{title}, {unit}", functools.partial(_error, name)),
                ("paper", functools.partial(_paper_error, name)),
            ]
    return Table.of("Evaluation and paper", rows, columns)


def draw_noise(rows: Sequence[Row], path: pathlib.Path, title: str) -> None:
    """Draws success and errors against the noise, a panel for each kind, as PNG.

    Args:
      rows: rows of `services.evaluate.variations.NOISE`, in that order.
      path: the file to write.
      title: title of the figure.

    Raises:
      CongraspError: the file cannot be written.
    """
    figure = new_figure(4.0 * len(_NOISES), 5.6, title)
    grid = figure.subplots(2, len(_NOISES), sharex="col")
    pairs = list(zip(NOISE, rows, strict=True))
    for (above, below), (kind, heading) in zip(grid.T, _NOISES.items(), strict=True):
        constraint = next(noise.constraint for noise in NOISE if noise.kind == kind)
        shown = [
            (n, row) for n, row in pairs if n.constraint == constraint and n.kind in ("", kind)
        ]
        unit, factor = ("rad", 1.0) if kind == "joints" else ("cm", 100.0)
        x = [factor * noise.level for noise, _ in shown]
        style(above, heading, "", "%")
        style(below, "", f"{kind}, {unit}", "mean error")
        for name, label, colour in (
            ("success", "success", COLOURS[0]),
            ("held_2s", "held for 2 s", COLOURS[2]),
        ):
            ends = ("_low", "", "_high")
            low, middle, high = (
                [100 * (getattr(row, f"{name}{end}") or 0.0) for _, row in shown] for end in ends
            )
            above.plot(x, middle, "o-", color=colour, label=label)
            above.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)
        for (name, scale, unit), colour in zip(
            _scaled(constraint), (COLOURS[3], COLOURS[1]), strict=True
        ):
            found = [
                np.nan if (value := row.errors[name]) is None else scale * value for _, row in shown
            ]
            below.plot(x, found, "s-", color=colour, label=f"error, {unit}")
        above.set_ylim(0, 102)
        below.set_ylim(0, 1.1 * below.get_ylim()[1])
        for axes in (above, below):
            axes.legend(frameon=False, fontsize=8)
    save(figure, path.with_suffix(""), ["png"])


def _scaled(constraint: str) -> list[tuple[str, float, str]]:
    """Errors of a constraint, with a factor and a unit: angles in rad, lengths in dm."""
    shown = {"rad": (1.0, "rad"), "m": (10.0, "dm")}
    return [(name, *shown[_TITLES[name][1]]) for name in ERRORS[constraint].values()]


def _labels(rows: Sequence[Row]) -> list[str]:
    """Labels of the rows: constraint and group, with hand and method if there are several."""
    several = len({(row.hand, row.method) for row in rows}) > 1
    return [row_title(row) + (f", {row.hand}, {row.method}" if several else "") for row in rows]


def _error(name: str, row: Row) -> str:
    """An error of a row with three digits; empty if there is none."""
    return "" if (error := row.errors.get(name)) is None else f"{error:.3f}"


def _paper_error(name: str, row: Row) -> str:
    """The paper's; empty if there is none."""
    return f"{row.paper.errors[name]:.3f}" if row.paper and name in row.paper.errors else ""


def _table(table: Table) -> Any:
    """Draws a table."""
    heads = [name.replace(", ", ",\n", 1) for name in table.columns]
    cells = zip(heads, *table.rows, strict=True)
    widths = [
        2 + max(len(word) for cell in column for word in cell.split("\n")) for column in cells
    ]
    figure = new_figure(0.085 * sum(widths) + 0.3, 0.32 * (1 + len(table.rows)) + 1.0, table.title)
    axes = figure.subplots()
    axes.set_axis_off()
    shown = axes.table(
        table.rows,
        colLabels=heads,
        colWidths=np.divide(widths, sum(widths)),
        bbox=(0, 0, 1, 1),
        edges="horizontal",
    )
    shown.auto_set_font_size(False)
    shown.set_fontsize(8.5)
    for (line, column), cell in shown.get_celld().items():
        cell.set_edgecolor(INK if line == 0 else "#e3e6ea")
        weight = "bold" if line == 0 or column == 0 else "normal"
        cell.set_text_props(color=QUIET if table.columns[column] == "paper" else INK, weight=weight)
        cell.set_text_props(ha="left" if column == 0 else "right")
    return figure


def _success(rows: Sequence[Row]) -> Any:
    """Draws the success of each row with its interval, and that of the paper."""
    figure = new_figure(7.2, 0.9 + 0.36 * len(rows), "Success, with 95 % intervals")
    axes = figure.subplots()
    y = np.arange(len(rows))[::-1]
    rates = np.array([row.success for row in rows])
    spread = np.abs(np.array([[row.success_low, row.success_high] for row in rows]).T - rates)
    axes.errorbar(
        rates, y, xerr=spread, fmt="o", color=COLOURS[0], capsize=3, markersize=5, label="ours"
    )
    paper = [(row.paper.success, height) for row, height in zip(rows, y, strict=True) if row.paper]
    if paper:
        axes.plot(*zip(*paper, strict=True), "D", color=COLOURS[1], markersize=5, label="paper")
    axes.set_yticks(y, _labels(rows))
    style(axes, "", "share of episodes", "")
    axes.set_xlim(right=1.005)
    axes.legend(
        fontsize=8, frameon=False, labelcolor=QUIET, loc="upper left", bbox_to_anchor=(1.0, 1.0)
    )
    return figure


def _errors(rows: Sequence[Row]) -> Any:
    """Draws cumulative distributions of the errors, one panel each."""
    shown = [name for name in _TITLES if any(name in row.quantiles for row in rows)]
    figure, grid = panel_grid(
        len(shown), 2.8, "Errors of successful episodes: share of episodes below"
    )
    labels = _labels(rows)
    for axes, name in zip(grid, shown, strict=True):
        title, unit = _TITLES[name]
        for i, row in enumerate(rows):
            if not (found := row.quantiles.get(name)):
                continue
            colour = COLOURS[i % len(COLOURS)]
            axes.plot(
                found, np.linspace(0, 1, len(found)), color=colour, linewidth=1.6, label=labels[i]
            )
            if row.paper and name in row.paper.errors:
                axes.axvline(row.paper.errors[name], color=colour, linewidth=1.0, linestyle=":")
        style(axes, title, f"{unit}   (dotted: mean of the paper)", "share")
        axes.set_ylim(0, 1)
        axes.legend(fontsize=7, frameon=False, labelcolor=QUIET)
    return figure
