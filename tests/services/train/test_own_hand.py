"""From a hand's file to its report, stage by stage; scripts stand in for the stages' commands, but
for one real run.
"""

import dataclasses
import json
import os
import pathlib
import signal
import subprocess
import sys

import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.files import hand_text
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import own_policy_file, policy_file
from congrasp.learner.run_directory import CHECKPOINTS, CONFIG_FILE, open_run
from congrasp.services.assets.hands.findings import Finding, write_findings
from congrasp.services.cli import main
from congrasp.services.train import own_hand
from congrasp.services.train.command import untrained
from congrasp.services.train.own_hand import CHECK, HAND, REPORT, Request, train_hand
from congrasp.services.train.presets import get_preset
from tests.services.train.conftest import CLAW
from tests.waits import eventually

TINY = (
    "--actors 0 --environments 4 --rollout-steps 8 --updates {} --checkpoint-every 1 "
    "--ppo.minibatches 2 "
    "--network.hidden 16 --objects.count 1 --objects.families box"
)
GOOD = [Finding("palm", "passed", "fingers begin on it")]
BAD = [*GOOD, Finding("ball", "failed", "falls", "close further")]


@pytest.fixture
def stages(monkeypatch, tmp_path, claw):
    """Which stages ran, in their order, and what they do: `findings` of the check, `steps` of the
    policy.
    """
    ran = []
    does = {"findings": GOOD, "steps": 1000}

    def check_or_report(child, patience, progress=lambda line: None):
        ran.append(child.name)
        option = dict(zip(child.arguments, child.arguments[1:], strict=False))
        if child.name == "check":
            write_findings(pathlib.Path(option["--json"]), does["findings"])
            assert child.arguments[:3] == ["hands", "check", "claw"]
            assert child.environment["JAX_PLATFORMS"] == "cpu"
            return int(does["findings"] is BAD)
        content = bundles.content_hash(
            (pathlib.Path(child.arguments[1]) / "policy.safetensors").read_bytes()
        )
        rows = [{"constraint": "heading", "success": 0.953}]
        about = {
            "content": content,
            "episodes": int(option["--episodes"]),
            "pool": int(option["--pool"]),
        }
        pathlib.Path(option["--json"]).write_text(json.dumps({**about, "rows": rows}))
        pathlib.Path(option["--out"]).touch()
        return 0

    def train(run_dir, chosen, options, *, patience, progress):
        ran.append(f"train {' '.join([*chosen, *options])}")
        run_dir.mkdir()
        config = get_preset("quickstart", "claw")
        config = dataclasses.replace(
            config, network=dataclasses.replace(config.network, hidden=(8,))
        )
        (run_dir / CONFIG_FILE).write_text("{}")
        bundles.save(
            dataclasses.replace(untrained(config), transitions=does["steps"]),
            run_dir / "policy.safetensors",
        )
        (run_dir / "trained.json").write_text('{"seconds": 90}')

    monkeypatch.setattr(own_hand, "run_child", check_or_report)
    monkeypatch.setattr(own_hand, "train_in_background", train)
    return ran, does


def request(hand, out, **changes):
    made_request = Request(hand, "claw", out, False, False, "auto", 8, 2, ("--updates", "3"), 60.0)
    return dataclasses.replace(made_request, **changes)


def test_existing_results_are_not_recomputed(stages, claw, tmp_path):
    ran, _ = stages
    notes = []
    policy = train_hand(request(claw, tmp_path / "out"), notes.append)
    assert ran == ["check", "train --preset quickstart --hand claw --updates 3", "report"]
    assert policy_file(None, "claw").read_bytes() == policy.read_bytes()
    text = "\n".join(notes)
    for words in (
        "passed  palm",
        "no GPU",
        "184 million steps",
        "heading",
        "95.3 %",
        str(tmp_path / "out" / REPORT),
    ):
        assert words in text
    train_hand(request(claw, tmp_path / "out"), notes.append)
    assert len(ran) == 3
    (tmp_path / "out" / REPORT).unlink()
    train_hand(request(claw, tmp_path / "out"), notes.append)
    assert ran[3:] == ["report"]
    train_hand(request(claw, tmp_path / "out", episodes=9), notes.append)
    assert ran[4:] == ["report"]
    # A GPU trains the full task, beside what was trained without one.
    notes.clear()
    train_hand(request(claw, tmp_path / "out", full=True), notes.append)
    assert ran[5:] == [
        "train --preset full --hand claw --physics auto --updates 560 --updates 3",
        "report",
    ]
    assert "no GPU" not in "\n".join(notes)


