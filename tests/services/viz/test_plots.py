"""Figures of runs and of evaluations: every metric once, and what their files say."""

import itertools
import json
import pathlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from congrasp.common.errors import CongraspError
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.metrics import episode_fields, metric_names
from congrasp.services.cli.plot import plot
from congrasp.services.evaluate.episodes import Sample
from congrasp.services.evaluate.plots import comparison_table, plot_evaluation
from congrasp.services.evaluate.scores import Row, write_json
from congrasp.services.record.writer import JsonChannels, LogWriter, nest
from congrasp.services.viz.metric_titles import titled
from congrasp.services.viz.plots import LEARNING, Panel, draw, figures, plot_runs, smooth
from tests.children import python
from tests.rows import summarised

METRICS = {
    "episode/return": 3.0,
    "episode/success": 0.5,
    "episode/heading_rad": 0.3,
    "term/contact": 1.0,
    "term/force_excess": -0.1,
    "kl": 0.01,
    "steps_per_second": 900.0,
    "staleness_mean": 0.5,
    "staleness_max": 1.0,
    "queue_length": 2.0,
}


def record(directory: pathlib.Path, updates: int = 30) -> None:
    writer = LogWriter(directory, "log")
    channels = JsonChannels()
    for i in range(updates):
        values = nest({name: value * (1 + i / updates) for name, value in METRICS.items()})
        writer.write(channels.entry("/metrics/learner/0", i, {"update": i, "values": values}))
        writer.write(
            channels.entry(
                "/metrics/actor/a0", i, {"version": i, "values": {"steps_per_second": 400.0}}
            )
        )
    writer.close()


def test_settings_of_matplotlib_change_no_figure(tmp_path: pathlib.Path) -> None:
    record(tmp_path / "run")
    expected = plot_runs([tmp_path / "run"], tmp_path / "expected", ["png"])
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\nfont.size: 40\n")
    leftovers = {"MPLBACKEND": "module://absent", "MATPLOTLIBRC": str(tmp_path)}
    words = ("plot", tmp_path / "run", "--out", tmp_path / "drawn", "--formats", "png")
    done = python("-m", "congrasp", *words, env=leftovers)
    assert done.returncode == 0, done.stderr
    for file in expected:
        assert (tmp_path / "drawn" / file.name).read_bytes() == file.read_bytes()


def test_every_metric_is_in_exactly_one_panel() -> None:
    series = {f"learner/0/{name}": (np.arange(3), np.arange(3.0)) for name in METRICS}
    groups = figures({"run": series})
    plotted = []
    for _, panels in groups.values():
        for panel in panels:
            plotted += panel.metrics
    assert sorted(plotted) == sorted(METRICS)
    assert [panel.metrics for panel in groups["reward_terms"][1]] == [
        ("term/contact",),
        ("term/force_excess",),
    ]
    assert groups["episodes"][1] == [Panel("Heading error: angle", "rad", ("episode/heading_rad",))]
    assert groups["details"][1] == [Panel("Queue length", "", ("queue_length",))]
    assert {panel.title for panel in groups["learning"][1]} == {
        panel.title for panel in LEARNING if set(panel.metrics) & set(METRICS)
    }


def test_a_run_becomes_png_files(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(tmp_path / "run" / "logs")
    assert plot((tmp_path / "run",)) == 0
    files = [pathlib.Path(line) for line in capsys.readouterr().out.split()]
    figures = ("learning", "reward_terms", "episodes", "details")
    assert [file.name for file in files] == [
        f"{name}.{kind}" for name, kind in itertools.product(figures, ("png", "pdf"))
    ]
    assert all(file.read_bytes().startswith(b"%PDF-") for file in files if file.suffix == ".pdf")
    assert all(file.parent == tmp_path / "run" / "plots" for file in files)
    learning = np.asarray(Image.open(files[0]).convert("RGB")).astype(int)
    assert learning.shape[1] > 1200
    # The learner's and the actor's lines in their colours.
    for colour in ((0x2F, 0x6F, 0xDB), (0xE0, 0x8A, 0x2C)):
        assert (np.abs(learning - colour).sum(-1) < 10).sum() > 200


def test_runs_are_overlaid_and_constant_metrics_are_omitted(tmp_path: pathlib.Path) -> None:
    rising = np.arange(4.0)
    flat = np.full(4, 2.0)
    one = {
        "learner/0/kl": rising,
        "learner/0/term/drop": flat,
        "learner/0/term/contact": flat,
        "actor/a/queue": rising,
    }
    two = {
        "learner/0/kl": 2 * rising,
        "learner/0/term/drop": flat,
        "learner/0/term/contact": 3 * flat,
    }
    runs = {}
    for name, run in (("a", one), ("b", two)):
        runs[name] = {metric: (np.arange(4), values) for metric, values in run.items()}
    groups = figures(runs)
    assert [panel.metrics for panel in groups["reward_terms"][1]] == [("term/contact",)]
    figure = draw("Learning", groups["learning"][1], runs)
    (axes,) = [axes for axes in figure.axes if axes.get_lines()]
    for line, (name, values) in zip(
        axes.get_lines(), (("a", rising), ("b", 2 * rising)), strict=True
    ):
        assert line.get_label() == name
        np.testing.assert_array_equal(line.get_xydata(), np.stack([np.arange(4), values], -1))
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["a", "b"]
    with pytest.raises(CongraspError, match="--out"):
        plot((tmp_path / "a", tmp_path / "b"))


def test_every_metric_of_an_episode_has_a_different_title() -> None:
    task = TaskConfig(constraints=tuple(constraint.name for constraint in CONSTRAINTS))
    titles = {name: titled(name)[0] for name in episode_fields(task)}
    assert len(set(titles.values())) == len(titles)
    assert not [
        name
        for name, title in titles.items()
        if "_" in title or "/" in title or not title[0].isupper()
    ]
    assert titled("episode/heading_m") == ("Heading error: distance", "m")
    assert titled("term/force_excess") == ("Force excess", "reward")
    assert titled("failure/bowl") == ("Lost objects: bowl", "share of episodes")
    assert titled("fetch_seconds") == ("Fetch", "s")


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=40), st.integers(1, 12))
def test_smoothing_is_the_mean_of_the_last_values(values: list[float], window: int) -> None:
    expected = [np.mean(values[max(0, i - window + 1) : i + 1]) for i in range(len(values))]
    np.testing.assert_allclose(smooth(np.array(values), window), expected, atol=1e-9)


