"""Figures of an evaluation's rows: comparison with the paper, rates with intervals, errors, and the
effect of noise.
"""

import functools
import itertools
import math
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import read_json
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.services.appearance.palette import INK
from congrasp.services.evaluate.columns import SCORE_CELLS, paper_rate, row_title
from congrasp.services.evaluate.scores import ERROR_COLUMNS, Row
from congrasp.services.evaluate.text_table import Table, percent
from congrasp.services.evaluate.variations import NOISE
from congrasp.services.viz.plots import (
    COLOURS,
    QUIET,
    default_style,
    new_figure,
    panel_grid,
    save,
    style,
)

_NOISES = {
    "joints": "Pose: normal error of every finger joint",
    "depth": "Pose: depth that it sinks into the object",
    "jitter": "Trajectory: normal error of every waypoint",
}
_RULE = "#e3e6ea"
"""Colour of the lines between the rows of a table."""
_PLOTTED_UNITS = {"rad": (1.0, "rad"), "m": (10.0, "dm")}
"""Factors and units with which angles and lengths fit one axis, by the units of errors."""
_MAX_FILE_BYTES = 64 << 20


def _titles_of_errors() -> dict[str, tuple[str, str]]:
    """Title and unit of each error, by its name in the rows."""
    titles = {}
    for constraint in CONSTRAINTS:
        title = f"{constraint.title.capitalize()} error"
        for spec in constraint.errors:
            titles[spec.column or spec.name] = (title, spec.unit or "share")
    return titles


_TITLES = _titles_of_errors()