def test_a_hand_that_fails_its_check_is_trained_only_on_request(stages, claw, tmp_path):
    ran, does = stages
    does["findings"] = BAD
    for _ in range(2):
        with pytest.raises(CongraspError, match=r"'claw' failed its self-check.*--anyway"):
            train_hand(request(claw, tmp_path / "out"), lambda text: None)
    assert ran == ["check"]
    assert not own_policy_file("claw").exists()
    # Mended, it is checked anew.
    does["findings"] = GOOD
    mended = dataclasses.replace(claw, object_scale=0.8)
    train_hand(request(mended, tmp_path / "out"), lambda text: None)
    assert ran[1] == "check"
    assert len(ran) == 4
    with pytest.raises(CongraspError, match="another hand, or of an earlier version of this hand"):
        train_hand(request(claw, tmp_path / "out"), lambda text: None)
    does["findings"] = BAD
    train_hand(request(claw, tmp_path / "other", anyway=True), lambda text: None)
    assert len(ran) == 7


def test_a_policy_of_more_experience_stays(stages, claw, tmp_path):
    _, does = stages
    does["steps"] = 10**8
    best = train_hand(request(claw, tmp_path / "long", full=True), lambda text: None)
    does["steps"] = 1000
    notes = []
    train_hand(request(claw, tmp_path / "short"), notes.append)
    assert own_policy_file("claw").read_bytes() == best.read_bytes()
    assert "has more training (100,000,000 steps) and remains" in "\n".join(notes)
    # But one of the hand as it was before is replaced.
    (tmp_path / "hands" / "claw.json").write_text(
        hand_text(dataclasses.replace(claw, object_scale=0.8))
    )
    get_hand.cache_clear()
    fresh = train_hand(request(get_hand("claw"), tmp_path / "new"), lambda text: None)
    assert own_policy_file("claw").read_bytes() == fresh.read_bytes() != best.read_bytes()


def test_the_command_imports_a_hand_once(stages, tmp_path, capsys, monkeypatch):
    ran, _ = stages
    monkeypatch.setattr("congrasp.services.train.accelerators.detect", lambda: ("cpu", 1))
    (tmp_path / "hands" / "claw.json").unlink()
    command = [
        "hands",
        "train",
        str(CLAW),
        "--out",
        str(tmp_path / "out"),
        "--training=--updates 3",
    ]
    assert main.run(command) == 0
    printed = capsys.readouterr().out
    assert "thumb        opposing_lower - opposing_upper" in printed
    assert "congrasp grasp mug:7 --hand claw" in printed
    file = tmp_path / "hands" / "claw.json"
    hand_text = file.read_text()
    assert main.run(command) == 0
    assert len(ran) == 3
    assert file.read_text() == hand_text
    assert f"Using the existing hand 'claw' ({file})" in capsys.readouterr().out
    assert main.run(["hands", "list"]) == 0
    (row,) = [
        line for line in capsys.readouterr().out.splitlines() if "claw" in line and "own" in line
    ]
    assert "x 1" in row
    with pytest.raises(CongraspError, match="no hand 'paw'"):
        main.run(["hands", "train", "paw"])


@pytest.mark.timeout(300)
@pytest.mark.slow
def test_a_killed_training_of_a_hand_resumes_to_its_policy(claw, monkeypatch, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / HAND).write_text(hand_text(claw))
    write_findings(out / CHECK, GOOD)
    run_dir = out / "short"
    command = [sys.executable, "-m", "congrasp", "hands", "train", "claw", "--out", str(out)]
    process = subprocess.Popen(
        [*command, f"--training={TINY.format(10_000)}"],
        stdout=subprocess.PIPE,
        start_new_session=True,
        env=os.environ,
    )
    try:
        written = lambda: [*(run_dir / CHECKPOINTS).glob("*.safetensors")]  # noqa: E731
        eventually(lambda: len(written()) >= 2 or process.poll() is not None)
        assert process.poll() is None
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 128 + signal.SIGTERM
    finally:
        process.kill()
        process.communicate()
    (run_dir / "mark").touch()
    first = max(int(file.stem.rpartition("_")[2]) for file in written())

    monkeypatch.setattr(own_hand, "write_report", lambda *arguments: None)
    last = first + 2
    options = ("--updates", str(last))
    policy = train_hand(request(claw, out, options=options, patience=200.0), lambda text: None)
    assert open_run(run_dir).task.hand == claw.reference
    trained = bundles.load(policy_file(None, "claw"))
    assert trained.version == last
    assert trained.spec.hand == claw.reference
    assert policy.read_bytes() == own_policy_file("claw").read_bytes()
    assert first >= 1
    assert (run_dir / "mark").exists()  # a training from scratch clears its folder
