"""What `congrasp train` checks before training, and prints around it."""

import dataclasses
import io
import math
import subprocess
import sys
import textwrap
import types

import pytest
from rich.console import Console

from congrasp.common.config import NetworkConfig, ObjectsConfig, PPOConfig, RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.runtime.stages import stage
from congrasp.common.task.config import TaskConfig
from congrasp.learner.run_directory import create_run
from congrasp.services.ops.certificates import create_authority, issue
from congrasp.services.train import command
from congrasp.services.train.command import EPISODE, TrainingProgress, print_next_steps
from congrasp.services.train.launch import (
    Launch,
    LaunchRecord,
    LearnerOptions,
    write_launch,
)
from congrasp.services.train.presets import get_preset
from congrasp.services.train.processes import ProcessDied
from tests.waits import eventually

LAUNCH = Launch(actors=1)
# 40 steps an update
CONFIG = RunConfig(name="quickstart", updates=10, environments=4, rollout_steps=5)
SUPERVISOR = """
    import pathlib, sys
    from congrasp.learner.run_directory import supervised
    with supervised(pathlib.Path(sys.argv[1])):
        print("locked", flush=True)
        sys.stdin.read()
"""


@pytest.fixture
def printed_lines(monkeypatch):
    """What was printed so far, as lines."""
    output = io.StringIO()
    monkeypatch.setattr(command, "console", Console(file=output, width=200, soft_wrap=True))
    return lambda: output.getvalue().splitlines()


@pytest.fixture
def clock(monkeypatch):
    """A clock that only the test moves."""
    now = types.SimpleNamespace(seconds=100.0)
    monkeypatch.setattr(command.time, "monotonic", lambda: now.seconds)
    return now


def status(update, **values):
    # Fewer steps than updates of this size: earlier updates may have had fewer ranks.
    figures = {
        "transitions": 30.0 * update,
        "steps_per_second": 1234.4,
        "staleness_mean": 0.5,
        **values,
    }
    return {"values": figures, "update": update, "version": update, "actors": 2}


def test_progress_counts_the_time_left_from_the_first_update(printed_lines, clock, tmp_path):
    with stage("a stage"):
        pass
    with TrainingProgress(CONFIG, tmp_path) as progress:
        clock.seconds += 30  # compiling
        progress.show({"actors": 2})
        clock.seconds += 30
        progress.show(status(1))
        clock.seconds += 20
        progress.show(
            status(
                3,
                **{
                    "episode/success": 0.256,
                    "episode/links_at_removal": 2.5,
                    "episode/return": -7.25,
                },
            )
        )
    first, *start, early, late = (line.strip() for line in printed_lines())
    assert "First update" in start[0]
    assert any(line.endswith(": a stage") for line in start[1:])
    assert first == "compiling, and filling the first batch: 30 s, 2 actor(s)"
    assert early.startswith("update    1/10")
    assert early.endswith("left ?")
    # Two updates took 20 s, so that the seven others take 70.
    for words in (
        "update    3/10",
        "1234 steps/s",
        "version 3",
        "lag 0.5",
        "success  25.6 %",
        "links  2.5",
        "left 1:10",
    ):
        assert words in late


def test_progress_away_from_a_terminal_is_a_line_every_ten_seconds(printed_lines, clock, tmp_path):
    with TrainingProgress(CONFIG, tmp_path) as progress:
        for _ in range(22):
            clock.seconds += 1.0
            progress.show({"actors": 1})
    # The last one at the end
    assert [line.split()[-4] for line in printed_lines()] == [
        "1",
        "11",
        "21",
        "22",
    ]


def test_progress_on_a_narrow_terminal_is_wrapped(monkeypatch, clock, tmp_path):
    output = io.StringIO()
    narrow = Console(
        file=output,
        width=80,
        force_terminal=True,
        highlight=False,
        soft_wrap=command.console.soft_wrap,
    )
    monkeypatch.setattr(command, "console", narrow)
    with TrainingProgress(CONFIG, tmp_path) as progress:
        progress.show(status(1))
        eventually(lambda: "left ?" in output.getvalue())


