"""`congrasp plot`: figures of a run or of an evaluation."""

import pathlib
from typing import Annotated, Literal

import tyro


def plot(
    path: Annotated[pathlib.Path, tyro.conf.Positional],
    out: pathlib.Path | None = None,
    formats: tuple[Literal["png", "pdf"], ...] = ("png", "pdf"),
) -> int:
    """Draw a run's learning curves, reward terms and other metrics, or an evaluation's table, rates and errors.

    Args:
      path: A run's folder, or one MCAP file; a run that is not over is drawn up to its last half second. Or the JSON
        file of 'congrasp evaluate --json'.
      out: Folder for the figures; 'plots' beside the recordings or the JSON file otherwise.
      formats: Of the files.

    Examples:
      congrasp plot runs/mine
      congrasp plot runs/mine runs/other --out plots --formats png
    """
    from services.evaluate.plots import plot_evaluation
    from services.viz.plots import plot_run

    folder = out or (path if path.is_dir() else path.parent) / "plots"
    draw = plot_evaluation if path.suffix == ".json" else plot_run
    for file in draw(path, folder, formats):
        print(file)
    return 0


COMMAND = plot
