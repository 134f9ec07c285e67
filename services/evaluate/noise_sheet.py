"""Figures of noisy references: success and errors against the noise, and a grasp under the worst of each kind."""

import io
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from congrasp.common.io.files import write_atomically
from congrasp.services.evaluate.evaluator import Evaluator
from congrasp.services.evaluate.noise import LEVELS
from congrasp.services.evaluate.scores import Row
from congrasp.services.viz.render import episode_strip
from congrasp.services.viz.sheets import contact_sheet, save_png

_TITLES = {
    "joints": "Pose: normal error of every finger joint",
    "depth": "Pose: depth that it sinks into the object",
    "jitter": "Trajectory: normal error of every waypoint",
}
_SUCCESS, _HELD, _ANGLE, _LENGTH = "#2f6fdb", "#1f9d88", "#b5373a", "#e08a2c"
_FRAMES = 5
_SIZE = (300, 225)


def draw_noise(evaluator: Evaluator, rows: Sequence[Row], folder: pathlib.Path, title: str) -> None:
    """Writes `noise.png`, the curves, and `noise_examples.png`, a grasp under the worst level of each kind.

    Args:
      evaluator: evaluator of the policy.
      rows: rows of `LEVELS`, in that order.
      folder: folder for the files.
      title: title of the curves.

    Raises:
      CongraspError: a file cannot be written.
    """
    draw_curves(rows, folder / "noise.png", title)
    images: list[np.ndarray] = []
    labels: list[str] = []
    for kind in _TITLES:
        noise = max((noise for noise in LEVELS if noise.kind == kind), key=lambda noise: noise.level)
        episode = evaluator.noisy_example(noise)
        if episode is None:
            continue
        first = f"{noise.constraint}, {noise.label}: {episode.meta['object']}"
        frames, captions = episode_strip(episode, _FRAMES, _SIZE, first, ", held")
        images += frames
        labels += captions
    if not images:
        return
    text = "Requested: the blue hand or the violet path, with noise. Executed: the grey hand"
    save_png(folder / "noise_examples.png", contact_sheet(images, labels, columns=_FRAMES, title=text))


def draw_curves(rows: Sequence[Row], path: pathlib.Path, title: str) -> None:
    """Draws success and errors against the noise, a panel for each kind, as PNG.

    Args:
      rows: rows of `LEVELS`, in that order.
      path: the file to write.
      title: title of the figure.

    Raises:
      CongraspError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.0 * len(_TITLES), 5.6), layout="constrained", facecolor="white")
    figure.suptitle(title, x=0.01, ha="left", fontsize=13, fontweight="bold")
    grid = figure.subplots(2, len(_TITLES), sharex="col")
    pairs = list(zip(LEVELS, rows, strict=True))
    for (above, below), (kind, heading) in zip(grid.T, _TITLES.items(), strict=True):
        constraint = next(noise.constraint for noise, _ in pairs if noise.kind == kind)
        shown = [(n, row) for n, row in pairs if n.kind == kind or (not n.kind and n.constraint == constraint)]
        unit, factor = ("rad", 1.0) if kind == "joints" else ("cm", 100.0)
        x = [factor * noise.level for noise, _ in shown]
        _rate(above, x, [row for _, row in shown], "success", _SUCCESS, "success")
        _rate(above, x, [row for _, row in shown], "held_2s", _HELD, "held for 2 s")
        above.set_title(heading, loc="left", fontsize=9)
        above.set_ylim(0, 102)
        above.set_ylabel("%")
        above.legend(frameon=False, fontsize=8, loc="lower left")
        prefix = "pose" if constraint == "pose" else "traj"
        _errors(below, x, [row for _, row in shown], prefix)
        below.set_xlabel(f"{kind}, {unit}")
        for axes in (above, below):
            axes.spines[["top", "right"]].set_visible(False)
            axes.grid(color="#e3e6ea")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    write_atomically(path, buffer.getvalue())


def _rate(axes: Any, x: Sequence[float], rows: Sequence[Row], name: str, colour: str, label: str) -> None:
    """Draws a rate of `Row` in per cent with its interval."""
    low, middle, high = ([100 * (getattr(row, f"{name}{end}") or 0.0) for row in rows] for end in ("_low", "", "_high"))
    axes.plot(x, middle, "o-", color=colour, label=label)
    axes.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)


def _errors(axes: Any, x: Sequence[float], rows: Sequence[Row], prefix: str) -> None:
    """Draws the mean errors of a constraint: angle in rad, length in dm."""
    for name, factor, unit, colour in (("rad", 1.0, "rad", _ANGLE), ("m", 10.0, "dm", _LENGTH)):
        values = [factor * value if (value := row.errors[f"{prefix}_{name}"]) is not None else np.nan for row in rows]
        axes.plot(x, values, "s-", color=colour, label=f"error, {unit}")
    axes.set_ylim(0, 1.1 * axes.get_ylim()[1])
    axes.legend(frameon=False, fontsize=8)
