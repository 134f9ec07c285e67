"""The figures of an evaluation agree with its JSON."""

import json
import pathlib

import numpy as np
import pytest

from congrasp.actors.env import metric_names
from congrasp.common.errors import CongraspError
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.services.cli.plot import plot
from congrasp.services.evaluate.episodes import Sample
from congrasp.services.evaluate.plots import compared, plot_evaluation
from congrasp.services.evaluate.scores import Row, summarise, write_json

TASK = TaskConfig(constraints=tuple(constraint.name for constraint in CONSTRAINTS))
METRICS = metric_names(TASK)


def evaluation(path: pathlib.Path) -> list[dict]:
    """Three rows of 40 episodes, of which 30 succeeded with errors that rise evenly from 0.1 to 0.4."""
    rows = []
    for constraint in ("heading", "trajectory+affordance", "fingers"):
        values = {name: np.zeros(40) for name in (*METRICS, "mass_kg", "identity")}
        values["success"][:30] = 1
        for name in METRICS:
            if name.endswith(("_rad", "_m", "_ratio")):
                values[name] = np.concatenate([np.linspace(0.1, 0.4, 30), np.full(10, 9.0)])
        sample = Sample(values, np.zeros((0, 1, 1)), np.zeros((0, 1, 1)))
        rows.append(summarise(constraint, "human", sample, held_2s=True, objects=["box"], paper="captured"))
    write_json(rows, path, {})
    return json.loads(path.read_text())["rows"]


def test_quantiles_are_of_the_successful_episodes(tmp_path: pathlib.Path) -> None:
    heading, composed, fingers = evaluation(tmp_path / "e.json")
    np.testing.assert_allclose(heading["quantiles"]["heading_rad"], np.linspace(0.1, 0.4, 101), atol=1e-6)
    assert set(heading["quantiles"]) == {"heading_rad", "heading_m"}
    assert set(composed["quantiles"]) == {"traj_rad", "traj_m", "affordance_ratio"}
    assert set(fingers["quantiles"]) == {"fingers_ratio"}


def test_the_table_has_every_row_with_the_paper_s(tmp_path: pathlib.Path) -> None:
    table = compared([Row.from_json(row) for row in evaluation(tmp_path / "e.json")])
    heading, composed, fingers = table.rows
    assert heading[:5] == ["heading", "40", "75.0 % (59.8-85.8)", "96.9 %", "0.0 %"]
    at = table.columns.index("Heading error, rad")
    assert heading[at : at + 2] == ["0.250", "0.137"] and composed[at : at + 2] == ["", ""]
    at = table.columns.index("Affordance error, share")
    assert composed[at : at + 2] == ["0.250", "0.045"]
    at = table.columns.index("Fingers error, share")
    assert fingers[at : at + 2] == ["0.250", ""]


def test_rows_of_several_policies_have_different_labels(tmp_path: pathlib.Path) -> None:
    heading, *_ = evaluation(tmp_path / "e.json")
    rows = [Row.from_json(row) for row in (heading, {**heading, "method": "pd", "group": "small"})]
    assert [line[0] for line in compared(rows).rows] == ["heading, human, ours", "heading, small, human, pd"]


def test_an_evaluation_becomes_png_and_pdf(tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    evaluation(tmp_path / "e.json")
    assert plot((tmp_path / "e.json",)) == 0
    files = [pathlib.Path(line) for line in capsys.readouterr().out.split()]
    assert [f.name for f in files] == [f"{n}.{k}" for n in ("table", "success", "errors") for k in ("png", "pdf")]
    starts = {".png": b"\x89PNG", ".pdf": b"%PDF-"}
    assert all(file.read_bytes().startswith(starts[file.suffix]) for file in files)


def test_other_files_are_refused(tmp_path: pathlib.Path) -> None:
    (tmp_path / "a.json").write_text("[1]")
    with pytest.raises(CongraspError, match=r"a\.json is not the result of an evaluation .*evaluate --json"):
        plot_evaluation(tmp_path / "a.json", tmp_path, ("png",))
    with pytest.raises(CongraspError, match="cannot be read"):
        plot_evaluation(tmp_path / "b.json", tmp_path, ("png",))
