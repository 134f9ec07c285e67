"""Rows of an evaluation, against numbers worked out by hand, and causes of failures."""

import dataclasses
import io
import itertools
import json

import numpy as np
import pytest
from rich.console import Console

from congrasp.common.episode.episode import Episode
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import blocks
from congrasp.services.evaluate.columns import SCORE_CELLS, tables_of
from congrasp.services.evaluate.episodes import MAX_PROBED_EPISODES, Sample, join_samples
from congrasp.services.evaluate.intervals import clustered_interval, independent_episodes, wilson
from congrasp.services.evaluate.object_groups import object_groups
from congrasp.services.evaluate.paper.figures import CENTER_GROUP, paper_row
from congrasp.services.evaluate.pictures import cause
from congrasp.services.evaluate.scores import TABLES, write_json
from tests.episodes import episode
from tests.rows import row as made_row
from tests.rows import summarised

TASK = TaskConfig()
BLOCKS = blocks(TASK)
REQUIRED = (
    *(
        "constraint",
        "hand",
        "method",
        "episodes",
        "success",
        "heading_rad",
        "heading_m",
        "pose_rad",
        "pose_m",
    ),
    *(
        "traj_rad",
        "traj_m",
        "affordance_ratio",
        "fingers_ratio",
        "force_ratio",
        "success_low",
        "success_high",
    ),
    *("success_all", "held_all", "distinct", "mass_kg"),
)


def _sample(success, held, **columns) -> Sample:
    count = len(success)
    names = (
        "return",
        "links_at_removal",
        "diverged",
        "object_index",
        "heading_rad",
        "heading_m",
        "pose_rad",
        "pose_m",
    )
    names += (
        "trajectory_rad",
        "trajectory_m",
        "affordance_ratio",
        "fingers_ratio",
        "force_ratio",
        *(f"mask_{name}" for name in BLOCKS),
    )
    values = {name: np.zeros(count, np.float32) for name in names}
    values |= {"identity": np.arange(count, dtype=np.uint32), "mass_kg": np.full(count, 0.2)}
    values |= {"success": np.array(success, np.float32), "held": np.array(held, np.float32)}
    values |= {
        name: np.array(column, values.get(name, np.zeros(0)).dtype)
        for name, column in columns.items()
    }
    return Sample(values, np.zeros((count, 1, 2), np.float16), np.zeros((count, 1, 3), np.float16))


def test_a_row_averages_over_successful_episodes():
    sample = _sample(
        [1, 1, 0, 1],
        [1, 0, 0, 1],
        pose_rad=[0.1, 0.3, 9.0, 0.2],
        pose_m=[0.01, 0.03, 9.0, 0.02],
        trajectory_rad=[0.4, 0.5, 9.0, 0.6],
        heading_rad=[7.0, 7.0, 7.0, 7.0],
        object_index=[3, 3, 5, 4],
        diverged=[0, 0, 1, 0],
    )
    sample.link_force[:, 0] = [[2, 0], [4, 6], [100, 100], [0, 0]]
    sample.torque[:, 0] = [[0.5, 0.5, 0.5], [0.0, 0.0, 1.0], [1, 1, 1], [0.0, 0.0, 0.5]]
    row = summarised(
        "pose+trajectory", "human", sample, held_2s=True, objects=list("abcdefg"), paper="captured"
    )
    assert row.episodes == 4
    assert row.covered == 3
    assert row.pool == 7
    assert row.success == 0.75
    assert row.held_2s == 0.5
    assert row.diverged == 0.25
    assert [(of["name"], of["episodes"], of["success"]) for of in row.objects] == [
        ("d", 2, 1.0),
        ("e", 1, 1.0),
        ("f", 1, 0.0),
    ]
    objects = sample.values["object_index"]
    assert (row.success_low, row.success_high) == clustered_interval(
        np.array([1, 1, 0, 1]), objects
    )
    assert (row.held_2s_low, row.held_2s_high) == clustered_interval(
        np.array([1, 0, 0, 1]), objects
    )
    assert row.errors["pose_rad"] == pytest.approx(0.2)
    assert row.errors["pose_m"] == pytest.approx(0.02)
    assert row.errors["traj_rad"] == pytest.approx(0.5)
    assert row.errors["heading_rad"] is None
    assert row.errors["affordance_ratio"] is None
    assert row.forces["link_force_mean"] == pytest.approx(4.0)  # of the links that touch: 2, 4, 6
    assert row.forces["link_force_p95"] == pytest.approx(5.8)
    assert row.forces["force_sum_mean"] == pytest.approx(4.0)  # 2, 10, 0
    assert row.forces["torque_share_mean"] == pytest.approx(3.0 / 9)
    assert row.paper is not None
    assert row.paper.success == 0.865


