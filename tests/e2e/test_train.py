"""A whole small run of real processes over Zenoh whose actor and learner are killed, and which a signal ends."""

import itertools
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
from congrasp.services.ops.audit import compare as audit
from congrasp.services.record.reader import read_episodes, read_metrics, read_rollouts

pytestmark = pytest.mark.timeout(600)
ENVIRONMENTS, STEPS = 8, 40
# With objects, environments and networks of the suite's sizes, whose programs are compiled already.
SMALL = (
    *("--environments", str(ENVIRONMENTS), "--rollout-steps", str(STEPS), "--checkpoint-every", "3"),
    *("--log-rollout-worlds", "3", "--episode-every", "1", "--objects.count", "4", "--objects.families", "box"),
    *("--network.hidden", "16", "--network.encoder", "4", "--ppo.epochs", "1", "--ppo.minibatches", "2"),
    *("--rollouts-per-update", "2", "--evaluation", "0", "--task.constraints", "heading", "pose"),  # with references
)


class Run:
    """`congrasp train` and its children."""

    def __init__(self, folder: pathlib.Path, actors: int, updates: int):
        self.folder = folder
        command = [sys.executable, "-m", "congrasp", "train", "--run-dir", str(folder), "--actors", str(actors)]
        command += ["--updates", str(updates), *SMALL]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    def eventually(self, condition: Callable[[], bool], seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            assert self.process.poll() is None, f"the run ended early: {self.process.communicate()[0]}"
            assert time.monotonic() < deadline, "it did not happen in time"
            time.sleep(0.1)

    def updates(self, count: int) -> None:
        """Waits for so many more versions."""
        reached = self.version()
        self.eventually(lambda: self.version() >= reached + count, 300)

    def version(self) -> int:
        try:
            return int((self.folder / "version").read_text())
        except (OSError, ValueError):
            return -1

    def children(self, role: str) -> list[psutil.Process]:
        return [child for child in psutil.Process(self.process.pid).children() if role in child.cmdline()]

    def kill_an_actor_and_the_learner(self, count: int) -> None:
        self.updates(5)
        actors = self.children("actor")
        assert len(actors) == count
        actors[0].send_signal(signal.SIGKILL)
        self.updates(3)  # the run continues
        self.eventually(lambda: len(self.children("actor")) == count, 60)  # and the actor is replaced
        survivors = {child.pid for child in self.children("actor")}
        (learner,) = self.children("learner")
        learner.send_signal(signal.SIGKILL)
        self.updates(3)  # resumed, with rising versions
        assert {child.pid for child in self.children("actor")} == survivors  # which did not have to restart


@pytest.fixture
def start(tmp_path):
    made, numbers = [], itertools.count()

    def run(actors: int, updates: int) -> Run:
        made.append(Run(tmp_path / f"run{next(numbers)}", actors, updates))
        return made[-1]

    yield run
    for one in made:
        if one.process.poll() is None:
            one.process.kill()


def test_a_run_survives_the_death_of_an_actor_and_of_its_learner_and_ends_on_a_signal(start):
    """It ends within seconds, leaves no process behind, and costs nothing that was accepted."""
    run = start(1, 10**6)
    run.kill_an_actor_and_the_learner(1)
    family = psutil.Process(run.process.pid).children(recursive=True)
    run.process.send_signal(signal.SIGINT)
    output, _ = run.process.communicate(timeout=20)
    assert run.process.returncode == 128 + signal.SIGINT, output
    _, alive = psutil.wait_procs(family, timeout=5)
    assert not alive
    assert "actor-0 died" in output and "learner died" in output
    report = audit(run.folder)
    assert report.exit_code == 0 and report.counts["used"] >= 4
    assert [file.stem for file in (run.folder / "references").iterdir()] == ["actor-0"]
    metrics = read_metrics(run.folder)
    assert any(name.endswith("episode/return") for name in metrics)
    assert next(read_episodes(run.folder)).meta["hand"] == "human"
    sampled = next(read_rollouts(run.folder))
    assert sampled.arrays["observation"].shape == (STEPS, 3, sum(size for _, size in sampled.meta["layout"]))
    assert sampled.arrays["action"].shape == (STEPS, 3, 26) and sampled.arrays["last_observation"].shape[0] == 3
    assert np.isfinite(sampled.arrays["reward"]).all() and sampled.meta["environments"] == ENVIRONMENTS


@pytest.mark.slow
def test_with_two_actors_the_other_one_continues_alone_and_the_run_completes(start):
    updates = 20
    run = start(2, updates)
    run.kill_an_actor_and_the_learner(2)
    output, _ = run.process.communicate(timeout=300)
    assert run.process.returncode == 0, output
    assert audit(run.folder).exit_code == 0
    policy = bundles.load(run.folder / "policy.safetensors")
    assert policy.transitions == updates * 2 * ENVIRONMENTS * STEPS
    assert json.loads((run.folder / "config.json").read_text())["updates"] == updates


@pytest.mark.slow
def test_sigterm_ends_a_run_as_ctrl_c_does(start):
    run = start(1, 10**6)
    run.updates(5)
    run.process.terminate()
    run.process.communicate(timeout=20)
    assert run.process.returncode == 128 + signal.SIGTERM
    assert audit(run.folder).exit_code == 0