def test_next_steps_name_the_pictures_that_exist_and_commands_that_exist(printed_lines, tmp_path):
    from congrasp.services.cli.main import COMMANDS

    (tmp_path / EPISODE).touch()
    print_next_steps(tmp_path)
    assert any(line.strip() == str(tmp_path / EPISODE) for line in printed_lines())
    commands = [
        line.split("congrasp ", 1)[1].split()[0] for line in printed_lines() if "congrasp " in line
    ]
    assert commands
    assert set(commands) <= set(COMMANDS)


@pytest.mark.parametrize(
    ("free", "words"), [(1000, "disk of .* is full.*--resume"), (10**9, "its log is empty")]
)
def test_a_run_that_dies_of_a_full_disk_names_it(printed_lines, monkeypatch, tmp_path, free, words):
    def die(*args, **options):
        checkpoint = tmp_path / "checkpoints" / "checkpoint_000000001.safetensors"
        checkpoint.parent.mkdir()
        checkpoint.touch()
        raise CongraspError("The learner failed: its log is empty")  # its log is on the same disk

    monkeypatch.setattr(command, "train", die)
    monkeypatch.setattr(command.shutil, "disk_usage", lambda path: types.SimpleNamespace(free=free))
    with pytest.raises(CongraspError, match=words):
        command.run_training(CONFIG, tmp_path, LAUNCH, resume=False, evaluation=0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"task": TaskConfig(hand="paw")}, "no hand 'paw'"),
        ({"objects": ObjectsConfig(families=("unicorn",))}, "unicorn"),
        ({"objects": ObjectsConfig(count=0)}, "pool is empty: objects.count is 0"),
        ({"environments": 0}, "--environments is 0"),
        ({"updates": -1}, "--updates is -1"),
        ({"checkpoint_every": 0}, "--checkpoint-every is 0"),
        ({"ppo": PPOConfig(clip=0.0)}, "--ppo.clip is 0, not above 0"),
        ({"ppo": PPOConfig(gamma=math.nan)}, "--ppo.gamma is nan, not 0 to 1"),
        ({"ppo": PPOConfig(learning_rate_range=(1.0, 0.1))}, "--ppo.learning-rate-range is 1 to"),
        ({"ppo": PPOConfig(minibatches=10**9)}, "--ppo.minibatches is 1000000000, more than"),
        ({"task": TaskConfig(approach_steps=-3)}, "--task.approach-steps is -3"),
        ({"network": NetworkConfig(hidden=(8, 0))}, "--network.hidden is"),
    ],
)
def test_a_configuration_that_cannot_run_leaves_no_run_behind(
    printed_lines, tmp_path, change, words
):
    with pytest.raises(CongraspError, match=words):
        config = dataclasses.replace(CONFIG, **change)
        command.run_training(config, tmp_path / "run", LAUNCH, resume=False, evaluation=0)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("existed", [False, True])
def test_a_failed_start_removes_its_files(printed_lines, monkeypatch, tmp_path, existed):
    run_dir = tmp_path / "new" / "run"
    if existed:
        run_dir.mkdir(parents=True)

    def die(folder, *args, **options):
        log = folder / "logs" / "learner.log"
        log.write_text("out of memory")
        raise ProcessDied("The learner did not start.", log)

    monkeypatch.setattr(command, "train", die)
    with pytest.raises(CongraspError, match=r"did not start.*run\.failed\.log"):
        command.run_training(CONFIG, run_dir, LAUNCH, resume=False, evaluation=0)
    assert run_dir.exists() == existed
    assert not (existed and any(run_dir.iterdir()))
    assert run_dir.with_name("run.failed.log").read_text() == "out of memory"


