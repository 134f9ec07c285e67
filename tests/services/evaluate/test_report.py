"""A report is one file that needs nothing beside it, and says where a policy is better or worse than the paper's."""

import base64
import dataclasses
import html
import io
import json

import numpy as np
import pytest
from PIL import Image

from common.config import NetworkConfig, RunConfig, TaskConfig
from common.errors import CongraspError
from common.policy import bundle as bundles
from services.assets.hands.check import Finding, write_findings
from services.cli import main
from services.evaluate.report import Commands, Picture, count_causes, curves_of, write_report
from services.evaluate.reporting import Reported
from services.record.channels import JsonChannels
from services.record.writer import LogWriter
from services.train.command import untrained
from services.train.presets import get_preset
from services.viz.sheets import save_png
from tests.pages import Reader
from tests.rows import row as made_row

ERRORS = {"heading_rad": 0.07, "heading_m": 0.013}


def row(constraint, success, low, high):
    source = "hands" if constraint == "pose" else "captured"
    return made_row(constraint, success, low, high, source=source, errors=ERRORS)


@pytest.fixture
def policy():
    config = get_preset("quickstart")
    return untrained(dataclasses.replace(config, network=dataclasses.replace(config.network, hidden=(8,))))


def test_a_report_holds_its_tables_and_pictures(tmp_path, policy):
    save_png(tmp_path / "p.png", np.full((6, 8, 3), 200, np.uint8))
    png = (tmp_path / "p.png").read_bytes()
    rows = [row("heading", 0.99, 0.975, 0.995), row("pose", 0.9, 0.85, 0.95), row("trajectory", 0.96, 0.93, 0.98)]
    out = tmp_path / "report.html"
    commands = Commands("congrasp evaluate --policy <mine>", "", "congrasp plot x")
    sheets = [Picture("heading", png, "2 held, 1 slipped <b>")]
    write_report(out, policy, "p & q.safetensors", rows, "100 episodes", sheets, [Picture("Learning", png)], commands)
    found = Reader(text := out.read_text())
    cells = {content: kind for kind, content in found.cells}
    # The paper has 96.9, 96.4 and 95.5 %: above it, below it, and within the interval.
    assert cells["99.0 % (97.5-99.5)"] == "better" and cells["90.0 % (85.0-95.0)"] == "worse"
    assert cells["96.0 % (93.0-98.0)"] == ""
    assert cells["96.9 %"] == "paper" and "0.137 rad 0.020 m" in cells and "p & q.safetensors" in cells
    assert "300 episodes in simulation. Success is at or above the paper's in 2 of the 3 rows" in html.unescape(text)
    assert "slipped &lt;b&gt;" in text and "--policy &lt;mine&gt;" in text
    assert len(found.sources) == 2 and not found.links
    for source in found.sources:
        kind, content = source.split(",")
        assert kind == "data:image/png;base64"
        assert Image.open(io.BytesIO(base64.b64decode(content))).size == (8, 6)


def test_the_self_check_of_the_hand_is_part_of_a_report(tmp_path, policy, monkeypatch):
    save_png(tmp_path / "check.png", np.full((6, 8, 3), 200, np.uint8))
    write_findings(
        tmp_path / "check.json", [Finding("palm", "passed", "fine"), Finding("ball", "failed", "falls", "close <it>")]
    )
    bundles.save(policy, tmp_path / "policy.safetensors")
    rows, out = [row("heading", 0.99, 0.975, 0.995)], tmp_path / "report.html"

    def report_on(file, out, *, check, track, subject, **options):
        assert subject == f"--policy {file}" and options["episodes"] == 8 and options["run_dir"] == tmp_path
        write_report(out, policy, file.name, rows, "8 episodes", [], [], Commands("c", ""), check)
        return Reported(rows, [CongraspError("Row x.", "Y.")])

    monkeypatch.setattr("services.evaluate.reporting.report_on", report_on)
    command = ["report", str(tmp_path), "--out", str(out), "--episodes", "8", "--json", str(tmp_path / "rows.json")]
    assert main.run([*command, "--check", str(tmp_path / "check.json")]) == 0
    found = Reader(text := out.read_text())
    cells = {content: kind for kind, content in found.cells}
    assert cells["passed"] == "better" and cells["failed"] == "worse" and "close &lt;it&gt;" in text
    assert len(found.sources) == 1
    written = json.loads((tmp_path / "rows.json").read_text())
    assert written["content"] == bundles.content_hash((tmp_path / "policy.safetensors").read_bytes())
    assert [one["constraint"] for one in written["rows"]] == ["heading"] and written["episodes"] == 8
    (tmp_path / "check.json").write_text('{"findings": [{"name": 3}]}')
    with pytest.raises(CongraspError, match=r"check\.json holds no self-check"):
        main.run([*command, "--check", str(tmp_path / "check.json")])


def test_the_command_evaluates_draws_and_writes(tmp_path):
    config = RunConfig(task=TaskConfig(constraints=("heading",)), network=NetworkConfig(hidden=(8,), encoder=4))
    bundles.save(untrained(config), tmp_path / "mine.safetensors")
    command = ["report", str(tmp_path / "mine.safetensors"), "--out", str(tmp_path / "report.html")]
    assert main.run([*command, "--episodes", "1", "--pool", "2", "--physics", "native"]) == 0
    found = Reader(text := (tmp_path / "report.html").read_text())
    assert len(found.sources) == 1 and "--episodes 1 " in text and "2 episodes" in text


def test_a_runs_curves_are_pictures(tmp_path):
    assert list(curves_of(tmp_path)) == []
    writer, channels = LogWriter(tmp_path / "logs", "log"), JsonChannels()
    for update in range(3):
        values = {"update": update, "values": {"episode": {"success": 0.5}}}
        writer.write(channels.entry("/metrics/learner/0", update, values))
    writer.close()
    (learning,) = curves_of(tmp_path)
    assert learning.title == "Learning" and Image.open(io.BytesIO(learning.png)).width > 300


def test_causes_are_counted():
    assert count_causes(["held", "slipped", "held"]) == "2 held, 1 slipped"
