"""Trainings of a reproduction; scripts stand in for them."""

import dataclasses
import subprocess
import sys

import pytest

from congrasp.services.cli import main
from congrasp.services.ops import lifetime
from congrasp.services.reproduce.plan import RequiredPolicy
from congrasp.services.reproduce.run import Request, train_all
from congrasp.services.train import processes
from congrasp.services.train.presets import get_preset
from congrasp.services.train.processes import Child

OURS, GRAPSXL, PHASES = (RequiredPolicy("human", method) for method in ("ours", "graspxl", "two-phase"))
FINISHES = "import pathlib, sys; p = pathlib.Path(sys.argv[1]); p.mkdir(); (p / 'policy.safetensors').touch()"
FAILS = "print('compiling'); print('congrasp: error: The disk is full.'); raise SystemExit(2)"
HANGS = "import time; print('update 3', flush=True); time.sleep(60)"


@pytest.fixture
def scripts(monkeypatch):
    """What runs for each policy, by name; and all children that were started."""
    chosen, started = {}, []

    class Script(Child):
        def start(self):
            run_dir = self.arguments[self.arguments.index("--run-dir") + 1]
            started.append(self)
            with self.log.open("ab") as log:
                command = [sys.executable, "-c", chosen[self.name], run_dir]
                self.process = subprocess.Popen(command, stdout=log, stderr=log)

    monkeypatch.setattr(processes, "Child", Script)
    monkeypatch.setattr(lifetime, "_POLL", 0.05)
    yield chosen, started
    assert all(child.process.poll() is not None for child in started)


def request(out, patience, *options):
    """A request whose trainings are in `out`."""
    return Request(out, ("human",), (), {}, (), False, options, patience, "", 1, 1, 1, "native", 0)


def silent(label, total):
    return lambda done: None


def test_one_that_fails_or_hangs_is_named_and_does_not_stop_the_rest(scripts, tmp_path):
    chosen, started = scripts
    chosen |= {OURS.name: FAILS, GRAPSXL.name: HANGS, PHASES.name: FINISHES}
    wanted = request(tmp_path, 3.0)
    failures = train_all(wanted, [OURS, GRAPSXL, PHASES], silent)
    assert set(failures) == {OURS, GRAPSXL}
    assert "human-ours failed: The disk is full." in failures[OURS] and "human-ours.log" in failures[OURS]
    assert "human-graspxl was stopped" in failures[GRAPSXL]
    runs = wanted.runs
    assert processes.trained(runs / OURS.name) is None and processes.training_seconds(runs / OURS.name) is None
    assert processes.trained(runs / PHASES.name) == runs / PHASES.name / "policy.safetensors"
    assert processes.training_seconds(runs / PHASES.name) > 0.0
    assert not any("--resume" in child.arguments for child in started)


def test_a_stopped_training_goes_on_and_one_without_a_checkpoint_begins_anew(scripts, tmp_path):
    chosen, started = scripts
    chosen |= {OURS.name: FINISHES.replace("p.mkdir(); ", ""), GRAPSXL.name: FINISHES}
    wanted = request(tmp_path, 20.0, "--updates", "9")
    (wanted.runs / OURS.name / "checkpoints").mkdir(parents=True)
    (wanted.runs / OURS.name / "checkpoints" / "checkpoint_00000003.safetensors").touch()
    (wanted.runs / GRAPSXL.name).mkdir()
    (wanted.runs / GRAPSXL.name / "config.json").touch()
    assert train_all(wanted, [OURS, GRAPSXL], silent) == {}
    ours, graspxl = (child.arguments for child in started)
    assert "--resume" in ours and ours[-2:] == ["--updates", "9"] and "--preset" not in ours
    run = str(wanted.runs / GRAPSXL.name)
    assert graspxl[graspxl.index("--run-dir") + 1] == run and graspxl[graspxl.index("--evaluation") + 1] == "0"
    assert "--resume" not in graspxl and not (wanted.runs / GRAPSXL.name / "config.json").exists()


@pytest.mark.parametrize("policy", [OURS, GRAPSXL, RequiredPolicy("allegro", "ours")], ids=lambda policy: policy.name)
def test_its_command_lines_are_those_of_train(policy):
    arguments = [*policy.training, "--environments", "4096"]
    train = main._parsed("train", main.load("train"), arguments)
    config = train.keywords["config"]
    assert (config.task.hand, config.environments) == (policy.hand, 4096)
    assert train.keywords["method"] == (None if policy.method == "ours" else policy.method)
    assert dataclasses.replace(config, environments=32_768) == get_preset("full", policy.hand)
