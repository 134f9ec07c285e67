"""Figures of a run from its recordings: learning curves, reward terms, episodes and all other
metrics.
"""

import dataclasses
import io
import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.metrics import DIVERGED
from congrasp.services.record.palette import INK
from congrasp.services.record.reader import read_metrics

_KINDS = {"rad": "angle", "m": "distance", "": "share of links"}
TITLES = {
    **json.loads(pathlib.Path(__file__).with_name("titles.json").read_text()),
    f"episode/{DIVERGED}": ("Diverged physics", "share of episodes"),
    **{
        f"success/{constraint.name}": (f"Success with {constraint.title}", "share of episodes")
        for constraint in CONSTRAINTS
        if constraint.blocks
    },
    **{
        f"episode/mask_{block}": (f"Episodes with {block.replace('_', ', ')}", "share of episodes")
        for constraint in CONSTRAINTS
        for block in constraint.blocks
    },
    **{
        f"episode/{spec.name}": (
            f"{constraint.title.capitalize()} error: {_KINDS[spec.unit]}",
            spec.unit or "share",
        )
        for constraint in CONSTRAINTS
        for spec in constraint.errors
    },
}
"""Title, unit and, where these are not enough, the meaning of each metric."""
_UNITS = {
    "_per_second": "1/s",
    "_seconds": "s",
    "_rad": "rad",
    "_m": "m",
    "_bytes": "bytes",
    "_ratio": "share",
}
"""Units of metrics without a title, by the endings of their names."""


def titled(metric: str) -> tuple[str, str]:
    """Title and unit of a metric by its name after the process; the title of an unknown one is its
    name in words.
    """
    if metric in TITLES:
        title, unit, *_ = TITLES[metric]
        return title, unit
    group, _, name = metric.rpartition("/")
    ending = next((end for end in _UNITS if name.endswith(end)), "")
    words = name.removesuffix(ending).replace("_", " ")
    if group == "term":
        return words.capitalize(), "reward"
    if group == "failure":
        return f"Lost objects: {words}", "share of episodes"
    return (f"{group.replace('_', ' ')}: {words}" if group else words).capitalize(), _UNITS.get(
        ending, ""
    )


Series = Mapping[str, tuple[np.ndarray, np.ndarray]]
"""Steps and values of each metric of a run, by `<role>/<name>/<metric>`."""
Runs = Mapping[str, Series]
"""Runs by their names for a legend."""
_COLUMNS = 4
QUIET, _GRID = "#6b7280", "#e3e6ea"
COLOURS = ("#2f6fdb", "#e08a2c", "#1f9d88", "#b5373a", "#7a4cc2", "#5b8c2a", "#c2478f", "#6b7280")
_MEANINGLESS = {"episode/object_index"}
_LEGEND = 8
"""Largest number of lines for which a panel has a legend."""


@dataclasses.dataclass(frozen=True)
class Panel:
    """One plot: its title, the unit of its vertical axis, and the metrics (after the process's
    name) it shows.
    """

    title: str
    unit: str
    metrics: tuple[str, ...]


def _panel(metric: str) -> Panel:
    """A panel of one metric."""
    return Panel(*titled(metric), (metric,))


LEARNING = (
    *map(
        _panel,
        ("episode/return", "episode/success", "episode/links_at_removal", "steps_per_second"),
    ),
    Panel("Policy lag", "versions", ("staleness_mean", "staleness_max")),
    *map(_panel, ("kl", "imitation_kl", "policy_loss", "value_loss", "explained_variance")),
    *map(_panel, ("action_std", "learning_rate", "clip_fraction")),
)
"""Panels of the first figure; those without data are left out."""


def plot_runs(
    paths: Sequence[pathlib.Path], out: pathlib.Path, formats: Sequence[str] = ("png", "pdf")
) -> list[pathlib.Path]:
    """Draws runs; several are overlaid.

    Args:
      paths: runs' folders, or MCAP files.
      out: folder for the figures.
      formats: formats of the files: png, pdf.

    Returns:
      The files written, each figure in each format.

    Raises:
      CongraspError: there are no metrics, or a file cannot be written.
    """
    runs = {}
    for path, label in zip(paths, _labels(paths), strict=True):
        runs[label] = read_metrics(path)
        if not runs[label]:
            raise CongraspError(
                f"The recordings in {path} hold no metrics.", "Was the learner recorded?"
            )
    written = []
    for name, (title, panels) in figures(runs).items():
        written += save(draw(title, panels, runs), out / name, formats)
    return written


def _labels(paths: Sequence[pathlib.Path]) -> list[str]:
    """Names of runs for a legend: those of their folders, or the whole paths if two have the same
    name.
    """
    names = [path.resolve().name for path in paths]
    return names if len(set(names)) == len(names) else [str(path) for path in paths]


def save(figure: Any, stem: pathlib.Path, formats: Sequence[str]) -> list[pathlib.Path]:
    """Writes a figure as `<stem>.<format>` for each format; returns the files."""
    files = []
    for kind in formats:
        files.append(stem.with_name(f"{stem.name}.{kind}"))
        write_atomically(files[-1], encoded(figure, kind))
    return files


def encoded(figure: Any, kind: str = "png") -> bytes:
    """A figure as the content of a file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=130)
    # The layout is computed; another format would compute it again
    figure.set_layout_engine("none")
    return buffer.getvalue()


def new_figure(width: float, height: float, title: str) -> Any:
    """An empty figure of a width and height in inches."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    figure.suptitle(title, x=0.01, ha="left", color=INK, fontsize=15, fontweight="bold")
    return figure


