"""A whole small run of real processes over Zenoh, with an actor and the learner killed in the middle."""

import json
import pathlib
import signal
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
import psutil
import pytest

from congrasp.common.policy import bundle as bundles
from congrasp.services.ops.audit import audit
from congrasp.services.record.reader import read_episodes, read_metrics, read_rollouts
from tests.benchmarks.second_reading import read_again

pytestmark = pytest.mark.timeout(600)
UPDATES, ENVIRONMENTS, STEPS = 16, 8, 40
SMALL = [
    *("--updates", str(UPDATES), "--environments", str(ENVIRONMENTS), "--rollout-steps", str(STEPS)),
    *("--checkpoint-every", "3"),
    *(
        "--log-rollout-worlds",
        "3",
        "--episode-every",
        "1",
        "--objects.count",
        "4",
        "--objects.families",
        "box",
        "--network.hidden",
        "32",
    ),
    *("--network.encoder", "8", "--ppo.epochs", "1", "--ppo.minibatches", "2", "--evaluation", "0"),
]


def _eventually(condition: Callable[[], bool], seconds: float, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, f"the run ended early: {process.communicate()[0]}"
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.1)


def _children(process: subprocess.Popen[str], role: str) -> list[psutil.Process]:
    return [child for child in psutil.Process(process.pid).children() if role in child.cmdline()]


def _version(run_dir: pathlib.Path) -> int:
    try:
        return int((run_dir / "version").read_text())
    except (OSError, ValueError):
        return -1


@pytest.mark.parametrize("count", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_run_survives_the_death_of_an_actor_and_of_its_learner(tmp_path, count):
    """With two actors, the other one continues alone; one alone is replaced first."""
    run_dir = tmp_path / "run"
    command = [sys.executable, "-m", "congrasp", "train", "--run-dir", str(run_dir), "--actors", str(count), *SMALL]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        _eventually(lambda: _version(run_dir) >= 4, 300, process)
        actors = _children(process, "actor")
        assert len(actors) == count
        victim = actors[0]
        victim.send_signal(signal.SIGKILL)
        reached = _version(run_dir)
        _eventually(lambda: _version(run_dir) >= reached + 3, 120, process)  # the run continues
        _eventually(lambda: len(_children(process, "actor")) == count, 60, process)  # and the actor is replaced
        survivors = {child.pid for child in _children(process, "actor")}
        (learner,) = _children(process, "learner")
        learner.send_signal(signal.SIGKILL)
        reached = _version(run_dir)
        _eventually(lambda: _version(run_dir) >= reached + 3, 120, process)  # resumed, with rising versions
        assert {child.pid for child in _children(process, "actor")} == survivors  # which did not have to restart
        output, _ = process.communicate(timeout=300)
    finally:
        if process.poll() is None:
            process.kill()
    assert process.returncode == 0, output
    assert "actor-0 died" in output or "actor-1 died" in output
    assert "learner died" in output
    names = [f"actor-{number}" for number in range(count)]
    assert sorted(file.stem for file in (run_dir / "references").iterdir()) == names
    assert audit(run_dir).exit_code == 0 and read_again(run_dir)[:4] == (0, 0, 0, 0)
    policy = bundles.load(run_dir / "policy.safetensors")
    assert policy.transitions == UPDATES * 2 * ENVIRONMENTS * STEPS
    metrics = read_metrics(run_dir)
    assert any(name.endswith("episode/return") for name in metrics)
    assert next(read_episodes(run_dir)).meta["hand"] == "human"
    sampled = next(read_rollouts(run_dir))
    assert sampled.arrays["observation"].shape == (STEPS, 3, sum(size for _, size in sampled.meta["layout"]))
    assert sampled.arrays["action"].shape == (STEPS, 3, 26) and sampled.arrays["last_observation"].shape[0] == 3
    assert np.isfinite(sampled.arrays["reward"]).all() and sampled.meta["environments"] == ENVIRONMENTS
    assert json.loads((run_dir / "config.json").read_text())["updates"] == UPDATES


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_a_signal_ends_the_run_within_seconds_and_costs_nothing_that_was_accepted(tmp_path, number):
    run_dir = tmp_path / "run"
    command = [sys.executable, "-m", "congrasp", "train", "--run-dir", str(run_dir), "--actors", "1", *SMALL]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        _eventually(lambda: _version(run_dir) >= 4, 300, process)  # of two rollouts each
        family = psutil.Process(process.pid).children(recursive=True)
        process.send_signal(number)
        process.communicate(timeout=20)
    finally:
        if process.poll() is None:
            process.kill()
    assert process.returncode == 128 + number
    _, alive = psutil.wait_procs(family, timeout=5)
    assert not alive
    report = audit(run_dir)
    assert report.exit_code == 0 and report.counts["used"] >= 4
    assert read_again(run_dir)[:4] == (0, 0, 0, 0)