def test_uncovered_objects_count_as_failures():
    """Five objects, of which three are covered: rates 1, 1/2 and 0 are 0.5 of three, and 0.3 of
    five.
    """
    sample = _sample([1, 1, 1, 0, 0, 0], [1, 0, 1, 0, 0, 0], object_index=[0, 0, 2, 2, 4, 4])
    row = summarised("affordance", "human", sample, held_2s=True, objects=list("abcde"))
    assert row.covered == 3
    assert row.pool == 5
    assert row.success == 0.5
    assert row.success_all == pytest.approx(0.3)
    assert row.held_2s == pytest.approx(1 / 3)
    assert row.held_all == pytest.approx(0.2)
    assert SCORE_CELLS["of all objects"](row) == "30.0 %, 20.0 %"
    # Of a group of three of the five there is no uncovered object.
    assert (
        summarised(
            "heading", "human", sample, held_2s=True, objects=list("abcde"), pool=3
        ).success_all
        == 0.5
    )


def test_an_episode_that_repeats_counts_once_and_clusters_widen_the_interval():
    repeated = _sample(
        [1] * 8 + [0] * 8, [0] * 16, identity=[0] * 8 + [1] * 8, object_index=[0] * 8 + [1] * 8
    )
    row = summarised("pose", "human", repeated, held_2s=True, objects=["a", "b"])
    assert row.episodes == 16
    assert row.distinct == 2
    assert row.independent == pytest.approx(1.0)
    assert SCORE_CELLS["episodes"](row) == "16 (2 different)"
    spread = summarised(
        "pose", "human", _sample([1] * 8 + [0] * 8, [0] * 16), held_2s=True, objects=["a"]
    )
    assert spread.distinct == 16
    assert row.success_low < spread.success_low < spread.success_high < row.success_high
    # Sequences of one object are the clusters where references are.
    clustered = _sample([1, 1, 0, 0], [0] * 4, reference=[7, 7, 9, 9])
    row = summarised("pose", "human", clustered, held_2s=True, objects=["a"], by_reference=True)
    assert row.independent == pytest.approx(1.0)


def test_a_row_without_success_has_no_errors_and_short_episodes_no_hold():
    row = summarised("heading", "human", _sample([0, 0], [0, 0]), held_2s=False, objects=["a"])
    assert row.success == 0
    assert row.held_2s is None
    assert row.held_2s_low is None
    assert set(row.errors.values()) == {None}
    assert set(row.forces.values()) == {None}


@pytest.mark.parametrize(
    ("source", "hand", "method", "constraint", "group", "success"),
    [
        ("hands", "human", "ours", "pose", "", 0.964),
        ("captured", "human", "ours", "pose", "", 0.874),
        ("captured", "allegro", "ours", "pose", "", None),
        ("captured", "human", "dgrasp", "pose", "", 0.512),
        ("captured", "human", "ours", "pose+trajectory", "", 0.865),
        ("captured", "human", "ours", "pose+trajectory", "aligned pairs", None),
        ("hands", "human", "ours", "pose+trajectory", "", None),
        ("hands", "human", "graspxl", "heading", "", None),
        ("cross", "human", "ours", "trajectory", "", 0.733),
        ("objects", "human", "graspxl", "heading", "large (above 9 cm)", 0.79),
        ("objects", "human", "ours", "heading", "heavy (above 300 g)", None),
        ("", "human", "ours", "heading", "", None),
    ],
)
def test_rows_are_matched_by_equal_settings(source, hand, method, constraint, group, success):
    row = paper_row(source, hand, method, constraint, group)
    assert (row and row.success) == success


def test_joined_samples_keep_forces_beside_their_episodes():
    parts = [
        _sample([1] * 3, [1] * 3).first(2),
        _sample([1] * (MAX_PROBED_EPISODES + 5), [1] * (MAX_PROBED_EPISODES + 5)),
    ]
    parts[0].link_force[:] = 1.0
    sample = join_samples(parts)
    assert len(sample.values["success"]) == MAX_PROBED_EPISODES + 7
    assert len(sample.link_force) == MAX_PROBED_EPISODES
    assert sample.link_force[:2].min() == 1.0
    assert sample.link_force[2:].max() == 0.0
    # What follows a sample without all its forces must not move up to another episode's place.
    late = join_samples([sample, parts[0]])
    assert len(late.values["success"]) == MAX_PROBED_EPISODES + 9
    assert len(late.link_force) == MAX_PROBED_EPISODES
    odd = late.where(np.arange(MAX_PROBED_EPISODES + 9) % 2 == 1)
    assert len(odd.link_force) == MAX_PROBED_EPISODES // 2
    assert odd.link_force[0].min() == 1.0


