"""Figures of a run from its recordings: learning curves, reward terms, episodes, and details."""

import contextlib
import dataclasses
import io
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically
from congrasp.services.appearance.palette import INK
from congrasp.services.record.reader import read_metrics
from congrasp.services.viz.metric_titles import titled

Series = Mapping[str, tuple[np.ndarray, np.ndarray]]
"""Steps and values of each metric of a run, by `<role>/<name>/<metric>`."""
Runs = Mapping[str, Series]
"""Runs by their names for a legend."""
QUIET = "#6b7280"
"""Colour of labels."""
_GRID = "#e3e6ea"
COLOURS = ("#2f6fdb", "#e08a2c", "#1f9d88", "#b5373a", "#7a4cc2", "#5b8c2a", "#c2478f", "#6b7280")
"""Colours of lines, in turn."""
_COLUMNS = 4
_PANEL_WIDTH_IN = 3.6
_PANEL_HEIGHT_IN = 2.5
_TITLE_HEIGHT_IN = 0.6
_DOTS_PER_IN = 130
_MEANINGLESS = {"episode/object_index"}
"""Metrics whose mean has no meaning."""
_MOST_IN_LEGEND = 8
"""Largest number of lines for which a panel has a legend."""
_SMOOTHED_SHARE = 40
"""A long curve is smoothed over this part of its length."""
_LEAST_WINDOW = 3
"""Shorter windows are not smoothed."""
_FEW_POINTS = 20
"""Fewer points are marked."""


@dataclasses.dataclass(frozen=True)
class Panel:
    """One plot."""

    title: str
    unit: str
    """Unit of its vertical axis."""
    metrics: tuple[str, ...]
    """Its metrics, named without the process."""


class _Line(NamedTuple):
    """A line of a panel."""

    label: str
    steps: np.ndarray
    values: np.ndarray


def _panel(metric: str) -> Panel:
    """A panel of one metric."""
    title, unit = titled(metric)
    return Panel(title, unit, (metric,))


LEARNING = (
    _panel("episode/return"),
    _panel("episode/success"),
    _panel("episode/links_at_removal"),
    _panel("steps_per_second"),
    Panel("Policy lag", "versions", ("staleness_mean", "staleness_max")),
    _panel("kl"),
    _panel("imitation_kl"),
    _panel("policy_loss"),
    _panel("value_loss"),
    _panel("explained_variance"),
    _panel("action_std"),
    _panel("learning_rate"),
    _panel("clip_fraction"),
)
"""Panels of the first figure; those without data are left out."""


@contextlib.contextmanager
def default_style() -> Iterator[None]:
    """Context or decorator of drawing: Matplotlib's own defaults replace the user's settings, such
    as a `matplotlibrc` that requires LaTeX.
    """
    import matplotlib.style

    with matplotlib.style.context("default", after_reset=True):
        yield


@default_style()
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
    for path, label in zip(paths, _run_names(paths), strict=True):
        runs[label] = read_metrics(path)
        if not runs[label]:
            raise CongraspError(
                f"The recordings in {path} contain no metrics.",
                "Pass a recording of the learner, such as the folder of a run.",
            )
    written = []
    for name, (title, panels) in figures(runs).items():
        written += save(draw(title, panels, runs), out / name, formats)
    return written


def _run_names(paths: Sequence[pathlib.Path]) -> list[str]:
    """Names of runs for a legend: their folders, or the whole paths if two have the same name."""
    names = [path.resolve().name for path in paths]
    if len(set(names)) < len(names):
        return [str(path) for path in paths]
    return names


def save(figure: Any, stem: pathlib.Path, formats: Sequence[str]) -> list[pathlib.Path]:
    """Writes a figure as `<stem>.<format>` for each format; returns the files."""
    files = []
    for kind in formats:
        file = stem.with_name(f"{stem.name}.{kind}")
        write_atomically(file, encoded(figure, kind))
        files.append(file)
    return files