@default_style()
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
        rows = [Row.from_json(row) for row in read_json(path, _MAX_FILE_BYTES)["rows"]]
        figures = {"table": _draw_table(comparison_table(rows)), "success": _draw_success(rows)}
        if any(row.quantiles for row in rows):
            figures["errors"] = _draw_errors(rows)
    except (CongraspError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise CongraspError(
            f"{path} is not the result of an evaluation ({type(error).__name__}: {error}).",
            "Pass a file that 'congrasp evaluate --json FILE' wrote, or a run's folder.",
        ) from None
    files = []
    for name, figure in figures.items():
        files += save(figure, out / name, formats)
    return files


def comparison_table(rows: Sequence[Row]) -> Table:
    """Rates and all errors of rows, each with the paper's."""
    labels = _labels(rows)
    columns: list[tuple[str, Callable[[Row], str]]] = [
        ("constraint", lambda row: labels[rows.index(row)]),
        ("episodes", lambda row: str(row.episodes)),
        ("success", SCORE_CELLS["success"]),
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


@default_style()
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
    for (above, below), (kind, heading) in zip(grid.T, _NOISES.items(), strict=True):
        constraint = next(noise.constraint for noise in NOISE if noise.kind == kind)
        unit, factor = ("rad", 1.0) if kind == "joints" else ("cm", 100.0)
        levels = []
        rows_of_kind = []
        for noise, row in zip(NOISE, rows, strict=True):
            if noise.constraint == constraint and noise.kind in ("", kind):
                levels.append(factor * noise.level)
                rows_of_kind.append(row)
        style(above, heading, "", "%")
        style(below, "", f"{kind}, {unit}", "mean error")
        _draw_rate(above, levels, rows_of_kind, "success", "success", COLOURS[0])
        _draw_rate(above, levels, rows_of_kind, "held_2s", "held for 2 s", COLOURS[2])
        colours = (COLOURS[3], COLOURS[1])
        for name, colour in zip(ERROR_COLUMNS[constraint], colours, strict=True):
            _, error_unit = _TITLES[name]
            scale, label = _PLOTTED_UNITS[error_unit]
            below.plot(
                levels,
                [scale * _or_nan(row.errors[name]) for row in rows_of_kind],
                "s-",
                color=colour,
                label=f"error, {label}",
            )
        above.set_ylim(0, 102)
        below.set_ylim(0, 1.1 * below.get_ylim()[1])
        above.legend(frameon=False, fontsize=8)
        below.legend(frameon=False, fontsize=8)
    save(figure, path.with_suffix(""), ["png"])


def _draw_rate(
    axes: Any, levels: Sequence[float], rows: Sequence[Row], name: str, label: str, colour: str
) -> None:
    """Draws a rate of rows against the noise, in per cent, with its interval."""
    rate = [100 * (getattr(row, name) or 0.0) for row in rows]
    low = [100 * (getattr(row, f"{name}_low") or 0.0) for row in rows]
    high = [100 * (getattr(row, f"{name}_high") or 0.0) for row in rows]
    axes.plot(levels, rate, "o-", color=colour, label=label)
    axes.fill_between(levels, low, high, color=colour, alpha=0.15, linewidth=0)


def _or_nan(error: float | None) -> float:
    """The error; NaN, which leaves a gap in a curve, if there is none."""
    return math.nan if error is None else error


def _labels(rows: Sequence[Row]) -> list[str]:
    """Labels of the rows: constraint and group, with hand and method if there are several."""
    if len({(row.hand, row.method) for row in rows}) == 1:
        return [row_title(row) for row in rows]
    return [f"{row_title(row)}, {row.hand}, {row.method}" for row in rows]


def _error(name: str, row: Row) -> str:
    """An error of a row with three digits; empty if there is none."""
    error = row.errors.get(name)
    return "" if error is None else f"{error:.3f}"


def _paper_error(name: str, row: Row) -> str:
    """The paper's error with three digits; empty if there is none."""
    if not row.paper or name not in row.paper.errors:
        return ""
    return f"{row.paper.errors[name]:.3f}"


def _draw_table(table: Table) -> Any:
    """Draws a table."""
    heads = [name.replace(", ", ",\n", 1) for name in table.columns]
    widths = []
    for column in zip(heads, *table.rows, strict=True):
        lines = "\n".join(column).split("\n")
        widths.append(2 + max(map(len, lines)))
    figure = new_figure(0.085 * sum(widths) + 0.3, 0.32 * (1 + len(table.rows)) + 1.0, table.title)
    axes = figure.subplots()
    axes.set_axis_off()
    drawn = axes.table(
        table.rows,
        colLabels=heads,
        colWidths=np.divide(widths, sum(widths)),
        bbox=(0, 0, 1, 1),
        edges="horizontal",
    )
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(8.5)
    for (line, column), cell in drawn.get_celld().items():
        is_head = line == 0
        is_label = column == 0
        edge_colour = INK if is_head else _RULE
        text_colour = QUIET if table.columns[column] == "paper" else INK
        weight = "bold" if is_head or is_label else "normal"
        alignment = "left" if is_label else "right"
        cell.set_edgecolor(edge_colour)
        cell.set_text_props(color=text_colour, weight=weight, ha=alignment)
    return figure


def _draw_success(rows: Sequence[Row]) -> Any:
    """Draws the success rate of each row with its interval, and the paper's rate."""
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


def _draw_errors(rows: Sequence[Row]) -> Any:
    """Draws cumulative distributions of the errors, one panel each."""
    with_quantiles = set(itertools.chain.from_iterable(row.quantiles for row in rows))
    names = [name for name in _TITLES if name in with_quantiles]
    figure, grid = panel_grid(
        len(names), 2.8, "Errors of successful episodes: share of episodes below"
    )
    labels = _labels(rows)
    for axes, name in zip(grid, names, strict=True):
        title, unit = _TITLES[name]
        for i, row in enumerate(rows):
            quantiles = row.quantiles.get(name)
            if not quantiles:
                continue
            shares = np.linspace(0, 1, len(quantiles))
            colour = COLOURS[i % len(COLOURS)]
            axes.plot(quantiles, shares, color=colour, linewidth=1.6, label=labels[i])
            if row.paper and name in row.paper.errors:
                axes.axvline(row.paper.errors[name], color=colour, linewidth=1.0, linestyle=":")
        style(axes, title, f"{unit}   (dotted: mean of the paper)", "share")
        axes.set_ylim(0, 1)
        axes.legend(fontsize=7, frameon=False, labelcolor=QUIET)
    return figure
