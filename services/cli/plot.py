"""`congrasp plot`: figures of a run or of an evaluation."""

import pathlib
from typing import Annotated, Literal

import tyro

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import check_output


def plot(
    paths: Annotated[tuple[pathlib.Path, ...], tyro.conf.Positional],
    out: pathlib.Path | None = None,
    formats: tuple[Literal["png", "pdf"], ...] = ("png", "pdf"),
) -> int:
    """Draw a run's learning curves, reward terms and other metrics, or an evaluation's table, rates
    and errors.

    Args:
      paths: Folders of runs or MCAP files, whose curves are drawn into the same figures, or one
        JSON file of 'congrasp evaluate --json'. The last half second of a run in progress is
        missing.
      out: Folder for the figures; by default 'plots' next to the recordings or the JSON file.
        Required for several runs.
      formats: File formats of the figures.

    Examples:
      congrasp plot runs/mine
      congrasp plot runs/mine runs/other --out plots --formats png
    """
    from congrasp.services.evaluate.plots import plot_evaluation
    from congrasp.services.viz.plots import plot_runs

    evaluations = [path for path in paths if path.suffix == ".json"]
    if not paths:
        raise CongraspError(
            "No run was given.", "Pass the folders of runs: congrasp plot runs/mine"
        )
    if len(paths) > 1 and evaluations:
        raise CongraspError(
            f"{evaluations[0]} cannot be combined with other files.", "Only runs can be overlaid."
        )
    if len(paths) > 1 and out is None:
        raise CongraspError(
            "The figures of several runs have no default folder.", "Pass a folder with --out."
        )
    source_folder = paths[0] if paths[0].is_dir() else paths[0].parent
    folder = out or source_folder / "plots"
    check_output("--out", folder, is_folder=True)
    if evaluations:
        files = plot_evaluation(paths[0], folder, formats)
    else:
        files = plot_runs(paths, folder, formats)
    for file in files:
        print(file)
    return 0


COMMAND = plot