def test_peak_and_mean_of_the_strongest_links_force():
    """By hand: two episodes of two steps and two links; peaks 4 and 8 N, strongest links 3, 4, 8
    and 1 N.
    """
    force = np.array([[[3, 1], [0, 4]], [[8, 2], [1, 0]]], np.float16)
    sample = dataclasses.replace(_sample([1, 1], [1, 1]), link_force=force)
    row = summarised("heading", "human", sample, held_2s=True, objects=["a"]).to_json()
    assert row["force_peak_n"] == 6.0
    assert row["force_mean_n"] == 4.0


def test_objects_are_grouped_by_terciles_and_family():
    sizes = np.array([0.03, 0.09, 0.06, 0.12, 0.15, 0.18])
    masses = np.array([0.6, 0.5, 0.4, 0.3, 0.2, 0.1])
    groups = dict(
        object_groups(sizes, masses, np.array(["mug", "ball", "mug", "mug", "ball", "ball"]))
    )
    by_word = {
        label.split(" (")[0]: set(np.flatnonzero(members).tolist())
        for label, members in groups.items()
    }
    assert by_word["small"] == {0, 2}
    assert by_word["medium"] == {1, 3}
    assert by_word["large"] == {4, 5}
    assert by_word["light"] == {4, 5}
    assert by_word["heavy"] == {0, 1}
    assert by_word["family mug"] == {0, 2, 3}
    assert by_word["family ball"] == {1, 4, 5}


def test_the_file_has_the_fixed_fields_and_the_table_a_line_a_row(tmp_path):
    names = dict.fromkeys(itertools.chain.from_iterable(TABLES.values()))
    objects = list("abcdefgh")
    rows = [
        summarised(name, "human", _sample([1, 0], [1, 0]), held_2s=True, objects=objects)
        for name in names
    ]
    rows.append(dataclasses.replace(rows[0], group="small (up to 8 cm)", paper=None))
    write_json(rows, tmp_path / "new" / "rows.json", {"seed": 0})
    read = json.loads((tmp_path / "new" / "rows.json").read_text())
    assert read["seed"] == 0
    assert len(read["rows"]) == len(rows) == 10
    for row in read["rows"]:
        assert set(REQUIRED) <= set(row)
        assert row["method"] == "ours"
    assert read["rows"][0]["pose_rad"] is None
    assert read["rows"][0]["heading_rad"] == 0.0
    assert all(
        table.terminal().row_count == len(table.rows) == 10 for table in tables_of(rows, "title")
    )


def test_rows_of_several_policies_stand_together_and_missing_ones_are_named():
    rows = [
        made_row(name, 0.9, 0.8, 0.95, method=method)
        for method, name in itertools.product(("ours", "pd"), ("heading", "pose"))
    ]
    rates, *_ = tables_of(rows, "title", [("human", "graspxl", "not trained")])
    assert rates.columns[:3] == ["constraint", "hand", "method"]
    assert [row[0] for row in rates.rows] == ["heading", "heading", "pose", "pose", "not trained"]
    assert [row[2] for row in rates.rows] == ["ours", "pd", "ours", "pd", "graspxl"]
    alone, *_ = tables_of(rows[:2], "title")
    assert alone.columns[:2] == ["constraint", "episodes"]


def test_a_terminal_shows_every_figure_of_several_policies():
    """A long title is broken, and not the figures."""
    held = {"held_2s": 1.0, "held_2s_low": 0.342, "held_2s_high": 1.0}
    rows = [
        dataclasses.replace(
            made_row("heading", 1.0, 0.342, 1.0, hand=hand, method=method, group=CENTER_GROUP),
            **held,
        )
        for hand, method in (("human", "no-dynamic-center"), ("allegro", "ours"))
    ]
    console = Console(width=160, file=io.StringIO())
    console.print(tables_of(rows, "title")[0].terminal())
    printed = console.file.getvalue()
    assert "\N{HORIZONTAL ELLIPSIS}" not in printed
    assert "episodes" in printed
    assert "objects" in printed
    assert printed.count("100.0 % (34.2-100.0)") == 4
    assert printed.count("0.000 rad") >= 2


