"""Figures of a run from its recordings: learning curves, reward terms, episodes and every other number."""

import dataclasses
import io
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from common.errors import CongraspError
from common.files import write_atomically
from services.record.palette import INK
from services.record.reader import read_metrics

Series = Mapping[str, tuple[np.ndarray, np.ndarray]]
_COLUMNS = 4
QUIET, _GRID = "#6b7280", "#e3e6ea"
COLOURS = ("#2f6fdb", "#e08a2c", "#1f9d88", "#b5373a", "#7a4cc2", "#5b8c2a", "#c2478f", "#6b7280")
_LEGEND = 8
"""Lines of one panel that a legend still names."""
_UNITS = {
    "_per_second": "1/s",
    "_seconds": "s",
    "_rad": "rad",
    "_m": "m",
    "_bytes": "bytes",
    "_ratio": "share",
    "kl": "nats",
    "entropy": "nats",
    "fraction": "share",
    "episode/length": "control steps",
}


@dataclasses.dataclass(frozen=True)
class Panel:
    """One plot: its title, the unit of its vertical axis, and the metrics (after the process's name) it shows."""

    title: str
    unit: str
    metrics: tuple[str, ...]


LEARNING = (
    Panel("Return of an episode", "reward", ("episode/return",)),
    Panel("Success", "share of episodes", ("episode/success",)),
    Panel("Links in contact at the table's removal", "links", ("episode/links_at_removal",)),
    Panel("Throughput", "control steps/s", ("steps_per_second",)),
    Panel("Policy lag", "versions", ("staleness_mean", "staleness_max")),
    Panel("KL of an update", "nats", ("kl",)),
    Panel("KL of student and teacher", "nats", ("imitation_kl",)),
    Panel("Policy loss", "", ("policy_loss",)),
    Panel("Value loss", "", ("value_loss",)),
    Panel("Explained variance of the critic", "share", ("explained_variance",)),
    Panel("Standard deviation of actions", "action units", ("action_std",)),
    Panel("Learning rate", "", ("learning_rate",)),
    Panel("Clipped samples", "share", ("clip_fraction",)),
)
"""Panels of the first figure; those without data are left out."""


def plot_run(path: pathlib.Path, out: pathlib.Path, formats: Sequence[str] = ("png", "pdf")) -> list[pathlib.Path]:
    """Draws a run.

    Args:
      path: a run's folder, or one MCAP file.
      out: folder for the figures.
      formats: of the files: png, pdf.

    Returns:
      The files written, each figure in each format.

    Raises:
      CongraspError: there are no metrics, or a file cannot be written.
    """
    series = read_metrics(path)
    if not series:
        raise CongraspError(f"The recordings in {path} hold no metrics.", "Was the learner recorded?")
    written = []
    for name, (title, panels) in figures(series).items():
        written += save(draw(title, panels, series), out / name, formats)
    return written


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
    figure.set_layout_engine("none")  # the layout is found; to find it again would take as long
    return buffer.getvalue()