def test_smoothing_ignores_nan_and_keeps_constants() -> None:
    np.testing.assert_allclose(
        smooth(np.array([np.nan, 1.0, np.nan, 3.0]), 3), [np.nan, 1.0, 1.0, 2.0]
    )
    assert (smooth(np.full(500, 5e-4), 12) == 5e-4).all()


def test_recordings_without_metrics_are_an_error(tmp_path: pathlib.Path) -> None:
    with pytest.raises(CongraspError, match="no recording"):
        plot_runs([tmp_path], tmp_path)
    LogWriter(tmp_path / "logs", "log").close()
    writer = LogWriter(tmp_path / "logs", "log")
    writer.write(JsonChannels().entry("/version/learner/0", 0, {"version": 1}))
    writer.close()
    with pytest.raises(CongraspError, match="no metrics"):
        plot_runs([tmp_path], tmp_path)


# --- evaluations ---


TASK = TaskConfig(constraints=tuple(constraint.name for constraint in CONSTRAINTS))
MEASURED = metric_names(TASK)


def evaluation(path: pathlib.Path) -> list[dict]:
    """Three rows of 40 episodes, of which 30 succeeded with errors that rise evenly from 0.1 to
    0.4.
    """
    rows = []
    for constraint in ("heading", "trajectory+affordance", "fingers"):
        values = {name: np.zeros(40) for name in (*MEASURED, "mass_kg", "identity")}
        values["success"][:30] = 1
        for name in MEASURED:
            if name.endswith(("_rad", "_m", "_ratio")):
                values[name] = np.concatenate([np.linspace(0.1, 0.4, 30), np.full(10, 9.0)])
        sample = Sample(values, np.zeros((0, 1, 1)), np.zeros((0, 1, 1)))
        rows.append(
            summarised(constraint, "human", sample, held_2s=True, objects=["box"], paper="captured")
        )
    write_json(rows, path, {})
    return json.loads(path.read_text())["rows"]


def test_quantiles_are_of_the_successful_episodes(tmp_path: pathlib.Path) -> None:
    heading, composed, fingers = evaluation(tmp_path / "e.json")
    np.testing.assert_allclose(
        heading["quantiles"]["heading_rad"], np.linspace(0.1, 0.4, 101), atol=1e-6
    )
    assert set(heading["quantiles"]) == {"heading_rad", "heading_m"}
    assert set(composed["quantiles"]) == {"traj_rad", "traj_m", "affordance_ratio"}
    assert set(fingers["quantiles"]) == {"fingers_ratio"}


def test_the_table_has_every_row_with_the_paper_s(tmp_path: pathlib.Path) -> None:
    table = comparison_table([Row.from_json(row) for row in evaluation(tmp_path / "e.json")])
    heading, composed, fingers = table.rows
    assert heading[:5] == ["heading", "40", "75.0 % (59.8-85.8)", "96.9 %", "0.0 %"]
    at = table.columns.index("Heading error, rad")
    assert heading[at : at + 2] == ["0.250", "0.137"]
    assert composed[at : at + 2] == ["", ""]
    at = table.columns.index("Affordance error, share")
    assert composed[at : at + 2] == ["0.250", "0.045"]
    at = table.columns.index("Fingers error, share")
    assert fingers[at : at + 2] == ["0.250", ""]


def test_rows_of_several_policies_have_different_labels(tmp_path: pathlib.Path) -> None:
    heading, *_ = evaluation(tmp_path / "e.json")
    rows = [Row.from_json(row) for row in (heading, {**heading, "method": "pd", "group": "small"})]
    assert [line[0] for line in comparison_table(rows).rows] == [
        "heading, human, ours",
        "heading, small, human, pd",
    ]


def test_an_evaluation_becomes_png_and_pdf(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    evaluation(tmp_path / "e.json")
    assert plot((tmp_path / "e.json",)) == 0
    files = [pathlib.Path(line) for line in capsys.readouterr().out.split()]
    assert [f.name for f in files] == [
        f"{n}.{k}" for n, k in itertools.product(("table", "success", "errors"), ("png", "pdf"))
    ]
    starts = {".png": b"\x89PNG", ".pdf": b"%PDF-"}
    assert all(file.read_bytes().startswith(starts[file.suffix]) for file in files)


def test_other_files_are_refused(tmp_path: pathlib.Path) -> None:
    (tmp_path / "a.json").write_text("[1]")
    with pytest.raises(
        CongraspError, match=r"a\.json is not the result of an evaluation .*evaluate --json"
    ):
        plot_evaluation(tmp_path / "a.json", tmp_path, ("png",))
    with pytest.raises(CongraspError, match="cannot be read"):
        plot_evaluation(tmp_path / "b.json", tmp_path, ("png",))