def test_the_margin_of_a_mean_error_is_1_96_standard_errors():
    sample = _sample(
        [1, 1, 1, 0], [0, 0, 0, 0], heading_rad=[0.1, 0.2, 0.3, 9.0], heading_m=[0.5, 0.5, 0.5, 9.0]
    )
    row = summarised("heading", "human", sample, held_2s=True, objects=["box"])
    # Standard deviation 0.1 of three values: 1.96 x 0.1 / sqrt(3).
    assert row.margins == pytest.approx({"heading_rad": 0.113161, "heading_m": 0.0}, abs=1e-5)
    only = summarised("heading", "human", sample.first(1), held_2s=True, objects=["box"])
    assert only.margins == {}
    assert only.errors["heading_rad"] == pytest.approx(0.1)


def test_wilson_interval():
    # n = 10, p = 0.8, z = 1.96: centre (0.8 + 0.19207) / 1.38415, half width 1.96 sqrt(0.016 +
    # 0.0096036) / 1.38415.
    assert wilson(0.8, 10) == pytest.approx((0.49016, 0.94332), abs=1e-5)
    # No success: 0 to z^2 / (n + z^2).
    assert wilson(0.0, 10) == pytest.approx((0.0, 3.84146 / 13.84146), abs=1e-5)
    assert wilson(1.0, 1000) == pytest.approx((1000 / 1003.84146, 1.0), abs=1e-6)
    assert wilson(0.0, 0) == (0.0, 1.0)


def test_clusters_count_by_the_design_effect():
    """By hand: rates 1, 1/2, 1/2 and 0 of four clusters of four, p = 1/2, sums off the mean 2, 0, 0
    and -2.

    The robust variance is 4/3 * 8 / 16^2 = 1/24, that of 16 independent episodes 1/64: the design
    effect is 8/3.
    """
    outcomes = np.array([1, 1, 1, 1, 1, 0, 1, 0, 0, 1, 0, 1, 0, 0, 0, 0], bool)
    clusters = np.repeat([7, 3, 5, 1], 4)
    assert independent_episodes(outcomes, clusters) == pytest.approx(6.0)
    # n = 6, p = 1/2: half width 1.96 sqrt(1/24 + 0.026677) / 1.640243.
    assert clustered_interval(outcomes, clusters) == pytest.approx((0.18761, 0.81239), abs=1e-4)


def test_an_interval_is_never_narrower_than_that_of_independent_episodes():
    alternating = np.tile([1, 0], 8)
    clusters = np.repeat(np.arange(8), 2)
    assert independent_episodes(alternating, clusters) == 16.0
    # G / (G - 1), as of a sample's variance
    assert independent_episodes(alternating, np.arange(16)) == 15.0


def test_clusters_that_end_alike_count_once():
    assert independent_episodes(np.ones(20, bool), np.repeat(np.arange(5), 4)) == 5.0
    assert clustered_interval(np.ones(20, bool), np.repeat(np.arange(5), 4)) == wilson(1.0, 5.0)
    assert independent_episodes(np.array([1, 0, 1, 1]), np.zeros(4)) == 4.0, "one object alone"


# --- causes of failures ---


def lost(heights, **metrics) -> Episode:
    """Two steps with the table, then one without for every further height."""
    count = len(heights)
    position = np.zeros((count, 3), np.float32)
    position[:, 2] = heights
    episode_metrics = {
        "diverged": 0.0,
        "held": 0.0,
        "moved_at_removal": 0.01,
        "links_at_removal": 3.0,
    }
    return dataclasses.replace(
        episode(count),
        object_position=position,
        table=np.arange(count) < 2,
        metrics=episode_metrics | metrics,
        control_dt=0.01,
        about={},
    )


@pytest.mark.parametrize(
    ("metrics", "said"),
    [
        ({"held": 1.0}, "held"),
        ({"diverged": 1.0, "links_at_removal": 0.0}, "the physics diverged"),
        ({"moved_at_removal": 0.06}, "pushed away before the table was removed"),
        ({"links_at_removal": 0.0}, "not touched when the table was removed"),
        ({}, "slipped 0.03 s after the table was removed"),
    ],
)
def test_every_cause_has_its_label(metrics, said):
    assert cause(lost([0.3, 0.3, 0.2, 0.19, 0.16, 0.149, 0.1], **metrics), 0.05) == said


def test_slip_in_a_lift_is_relative_to_the_wrist():
    made = lost([0.1] * 8)
    links = np.zeros_like(made.link_position)
    links[:, :, 2] = np.array([0.2, 0.2, 0.2, 0.22, 0.24, 0.26, 0.28, 0.3])[:, None]
    lifted = dataclasses.replace(
        made,
        link_position=links,
        table=np.ones(8, bool),
        about={"phases": {"grasp": 0.0, "lift": 0.02}},
    )
    assert cause(lifted, 0.05) == "slipped 0.03 s after the lift began"
