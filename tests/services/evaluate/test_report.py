"""A report is one file that needs nothing beside it, and says where a policy is better or worse
than the paper's.
"""

import base64
import dataclasses
import html
import io
import json

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.files import hand_sha256
from congrasp.common.hands.skin import skin_of
from congrasp.common.policy import bundle as bundles
from congrasp.common.task.config import SensingConfig, TaskConfig
from congrasp.services.assets.hands.findings import Finding, write_findings
from congrasp.services.cli import main
from congrasp.services.evaluate.model_card import limits, model_card
from congrasp.services.evaluate.pages import Picture, count_causes, curves_of
from congrasp.services.evaluate.pictures import turntable
from congrasp.services.evaluate.report import Commands, ReportContent, write_report
from congrasp.services.evaluate.tables import Evaluation
from congrasp.services.record.writer import JsonChannels, LogWriter
from congrasp.services.train.command import untrained
from congrasp.services.viz.hand_shapes import skin_shape
from congrasp.services.viz.sheets import save_png
from tests import task
from tests.episodes import episode
from tests.pages import Reader
from tests.rows import row as made_row

ERRORS = {"heading_rad": 0.07, "heading_m": 0.013}


def row(constraint, success, low, high):
    source = "hands" if constraint == "pose" else "captured"
    return made_row(constraint, success, low, high, source=source, errors=ERRORS)


@pytest.fixture
def policy():
    return task.policy()


def test_a_report_holds_its_tables_and_pictures(tmp_path, policy):
    save_png(tmp_path / "p.png", np.full((6, 8, 3), 200, np.uint8))
    png = (tmp_path / "p.png").read_bytes()
    rows = [
        row("heading", 0.99, 0.975, 0.995),
        row("pose", 0.9, 0.85, 0.95),
        row("trajectory", 0.96, 0.93, 0.98),
    ]
    out = tmp_path / "report.html"
    commands = Commands("congrasp evaluate --policy <mine>", "", "congrasp plot x")
    sheets = [Picture("heading", png, "2 held, 1 slipped <b>")]
    content = ReportContent(
        policy,
        "p & q.safetensors",
        rows,
        "100 episodes",
        commands,
        sheets,
        [Picture("Learning", png)],
    )
    write_report(out, content)
    report = Reader(text := out.read_text())
    cells = {content: kind for kind, content in report.cells}
    # The paper has 96.9, 96.4 and 95.5 %: above it, below it, and within the interval.
    assert cells["99.0 % (97.5-99.5)"] == "better"
    assert cells["90.0 % (85.0-95.0)"] == "worse"
    assert cells["96.0 % (93.0-98.0)"] == ""
    assert cells["96.9 %"] == "paper"
    assert "p & q.safetensors" in cells
    # Ours and the paper's 0.137 rad and 0.020 m, in a column each.
    for ours, paper in (("4.0", "7.8"), ("13.0", "20.0")):
        assert f'<td class="number">{ours} <span class="paper">{paper}</span></td>' in text
    assert "<th>heading, °</th><th>heading, mm</th>" in text
    assert (
        "300 episodes in simulation. Success is at or above the paper's in 2 of its 3 rows"
        in html.unescape(text)
    )
    assert "slipped &lt;b&gt;" in text
    assert "--policy &lt;mine&gt;" in text
    assert len(report.sources) == 2
    assert not report.links
    for source in report.sources:
        kind, content = source.split(",")
        assert kind == "data:image/png;base64"
        assert Image.open(io.BytesIO(base64.b64decode(content))).size == (8, 6)


