"""`congrasp plot`."""

import pathlib
from typing import Annotated

import tyro


def plot(path: Annotated[pathlib.Path, tyro.conf.Positional], out: pathlib.Path | None = None) -> int:
    """Draw a run's learning curves, reward terms and other metrics to PNG.

    Args:
      path: A run's folder, or one MCAP file. A run that still goes on is drawn up to its last half second.
      out: Folder for the figures; 'plots' beside the recordings otherwise.
    """
    from services.plot import plot_run

    folder = out or (path if path.is_dir() else path.parent) / "plots"
    for file in plot_run(path, folder):
        print(file)
    return 0


COMMAND = plot
