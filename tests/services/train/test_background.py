"""Trainings of a reproduction, in the background."""

import dataclasses
import sys

import pytest

from congrasp.services.cli import main, parse_errors
from congrasp.services.evaluate.lineup import PolicyKey
from congrasp.services.ops import lifetime
from congrasp.services.train import background
from congrasp.services.train.presets import get_preset
from congrasp.services.train.processes import Child
from congrasp.services.train.reproduction import PolicyRequest, train_all, training_options

OURS, GRAPSXL, PHASES = (PolicyKey("human", method) for method in ("ours", "graspxl", "two-phase"))
FINISHES = (
    "import pathlib, sys; p = pathlib.Path(sys.argv[1]); p.mkdir(); (p / "
    "'policy.safetensors').touch()"
)
FAILS = "print('compiling'); print('congrasp: error: The disk is full.'); raise SystemExit(2)"
HANGS = "import time; print('update 3', flush=True); time.sleep(60)"


@pytest.fixture
def scripts(monkeypatch):
    """What runs for each policy, by name; and all children that were started."""
    chosen = {}
    started = []

    class Training(Child):
        @property
        def program(self):
            started.append(self)
            folder = self.arguments[self.arguments.index("--run-dir") + 1]
            return [sys.executable, "-c", chosen[self.name], folder]

    monkeypatch.setattr(background, "Child", Training)
    monkeypatch.setattr(lifetime, "POLL_S", 0.05)
    yield chosen, started
    assert all(child.process.poll() is not None for child in started)


def request(out, patience, *options):
    """A request whose trainings are in `out`."""
    return PolicyRequest(("human",), (), {}, False, out / "policies", options, patience)


def silent(label, total):
    return lambda done: None


def test_a_failed_or_hanging_training_does_not_stop_the_rest(scripts, tmp_path):
    chosen, started = scripts
    chosen |= {OURS.name: FAILS, GRAPSXL.name: HANGS, PHASES.name: FINISHES}
    trainings = request(tmp_path, 3.0)
    failures = train_all(trainings, [OURS, GRAPSXL, PHASES], silent)
    assert set(failures) == {OURS, GRAPSXL}
    assert "human-ours failed: The disk is full." in failures[OURS]
    assert "human-ours.log" in failures[OURS]
    assert "human-graspxl was stopped" in failures[GRAPSXL]
    runs = trainings.runs
    assert background.finished_policy(runs / OURS.name) is None
    assert background.training_seconds(runs / OURS.name) is None
    assert (
        background.finished_policy(runs / PHASES.name) == runs / PHASES.name / "policy.safetensors"
    )
    assert background.training_seconds(runs / PHASES.name) > 0.0
    assert not any("--resume" in child.arguments for child in started)


def test_a_stopped_training_resumes_or_restarts_without_checkpoint(scripts, tmp_path):
    chosen, started = scripts
    chosen |= {OURS.name: FINISHES.replace("p.mkdir(); ", ""), GRAPSXL.name: FINISHES}
    trainings = request(tmp_path, 20.0, "--updates", "9")
    (trainings.runs / OURS.name / "checkpoints").mkdir(parents=True)
    (trainings.runs / OURS.name / "checkpoints" / "checkpoint_00000003.safetensors").touch()
    (trainings.runs / GRAPSXL.name).mkdir()
    (trainings.runs / GRAPSXL.name / "config.json").touch()
    assert train_all(trainings, [OURS, GRAPSXL], silent) == {}
    ours, graspxl = (child.arguments for child in started)
    assert "--resume" in ours
    assert ours[-2:] == ["--updates", "9"]
    assert "--preset" not in ours
    run = str(trainings.runs / GRAPSXL.name)
    assert graspxl[graspxl.index("--run-dir") + 1] == run
    assert graspxl[graspxl.index("--evaluation") + 1] == "0"
    assert "--resume" not in graspxl
    assert not (trainings.runs / GRAPSXL.name / "config.json").exists()


@pytest.mark.parametrize(
    "policy", [OURS, GRAPSXL, PolicyKey("allegro", "ours")], ids=lambda policy: policy.name
)
def test_its_command_lines_are_those_of_train(policy):
    arguments = [*training_options(policy), "--environments", "4096"]
    train = parse_errors.parse("train", main.load("train"), arguments)
    config = train.keywords["config"]
    assert config.task.hand == policy.hand
    assert config.environments == 4096
    assert train.keywords["method"] == (None if policy.method == "ours" else policy.method)
    assert dataclasses.replace(config, environments=32_768) == get_preset("full", policy.hand)