def test_the_self_check_of_the_hand_is_part_of_a_report(tmp_path, policy, monkeypatch):
    save_png(tmp_path / "check.png", np.full((6, 8, 3), 200, np.uint8))
    write_findings(
        tmp_path / "check.json",
        [Finding("palm", "passed", "fine"), Finding("ball", "failed", "falls", "close <it>")],
    )
    bundles.save(policy, tmp_path / "policy.safetensors")
    (tmp_path / "trained.json").write_text('{"seconds": 90}')
    rows = [row("heading", 0.99, 0.975, 0.995)]
    out = tmp_path / "report.html"

    def report_on(own, name, out, *, check, subject, objects, run_dir):
        assert subject == f"--policy {tmp_path / name}"
        assert own.episodes == 8
        assert run_dir == tmp_path
        commands = Commands("c", "")
        content = ReportContent(own.policy, name, rows, "8 episodes", commands, check=check)
        write_report(out, content)
        return Evaluation(None, [], rows, [CongraspError("Row x.", "Y.")], "")

    monkeypatch.setattr("congrasp.services.evaluate.report.report_on", report_on)
    monkeypatch.setattr("congrasp.services.evaluate.exams.exam_pool", lambda exam, count: [])
    command = [
        "report",
        str(tmp_path),
        "--out",
        str(out),
        "--episodes",
        "8",
        "--json",
        str(tmp_path / "rows.json"),
    ]
    assert main.run([*command, "--check", str(tmp_path / "check.json")]) == 0
    report = Reader(text := out.read_text())
    cells = {content: kind for kind, content in report.cells}
    assert cells["passed"] == "better"
    assert cells["failed"] == "worse"
    assert "close &lt;it&gt;" in text
    assert len(report.sources) == 1
    written = json.loads((tmp_path / "rows.json").read_text())
    assert written["content"] == bundles.content_hash(
        (tmp_path / "policy.safetensors").read_bytes()
    )
    assert [one["constraint"] for one in written["rows"]] == ["heading"]
    assert written["episodes"] == 8
    assert written["hand"] == "human"
    assert written["hand_sha256"] == hand_sha256(get_hand("human"))
    assert written["transitions"] == policy.transitions
    assert written["training_seconds"] == 90
    assert written["physics"] == "native"
    (tmp_path / "check.json").write_text('{"findings": [{"name": 3}]}')
    with pytest.raises(CongraspError, match=r"check\.json is not a self-check"):
        main.run([*command, "--check", str(tmp_path / "check.json")])


@pytest.mark.slow
def test_the_command_evaluates_draws_and_writes(tmp_path):
    # A table of one row
    config = dataclasses.replace(task.CONFIG, task=TaskConfig(constraints=("heading",)))
    bundles.save(untrained(config), tmp_path / "mine.safetensors")
    command = ["report", str(tmp_path / "mine.safetensors"), "--out", str(tmp_path / "report.html")]
    assert main.run([*command, "--episodes", "1", "--pool", "2", "--physics", "native"]) == 0
    report = Reader(text := (tmp_path / "report.html").read_text())
    assert len(report.sources) == 1
    assert "--episodes 1 " in text
    assert "2 episodes" in text


def test_a_runs_curves_are_pictures(tmp_path):
    assert list(curves_of(tmp_path)) == []
    writer = LogWriter(tmp_path / "logs", "log")
    channels = JsonChannels()
    for update in range(3):
        values = {"update": update, "values": {"episode": {"success": 0.5}}}
        writer.write(channels.entry("/metrics/learner/0", update, values))
    writer.close()
    (learning,) = curves_of(tmp_path)
    assert learning.title == "Learning"
    assert Image.open(io.BytesIO(learning.png)).width > 300


def test_causes_are_counted():
    assert count_causes(["held", "slipped", "held"]) == "2 held, 1 slipped"


def test_limits_of_a_report_follow_from_its_figures():
    good = row("heading", 0.99, 0.975, 0.995)
    assert limits([good]) == ["No row is below the paper's success, or below 80 %."]
    worst = [
        {"name": "can", "episodes": 10, "success": 0.5},
        {"name": "box", "episodes": 10, "success": 0.9},
    ]
    bad = dataclasses.replace(
        row("pose", 0.75, 0.7, 0.8),
        held_2s=0.6,
        objects=worst,
        plausibility={"hand_hand_mm": 11.0, "hand_table_mm": 1.0, "wrist_speed": 2.5},
    )
    assert limits([good, bad]) == [
        "Pose: 75.0 % success, 60.0 % held for 2 s, success 21.4 points below the paper's 96.4 %.",
        "Objects with the most losses: can (50 % of 10).",
        "Its fingers pass through one another: 11.0 mm at the deepest, mean of the worst row.",
        "Its wrist peaks at 2.5 m/s, in the mean of the fastest row.",
    ]


