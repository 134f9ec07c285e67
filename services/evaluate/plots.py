"""Figures of an evaluation from its JSON: comparison with the paper, rates with intervals, distributions of errors."""

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import read_json
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.services.record.palette import INK
from congrasp.services.viz.plots import COLOURS, QUIET, new_figure, save, style

_TITLES = {
    spec.column or spec.name: (f"{constraint.title.capitalize()} error", spec.unit or "share")
    for constraint in CONSTRAINTS
    for spec in constraint.errors
}
"""Title and unit of each error, by its name in the rows."""
_COLUMNS = 4
_LARGEST = 64 << 20  # limit of a JSON file in bytes


def plot_evaluation(path: pathlib.Path, out: pathlib.Path, formats: Sequence[str]) -> list[pathlib.Path]:
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
        rows = read_json(path, _LARGEST)["rows"]
        figures = {"table": _table(rows), "success": _success(rows)}
        if any(row.get("quantiles") for row in rows):
            figures["errors"] = _errors(rows)
    except (CongraspError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise CongraspError(
            f"{path} is not the result of an evaluation ({type(error).__name__}: {error}).",
            "Pass a file that 'congrasp evaluate --json FILE' wrote, or a run's folder.",
        ) from None
    return [file for name, figure in figures.items() for file in save(figure, out / name, formats)]


def cells(rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Text of the table, its header first; a pair is ours and the paper's."""
    shown = [name for name in _TITLES if any(row.get(name) is not None for row in rows)]
    head = ["constraint", "episodes", "success, %", "paper", "held 2 s, %"]
    table = [[*head, *(word for name in shown for word in (f"{_TITLES[name][0]}, {_TITLES[name][1]}", "paper"))]]
    for row, label in zip(rows, _labels(rows), strict=True):
        paper = row["paper"] or {"success": None, "errors": {}}
        interval = f"{_percent(row['success'])} ({_percent(row['success_low'])}-{_percent(row['success_high'])})"
        line = [label, str(row["episodes"]), interval, _percent(paper["success"]), _percent(row["held_2s"])]
        line += [word for name in shown for word in (_figure(row.get(name)), _figure(paper["errors"].get(name)))]
        table.append(line)
    return table


def _labels(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Labels of the rows: constraint and group, with hand and method if there are several."""
    several = len({(row["hand"], row["method"]) for row in rows}) > 1
    keys = ("constraint", "group", "hand", "method") if several else ("constraint", "group")
    return [", ".join(row[key] for key in keys if row[key]) for row in rows]


def _percent(rate: float | None) -> str:
    """Formats a rate in per cent; empty if there is none."""
    return "" if rate is None else f"{100 * rate:.1f}"


def _figure(value: float | None) -> str:
    """Formats a value with three digits; empty if there is none."""
    return "" if value is None else f"{value:.3f}"


def _table(rows: Sequence[Mapping[str, Any]]) -> Any:
    """Draws the figure of `cells`."""
    text = cells(rows)
    widths = [
        max(max(len(word) for word in cell.split("\n")) for cell in column)
        for column in zip(*_wrapped(text), strict=True)
    ]
    total = sum(widths) + 2 * len(widths)
    figure = new_figure(0.085 * total + 0.3, 0.32 * len(text) + 1.0, "Evaluation and paper")
    axes = figure.subplots()
    axes.set_axis_off()
    edges = np.cumsum([0, *(width + 2 for width in widths)]) / total
    for r, line in enumerate(_wrapped(text)):
        y = 1 - (r + 0.5) / len(text)
        for c, word in enumerate(line):
            heavy = "bold" if r == 0 or c == 0 else "normal"
            quiet = QUIET if text[0][c] == "paper" else INK
            x, side = (edges[c], "left") if c == 0 else (edges[c + 1], "right")
            axes.text(x, y, word, ha=side, va="center", fontsize=8.5, color=quiet, fontweight=heavy)
        axes.axhline(1 - (r + 1) / len(text), color=INK if r == 0 else "#e3e6ea", linewidth=1.0 if r == 0 else 0.6)
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1)
    return figure


def _wrapped(text: Sequence[Sequence[str]]) -> list[list[str]]:
    """Breaks the header's words after their comma."""
    return [[word.replace(", ", ",\n", 1) for word in text[0]], *map(list, text[1:])]


def _success(rows: Sequence[Mapping[str, Any]]) -> Any:
    """Draws the success of each row with its interval, and that of the paper."""
    figure = new_figure(7.2, 0.9 + 0.36 * len(rows), "Success, with 95 % intervals")
    axes = figure.subplots()
    y = np.arange(len(rows))[::-1]
    rates = np.array([row["success"] for row in rows])
    spread = np.abs(np.array([[row["success_low"], row["success_high"]] for row in rows]).T - rates)
    axes.errorbar(rates, y, xerr=spread, fmt="o", color=COLOURS[0], capsize=3, markersize=5, label="ours")
    paper = [(row["paper"]["success"], height) for row, height in zip(rows, y, strict=True) if row["paper"]]
    if paper:
        axes.plot(*zip(*paper, strict=True), "D", color=COLOURS[1], markersize=5, label="paper")
    axes.set_yticks(y, _labels(rows))
    style(axes, "", "share of episodes", "")
    axes.set_xlim(right=1.005)
    axes.legend(fontsize=8, frameon=False, labelcolor=QUIET, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _errors(rows: Sequence[Mapping[str, Any]]) -> Any:
    """Draws cumulative distributions of the errors, one panel each."""
    shown = [name for name in _TITLES if any(name in row.get("quantiles", {}) for row in rows)]
    columns = min(_COLUMNS, len(shown))
    lines = -(-len(shown) // columns)
    figure = new_figure(3.6 * columns, 0.6 + 2.8 * lines, "Errors of successful episodes: share of episodes below")
    grid = figure.subplots(lines, columns, squeeze=False)
    for axes in grid.flat[len(shown) :]:
        axes.set_axis_off()
    labels = _labels(rows)
    for axes, name in zip(grid.flat, shown, strict=False):
        title, unit = _TITLES[name]
        for i, row in enumerate(rows):
            found = row.get("quantiles", {}).get(name)
            if not found:
                continue
            colour = COLOURS[i % len(COLOURS)]
            axes.plot(found, np.linspace(0, 1, len(found)), color=colour, linewidth=1.6, label=labels[i])
            paper = (row["paper"] or {"errors": {}})["errors"].get(name)
            if paper is not None:
                axes.axvline(paper, color=colour, linewidth=1.0, linestyle=":")
        style(axes, title, f"{unit}   (dotted: mean of the paper)", "share")
        axes.set_ylim(0, 1)
        axes.legend(fontsize=7, frameon=False, labelcolor=QUIET)
    return figure
