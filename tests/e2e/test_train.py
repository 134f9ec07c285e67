"""A whole small run of real processes over Zenoh whose actor and learner are killed, and which a
signal ends.
"""

import json
import signal
import subprocess

import numpy as np
import psutil
import pytest

from congrasp.common.policy import bundle as bundles
from congrasp.services.ops.audit import compare as audit
from congrasp.services.record.reader import read_episodes, read_metrics, read_rollouts
from tests.benchmarks.faults import Run

pytestmark = pytest.mark.timeout(600)
ENVIRONMENTS = 8
STEPS = 40
# With objects, environments and networks of the suite's sizes, whose programs are compiled already.
SMALL = (
    *(
        "--environments",
        str(ENVIRONMENTS),
        "--rollout-steps",
        str(STEPS),
        "--checkpoint-every",
        "3",
    ),
    *(
        "--log-rollout-worlds",
        "3",
        "--episode-every",
        "1",
        "--objects.count",
        "4",
        "--objects.families",
        "box",
    ),
    *(
        "--network.hidden",
        "16",
        "--network.encoder",
        "4",
        "--ppo.epochs",
        "1",
        "--ppo.minibatches",
        "2",
    ),
    *("--rollouts-per-update", "2", "--task.constraints", "heading", "pose"),  # with references
)


def version(run: Run, least: int = 0) -> int:
    """The learner's version, once it is at least this."""
    status = run.until(lambda: (now := run.status()).get("version", -1) >= least and now)
    return status["version"]


def updates(run: Run, count: int) -> None:
    """Waits for so many more versions."""
    version(run, version(run) + count)


def kill_an_actor_and_the_learner(run: Run, count: int) -> None:
    updates(run, 5)
    actors = run.children("actor")
    assert len(actors) == count
    actors[0].kill()
    updates(run, 3)  # the run continues
    run.until(lambda: len(run.children("actor")) == count)  # and the actor is replaced
    survivors = {child.pid for child in run.children("actor")}
    (learner,) = run.children("learner")
    before = version(run)
    learner.kill()
    learner.wait()
    assert version(run) >= before
    updates(run, 3)  # resumed, with rising versions
    assert {
        child.pid for child in run.children("actor")
    } == survivors  # which did not have to restart


@pytest.fixture
def start(tmp_path):
    processes = []

    def run(actors: int, updates: int) -> Run:
        options = ["--updates", str(updates), *SMALL]
        processes.append(Run(tmp_path / f"run{len(processes)}", actors, options, subprocess.PIPE))
        processes[-1].start()
        return processes[-1]

    yield run
    for one in processes:
        if one.alive:
            one.kill()
        one.close()


def test_a_run_survives_the_death_of_an_actor_and_of_its_learner_and_ends_on_a_signal(start):
    """It ends within seconds, leaves no process behind, and costs nothing that was accepted."""
    run = start(1, 10**6)
    kill_an_actor_and_the_learner(run, 1)
    family = psutil.Process(run.process.pid).children(recursive=True)
    run.process.send_signal(signal.SIGINT)
    output, _ = run.process.communicate(timeout=20)
    assert run.process.returncode == 128 + signal.SIGINT, output
    _, alive = psutil.wait_procs(family, timeout=5)
    assert not alive
    assert "actor-0 was killed by SIGKILL" in output
    assert "learner was killed by SIGKILL" in output
    report = audit(run.run_dir)
    assert report.exit_code == 0
    assert report.counts["used"] >= 4
    assert [file.stem for file in (run.run_dir / "references").iterdir()] == ["actor-0"]
    assert any((run.run_dir / "tensorboard").iterdir())
    metrics = read_metrics(run.run_dir)
    assert any(name.endswith("episode/return") for name in metrics)
    assert next(read_episodes(run.run_dir)).hand == "human"
    sampled = next(read_rollouts(run.run_dir))
    assert sampled.arrays["observation"].shape == (
        STEPS,
        3,
        sum(size for _, size in sampled.meta["layout"]),
    )
    assert sampled.arrays["action"].shape == (STEPS, 3, 26)
    assert sampled.arrays["last_observation"].shape[0] == 3
    assert np.isfinite(sampled.arrays["reward"]).all()
    assert sampled.meta["environments"] == ENVIRONMENTS


@pytest.mark.slow
def test_with_two_actors_the_other_one_continues_alone_and_the_run_completes(start):
    count = 100  # the deaths take a fifth of them
    run = start(2, count)
    kill_an_actor_and_the_learner(run, 2)
    output, _ = run.process.communicate(timeout=300)
    assert run.process.returncode == 0, output
    assert audit(run.run_dir).exit_code == 0
    policy = bundles.load(run.run_dir / "policy.safetensors")
    assert policy.transitions == count * 2 * ENVIRONMENTS * STEPS
    assert json.loads((run.run_dir / "config.json").read_text())["updates"] == count


@pytest.mark.slow
def test_twenty_kills_of_the_learner_with_updates_between_do_not_end_a_run(start):
    run = start(1, 10**6)
    for _ in range(20):
        updates(run, 2)
        (learner,) = run.children("learner")
        learner.kill()
        learner.wait()
    updates(run, 2)
    run.process.terminate()
    run.process.communicate(timeout=20)
    assert run.process.returncode == 128 + signal.SIGTERM
    report = audit(run.run_dir)
    assert report.exit_code == 0
    assert report.lag_max <= report.max_staleness


@pytest.mark.slow
def test_sigterm_ends_a_run_as_ctrl_c_does(start):
    run = start(1, 10**6)
    updates(run, 5)
    run.process.terminate()
    run.process.communicate(timeout=20)
    assert run.process.returncode == 128 + signal.SIGTERM
    assert audit(run.run_dir).exit_code == 0