@default_style()
def encoded(figure: Any, kind: str = "png") -> bytes:
    """A figure as the content of a file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=_DOTS_PER_IN)
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
    figure = new_figure(_PANEL_WIDTH_IN * columns, _TITLE_HEIGHT_IN + height * rows, title)
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
    metrics = set()
    for series in runs.values():
        metrics |= {_metric(name) for name in series}
    metrics -= _MEANINGLESS
    learning = _learning_panels(metrics)
    rest = metrics - _constants(runs)
    for panel in learning:
        rest -= set(panel.metrics)
    terms: list[Panel] = []
    episodes: list[Panel] = []
    details: list[Panel] = []
    for metric in sorted(rest):
        if metric.startswith("term/"):
            terms.append(_panel(metric))
        elif metric.startswith("episode/"):
            episodes.append(_panel(metric))
        else:
            details.append(_panel(metric))
    groups = {
        "learning": ("Learning", learning),
        "reward_terms": ("Reward terms, sum over an episode", terms),
        "episodes": ("Episodes", episodes),
        "details": ("Details", details),
    }
    return {name: (title, panels) for name, (title, panels) in groups.items() if panels}


def _learning_panels(metrics: set[str]) -> list[Panel]:
    """The learning curves with their present metrics, without empty ones."""
    panels = []
    for panel in LEARNING:
        present = tuple(metric for metric in panel.metrics if metric in metrics)
        if present:
            panels.append(dataclasses.replace(panel, metrics=present))
    return panels


def _constants(runs: Runs) -> set[str]:
    """Metrics whose curves, each of several points, all have one value."""
    curves: dict[str, list[np.ndarray]] = {}
    for series in runs.values():
        for name, (_, values) in series.items():
            curves.setdefault(_metric(name), []).append(values[np.isfinite(values)])
    constants = set()
    for metric, finite in curves.items():
        have_several_points = all(len(values) > 1 for values in finite)
        if have_several_points and len(np.unique(np.concatenate(finite))) == 1:
            constants.add(metric)
    return constants


@default_style()
def draw(title: str, panels: Sequence[Panel], runs: Runs) -> Any:
    """Draws one figure of small multiples."""
    figure, grid = panel_grid(len(panels), _PANEL_HEIGHT_IN, title)
    for axes, panel in zip(grid, panels, strict=True):
        lines = _lines(panel, runs)
        for i, line in enumerate(lines):
            _draw_line(axes, line, COLOURS[i % len(COLOURS)])
        style(axes, panel.title, "update", panel.unit)
        axes.ticklabel_format(axis="y", style="sci", scilimits=(-3, 4), useOffset=False)
        axes.yaxis.get_offset_text().set(fontsize=7, color=QUIET)
        axes.margins(x=0.02)
        if 1 < len(lines) <= _MOST_IN_LEGEND:
            axes.legend(fontsize=7, frameon=False, labelcolor=QUIET)
    return figure


def _lines(panel: Panel, runs: Runs) -> list[_Line]:
    """The lines of a panel."""
    lines = []
    for run, series in runs.items():
        for name, (steps, values) in series.items():
            if _metric(name) in panel.metrics:
                lines.append(_Line(_label(run, name, panel, runs), steps, values))
    return lines


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


def _draw_line(axes: Any, line: _Line, colour: str) -> None:
    """Draws a line; a long one also smoothed."""
    window = len(line.values) // _SMOOTHED_SHARE
    if window >= _LEAST_WINDOW:
        axes.plot(line.steps, line.values, color=colour, linewidth=0.6, alpha=0.3)
        smoothed = smooth(line.values, window)
        axes.plot(line.steps, smoothed, color=colour, linewidth=1.6, label=line.label)
        return
    marker = "o" if len(line.values) < _FEW_POINTS else ""
    axes.plot(
        line.steps,
        line.values,
        color=colour,
        linewidth=1.5,
        label=line.label,
        marker=marker,
        markersize=3,
    )


def _metric(name: str) -> str:
    """Metric of a name: that of `learner/0/term/contact` is `term/contact`."""
    return name.split("/", 2)[2]


def _label(run: str, name: str, panel: Panel, runs: Runs) -> str:
    """Label of a line in a legend.

    It names the run if there are several, the metric if the panel has several, and the process if
    several processes of the run report the metric. A panel with one metric of one run names the
    process in any case; one with several metrics of one run never does.
    """
    role, process, metric = name.split("/", 2)
    has_several_runs = len(runs) > 1
    has_several_metrics = len(panel.metrics) > 1
    if has_several_runs:
        names_process = len(_processes(runs[run], metric)) > 1
    else:
        names_process = not has_several_metrics
    parts = []
    if has_several_runs:
        parts.append(run)
    if names_process:
        parts.append(process if process.startswith(role) else f"{role} {process}")
    if has_several_metrics:
        parts.append(titled(metric)[0])
    return ", ".join(parts)


def _processes(series: Series, metric: str) -> set[str]:
    """Roles and names of the processes that report a metric."""
    return {name.removesuffix(f"/{metric}") for name in series if _metric(name) == metric}