def panel_grid(count: int, height: float, title: str) -> tuple[Any, list[Any]]:
    """A figure of `count` panels, of a height in inches, in rows of up to four; and their axes."""
    columns = min(_COLUMNS, count)
    rows = -(-count // columns)
    figure = new_figure(3.6 * columns, 0.6 + height * rows, title)
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for unused in axes[count:]:
        unused.set_axis_off()
    return figure, axes[:count]


def style(axes: Any, title: str, x: str, y: str) -> None:
    """Sets title, labels and the plain frame of one plot."""
    axes.set_title(title, loc="left", color=INK, fontsize=10)
    axes.set_ylabel(y, color=QUIET, fontsize=8)
    axes.set_xlabel(x, color=QUIET, fontsize=8)
    axes.tick_params(colors=QUIET, labelsize=8, length=0)
    axes.grid(color=_GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    for side in axes.spines.values():
        side.set_visible(False)


def figures(runs: Runs) -> dict[str, tuple[str, list[Panel]]]:
    """Title and panels of each figure by file name.

    Every metric of the runs is in exactly one panel, except those whose mean has no meaning, and
    constant ones outside of the learning curves.
    """
    names = {_metric(name) for series in runs.values() for name in series} - _MEANINGLESS
    learning = [
        dataclasses.replace(panel, metrics=shown)
        for panel in LEARNING
        if (shown := tuple(metric for metric in panel.metrics if metric in names))
    ]
    rest = sorted(
        names - {metric for panel in learning for metric in panel.metrics} - _constants(runs)
    )
    groups = {
        "learning": ("Learning", learning),
        "reward_terms": ("Reward terms, sum over an episode", _panels(rest, "term/")),
        "episodes": ("Episodes", _panels(rest, "episode/")),
        "details": (
            "Details",
            [_panel(m) for m in rest if not m.startswith(("term/", "episode/"))],
        ),
    }
    return {name: group for name, group in groups.items() if group[1]}


def _constants(runs: Runs) -> set[str]:
    """Metrics whose curves, each of several points, all have one value."""
    values: dict[str, list[np.ndarray]] = {}
    for series in runs.values():
        for name, (_, found) in series.items():
            values.setdefault(_metric(name), []).append(found[np.isfinite(found)])
    return {
        metric
        for metric, found in values.items()
        if all(len(curve) > 1 for curve in found) and len(np.unique(np.concatenate(found))) == 1
    }


def draw(title: str, panels: Sequence[Panel], runs: Runs) -> Any:
    """Draws one figure of small multiples.

    The label of a line names its run if there are several, its process if there are several, and
    its metric if the panel has two.
    """
    figure, grid = panel_grid(len(panels), 2.5, title)
    for axes, panel in zip(grid, panels, strict=True):
        lines = [
            (_label(run, name, panel, runs), *curve)
            for run, series in runs.items()
            for name, curve in series.items()
            if _metric(name) in panel.metrics
        ]
        for i, (label, steps, values) in enumerate(lines):
            _curve(axes, steps, values, COLOURS[i % len(COLOURS)], label)
        style(axes, panel.title, "update", panel.unit)
        axes.ticklabel_format(axis="y", style="sci", scilimits=(-3, 4), useOffset=False)
        axes.yaxis.get_offset_text().set(fontsize=7, color=QUIET)
        axes.margins(x=0.02)
        if 1 < len(lines) <= _LEGEND:
            axes.legend(fontsize=7, frameon=False, labelcolor=QUIET)
    return figure


def smooth(values: np.ndarray, window: int) -> np.ndarray:
    """(n,) running mean of the last `window` values, of fewer at the beginning; ignores NaN."""
    finite = np.isfinite(values)
    # Sums of differences stay exact where nothing changes
    base = values[finite][0] if finite.any() else 0.0
    total = np.cumsum(np.where(finite, values - base, 0.0))
    count = np.cumsum(finite)
    total[window:] = total[window:] - total[:-window]
    count[window:] = count[window:] - count[:-window]
    return base + np.divide(total, count, out=np.full(len(values), np.nan), where=count > 0)


def _curve(axes: Any, steps: np.ndarray, values: np.ndarray, colour: str, label: str) -> None:
    """Draws a metric; a long one also smoothed."""
    window = len(values) // 40
    if window < 3:
        marker = "o" if len(values) < 20 else ""
        axes.plot(
            steps, values, color=colour, linewidth=1.5, label=label, marker=marker, markersize=3
        )
    else:
        axes.plot(steps, values, color=colour, linewidth=0.6, alpha=0.3)
        axes.plot(steps, smooth(values, window), color=colour, linewidth=1.6, label=label)


def _metric(name: str) -> str:
    """Metric of a name: that of `learner/0/term/contact` is `term/contact`."""
    return name.split("/", 2)[2]


def _label(run: str, name: str, panel: Panel, runs: Runs) -> str:
    """Label of a line in a legend."""
    role, process, metric = name.split("/", 2)
    processes = {
        found.rpartition(f"/{metric}")[0] for found in runs[run] if _metric(found) == metric
    }
    who = process if process.startswith(role) else f"{role} {process}"
    several = who if len(processes) > 1 or len(runs) == 1 else ""
    words = [
        run if len(runs) > 1 else "",
        several if len(panel.metrics) == 1 or len(runs) > 1 else "",
    ]
    return ", ".join(
        word for word in (*words, titled(metric)[0] if len(panel.metrics) > 1 else "") if word
    )


def _panels(metrics: Sequence[str], prefix: str) -> list[Panel]:
    """A panel for each metric with a prefix."""
    return [_panel(metric) for metric in metrics if metric.startswith(prefix)]