def test_a_model_card_describes_observation_and_training(policy):
    ranged = dataclasses.replace(policy.task, friction_range=(0.5, 1.2), mass_range=(1.0, 1.0))
    card = model_card(dataclasses.replace(policy, task=ranged), [])
    assert "It observes exact poses, velocities and contact forces." in card["limits"]
    assert card["data"][1].endswith("; mass x 1, sliding friction 0.5 to 1.2.")
    trackers = SensingConfig(delay=(0.0, 0.1), dropout=(0.0, 0.3))
    tracked = dataclasses.replace(
        ranged, observation="tracked", history=8, gain_range=(0.8, 1.2), sensing=trackers
    )
    card = model_card(dataclasses.replace(policy, task=tracked), [])
    (observed,) = [text for text in card["limits"] if text.startswith("It observes")]
    assert "last 8 control steps" in observed
    assert "no velocities and no contact forces" in observed
    disturbances = (
        "servo gains x 0.8 to 1.2, tracker's delay 0 to 0.1 s, tracker's dropout 0 to 0.3."
    )
    assert card["data"][1].endswith(f"; mass x 1, sliding friction 0.5 to 1.2, {disturbances}")


def test_few_episodes_are_a_warning(tmp_path, policy):
    few = dataclasses.replace(row("heading", 0.9, 0.6, 0.98), episodes=16)
    for rows, warned in (([few], True), ([row("heading", 0.99, 0.975, 0.995)], False)):
        write_report(tmp_path / "r.html", ReportContent(policy, "p", rows, "", Commands("c", "")))
        text = (tmp_path / "r.html").read_text()
        assert ('class="warning"' in text) == warned
        assert ("rows of 16 episodes" in text) == warned
        for section in ("Use", "Limits", "Data", "Licence", "Citation"):
            assert f"<h3>{section}</h3>" in text
        assert "@article{congraspxl" in text


def test_a_grasp_to_turn_around_is_where_the_episode_was(tmp_path, policy):
    """What the page's script computes, bones times weights, is the skin, the object and the table
    of the episode.
    """
    recorded = episode(9)
    scene = turntable(recorded)
    data = json.loads(scene["data"])

    def array(name, kind, *shape):
        return np.frombuffer(base64.b64decode(data[name]), kind).reshape(-1, *shape)

    frames = array("frames", "<f4", data["count"], 3, 4)
    assert len(frames) == len(range(0, recorded.steps, round(data["seconds"] / 0.01)))
    step = round(data["seconds"] / 0.01)
    which = 1
    bones = array("bones", "u1", 4)
    weights = array("weights", "u1", 4) / 255
    points = np.column_stack([array("position", "<f4", 3), np.ones(len(bones))])
    moved = np.einsum("vk,vkij,vj->vi", weights, frames[which][bones], points)
    hand = recorded.known_hand()
    skin = skin_shape(skin_of(hand), recorded.link_position[step], recorded.link_quaternion[step])
    np.testing.assert_allclose(moved[: len(skin.vertices)], skin.vertices, atol=2e-3)
    solid = moved[bones[:, 0] == data["count"] - 2]
    turn = Rotation.from_quat(recorded.object_quaternion[step], scalar_first=True)
    corners = turn.apply(recorded.object_vertices) + recorded.object_position[step]
    np.testing.assert_allclose(
        [solid.min(0), solid.max(0)], [corners.min(0), corners.max(0)], atol=1e-5
    )
    assert array("faces", "<u4", 3).max() < len(points)
    assert data["table"][1] == array("faces", "<u4").size
    motion = {**scene, "constraint": "x"}
    content = ReportContent(policy, "p", [], "", Commands("c", ""), motion=motion)
    write_report(tmp_path / "r.html", content)
    assert "A grasp to turn around" in (tmp_path / "r.html").read_text()