def new_figure(width: float, height: float, title: str) -> Any:
    """An empty figure of so many inches."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    figure.suptitle(title, x=0.01, ha="left", color=INK, fontsize=15, fontweight="bold")
    return figure


def style(axes: Any, title: str, x: str, y: str) -> None:
    """Title and labels of one plot, and its quiet frame."""
    axes.set_title(title, loc="left", color=INK, fontsize=10)
    axes.set_ylabel(y, color=QUIET, fontsize=8)
    axes.set_xlabel(x, color=QUIET, fontsize=8)
    axes.tick_params(colors=QUIET, labelsize=8, length=0)
    axes.grid(color=_GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    for side in axes.spines.values():
        side.set_visible(False)


def figures(series: Series) -> dict[str, tuple[str, list[Panel]]]:
    """Title and panels of each figure by file name; every metric of `series` is in exactly one of them."""
    present = {_metric(name) for name in series}
    learning = [
        dataclasses.replace(panel, metrics=shown)
        for panel in LEARNING
        if (shown := tuple(metric for metric in panel.metrics if metric in present))
    ]
    rest = sorted(present - {metric for panel in learning for metric in panel.metrics})
    groups = {
        "learning": ("Learning", learning),
        "reward_terms": ("Reward terms, sum over an episode", _panels(rest, "term/", "reward")),
        "episodes": ("Episodes", _panels(rest, "episode/", "")),
        "details": ("Details", [_panel(m) for m in rest if not m.startswith(("term/", "episode/"))]),
    }
    return {name: group for name, group in groups.items() if group[1]}


def draw(title: str, panels: Sequence[Panel], series: Series) -> Any:
    """One figure of small multiples; a line is named after its process, and its metric where there are two."""
    columns = min(_COLUMNS, len(panels))
    rows = -(-len(panels) // columns)
    figure = new_figure(3.6 * columns, 0.6 + 2.5 * rows, title)
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.flat[len(panels) :]:
        axes.set_axis_off()
    for axes, panel in zip(grid.flat, panels, strict=False):
        lines = [name for name in series if _metric(name) in panel.metrics]
        for i, name in enumerate(lines):
            _curve(axes, *series[name], COLOURS[i % len(COLOURS)], _label(name, panel))
        style(axes, panel.title, "update", panel.unit)
        axes.ticklabel_format(axis="y", style="sci", scilimits=(-3, 4), useOffset=False)
        axes.yaxis.get_offset_text().set(fontsize=7, color=QUIET)
        axes.margins(x=0.02)
        if 1 < len(lines) <= _LEGEND:
            axes.legend(fontsize=7, frameon=False, labelcolor=QUIET)
    return figure


def smooth(values: np.ndarray, window: int) -> np.ndarray:
    """Mean of the last `window` values (n,), of fewer at the beginning; NaN does not count."""
    finite = np.isfinite(values)
    base = values[finite][0] if finite.any() else 0.0  # sums of differences stay exact where nothing changes
    total = np.cumsum(np.where(finite, values - base, 0.0))
    count = np.cumsum(finite)
    total[window:] = total[window:] - total[:-window]
    count[window:] = count[window:] - count[:-window]
    return base + np.divide(total, count, out=np.full(len(values), np.nan), where=count > 0)


def _curve(axes: Any, steps: np.ndarray, values: np.ndarray, colour: str, label: str) -> None:
    """Draws a metric; a long one smoothed, over itself."""
    window = len(values) // 40
    if window < 3:
        marker = "o" if len(values) < 20 else ""
        axes.plot(steps, values, color=colour, linewidth=1.5, label=label, marker=marker, markersize=3)
    else:
        axes.plot(steps, values, color=colour, linewidth=0.6, alpha=0.3)
        axes.plot(steps, smooth(values, window), color=colour, linewidth=1.6, label=label)


def _metric(name: str) -> str:
    """`learner/0/term/contact` is the metric `term/contact` of the process `learner/0`."""
    return name.split("/", 2)[2]


def _label(name: str, panel: Panel) -> str:
    """The line's name in a legend."""
    role, process, metric = name.split("/", 2)
    return f"{role} {process}" if len(panel.metrics) == 1 else metric.replace("_", " ")


def _panels(metrics: Sequence[str], prefix: str, unit: str) -> list[Panel]:
    """A panel for each metric with a prefix."""
    return [_panel(metric, prefix, unit) for metric in metrics if metric.startswith(prefix)]


def _panel(metric: str, prefix: str = "", unit: str = "") -> Panel:
    """A panel of one metric, with the unit that its name implies."""
    words = metric.removeprefix(prefix)
    found = next((unit for end, unit in _UNITS.items() if metric.endswith(end)), unit)
    return Panel(words.replace("/", ": ").replace("_", " ").capitalize(), found, (metric,))