def test_a_stop_names_the_way_to_resume_only_with_a_checkpoint(
    printed_lines, monkeypatch, tmp_path
):
    def stopped(folder, *args, stop, **options):
        stop.set()
        if folder.name == "with checkpoint":
            (folder / "checkpoints").mkdir()
            (folder / "checkpoints" / "checkpoint_000000000.safetensors").touch()

    monkeypatch.setattr(command, "train", stopped)
    for name in ("with checkpoint", "without"):
        command.run_training(CONFIG, tmp_path / name, LAUNCH, resume=False, evaluation=0)
    resumable, removed = (line for line in printed_lines() if "was stopped" in line)
    assert f"--run-dir '{tmp_path / 'with checkpoint'}'" in resumable
    assert "--resume" not in removed
    assert not (tmp_path / "without").exists()


def test_a_resume_without_a_folder_names_the_newest_run(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    create_run(tmp_path / "runs" / "mine", CONFIG)
    with pytest.raises(CongraspError, match=r"--resume needs .*runs/mine"):
        command.run_training(CONFIG, None, LAUNCH, resume=True, evaluation=0)


def test_a_resume_while_a_learner_restarts_is_refused(printed_lines, monkeypatch, tmp_path):
    """Between the learner's death and its restart nothing but its supervisor holds a lock."""
    create_run(tmp_path, CONFIG)
    write_launch(tmp_path, LaunchRecord.of_plan(LAUNCH.planned(CONFIG), CONFIG.name))
    before = {path.name: path.read_bytes() for path in tmp_path.glob("*.json")}
    changed = dataclasses.replace(CONFIG, updates=20)
    program = [sys.executable, "-c", textwrap.dedent(SUPERVISOR), tmp_path]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(program, **pipes) as other:
        assert other.stdout.readline() == b"locked\n"
        with pytest.raises(CongraspError, match=f"in use by process {other.pid}"):
            command.run_training(changed, tmp_path, LAUNCH, resume=True, evaluation=0)
        other.stdin.close()
    assert {path.name: path.read_bytes() for path in tmp_path.glob("*.json")} == before
    with pytest.raises(CongraspError, match="no checkpoint"):
        command.run_training(changed, tmp_path, LAUNCH, resume=True, evaluation=0)


def test_easier_settings_are_printed_at_the_start(printed_lines, monkeypatch, tmp_path):
    def stop(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "train", stop)
    config = RunConfig(
        objects=ObjectsConfig(count=8), network=NetworkConfig(hidden=(32,)), physics="native"
    )
    with pytest.raises(KeyboardInterrupt):
        command.run_training(config, tmp_path, LAUNCH, resume=False, evaluation=0)
    full = get_preset("human").objects.count
    assert (
        f"Easier than the full task: an actor has 8 objects, not {full}; networks have layers of "
        f"32 units" in printed_lines()[1]
    )


def test_a_training_that_others_may_join_has_all_certificates_before_it_starts(tmp_path):
    create_authority(tmp_path)
    for role in ("learner", "actor", "observer"):
        issue(tmp_path, role)
    Launch(listen="tls/0.0.0.0:7447", certs=tmp_path).planned(CONFIG)
    Launch(listen="tcp/0.0.0.0:7447", learner=LearnerOptions(insecure=True)).planned(CONFIG)
    with pytest.raises(CongraspError, match="the certificate of a single role"):
        Launch(listen="tls/0.0.0.0:7447", certs=tmp_path / "learner.0").planned(CONFIG)
    with pytest.raises(CongraspError, match="With --actors 0 the learner opens no endpoint"):
        Launch(actors=0, listen="tls/0.0.0.0:7447", certs=tmp_path).planned(CONFIG)
    (tmp_path / "observer.0" / "tls.key").unlink()
    with pytest.raises(CongraspError, match=r"observer.0/tls.key is missing.*--role observer"):
        Launch(listen="tls/0.0.0.0:7447", certs=tmp_path).planned(CONFIG)
