"""A run goes on with the configuration that it began with, but for what the learner alone uses."""

import dataclasses
import os
import signal
import subprocess
import sys

import pytest

from congrasp.common.errors import CongraspError
from congrasp.learner.hub.used_rollouts import AuditLog
from congrasp.learner.run_directory import (
    continue_run,
    create_run,
    exclusive,
    has_checkpoints,
    listening,
    note_version,
    open_run,
    published_version,
)
from congrasp.services.cli.train import defaults
from congrasp.services.train.presets import get_preset


@pytest.fixture
def run(tmp_path):
    config = dataclasses.replace(get_preset("quickstart"), environments=3, updates=7)
    create_run(tmp_path / "run", config)
    return tmp_path / "run", config


def test_what_the_learner_alone_uses_may_change_and_is_kept(run):
    folder, config = run
    changed = dataclasses.replace(config, updates=9, ppo=dataclasses.replace(config.ppo, clip=0.1))
    continue_run(folder, changed)
    assert open_run(folder) == changed


@pytest.mark.parametrize("change", [{"environments": 4}, {"rollout_steps": 5}, {"name": "other"}, {"algorithm": "a2c"}])
def test_what_actors_use_may_not(run, change):
    folder, config = run
    with pytest.raises(CongraspError, match=rf"cannot change '{next(iter(change))}'.* Start .*--initial"):
        continue_run(folder, dataclasses.replace(config, **change))
    assert open_run(folder) == config


def test_a_command_line_that_resumes_starts_from_the_runs_own_configuration(run):
    folder, config = run
    assert defaults(["--resume", "--run-dir", str(folder)]) == {"config": config}
    assert defaults([f"--run-dir={folder}", "--or-resume", "--preset", "human"])["config"] == config
    assert defaults(["--run-dir", str(folder), "--preset=human"]) == {"config": get_preset("human")}
    with pytest.raises(CongraspError, match="a run of 'human', which --preset allegro is not for"):
        defaults(["--resume", "--run-dir", str(folder), "--preset", "allegro"])
    assert defaults(["--or-resume", "--run-dir", str(folder / "none")])["config"] == get_preset("quickstart")


@pytest.mark.parametrize(
    "text",
    [
        b"\x89MCAP\xff\xfe",
        b"[1, 2]",
        b"7",
        b'{"name": "x", "ppo": 3}',
        b"[" * 9000,
        b"",
        b'{"ppo": null}',
        b'{"ppo": {"clip": null}}',
        b'{"network": {"hidden": null}}',
        b'{"updates": null}',
        b'{"task": {"reward": {"height": [null]}}}',
        b'{"ppo": {"learning_rate_range": [null, 1]}}',
        b"\x00" * 70,
        b'{"name": null}',
        b'{"name": "../x"}',
        b'{"name": "", "seed": 1}',
        b'{"ppo": {"clip": NaN}}',
    ],
)
def test_a_configuration_that_is_none_is_one_line_that_names_the_file(run, text):
    folder, _ = run
    (folder / "config.json").write_bytes(text)
    with pytest.raises(CongraspError, match=r"run/config\.json ") as caught:
        open_run(folder)
    assert "\n" not in str(caught.value)


def test_what_is_left_of_a_run_is_not_begun_anew(run):
    folder, config = run
    assert not has_checkpoints(folder)
    (folder / "policy.safetensors").write_bytes(b"a policy")
    with pytest.raises(CongraspError, match=r"no checkpoint to resume from, .*policy\..* another .* with --initial"):
        has_checkpoints(folder)
    (folder / "policy.safetensors").unlink()
    (folder / "checkpoints").mkdir()
    (folder / "checkpoints" / "latest").symlink_to("gone")
    with pytest.raises(
        CongraspError, match=r"although latest shows that it had one\. Start again in another --run-dir\."
    ):
        has_checkpoints(folder)
    (folder / "checkpoints" / "checkpoint_000000004.safetensors").touch()
    assert has_checkpoints(folder)
    (folder / "config.json").unlink()
    with pytest.raises(CongraspError, match=r"has checkpoint_000000004.* no config\.json"):
        create_run(folder, config)


@pytest.mark.parametrize("damage", [b"", bytes(21), b"\xff\xfe", b"0" * 20 + b"\n", b"9" * 20 + b"\n", b"-5"])
def test_versions_go_on_from_the_journals_where_the_version_file_is_damaged(run, damage):
    folder, _ = run
    assert published_version(folder) == -1
    note_version(folder, 22)
    assert published_version(folder) == 22
    (folder / "version").write_bytes(damage)
    assert published_version(folder) == (0 if damage == b"0" * 20 + b"\n" else -1)
    log = AuditLog(folder, "0")
    log.begin("session", "run", 3, 1, kept=True)
    assert published_version(folder) == 3
    log.used(21, [], [])
    assert published_version(folder) == 22


def test_one_learner_at_a_time_until_it_dies(run):
    folder, config = run
    script = (
        "import pathlib, sys, time; from congrasp.learner.run_directory import exclusive\n"
        "with exclusive(pathlib.Path(sys.argv[1])): print('mine', flush=True); time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", script, str(folder)], stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"mine\n"
        with listening(folder, "tcp/127.0.0.1:7"), pytest.raises(CongraspError) as refused:
            continue_run(folder, dataclasses.replace(config, updates=9))
        said = f"in use by process {other.pid}, which listens at tcp/127.0.0.1:7. Stop it first"
        assert said in str(refused.value) and open_run(folder) == config
        other.kill()
        assert other.wait() == -signal.SIGKILL
    continue_run(folder, dataclasses.replace(config, updates=9))
    with exclusive(folder) as check:
        assert (folder / "lock").read_text() == str(os.getpid())
        (folder / "lock").unlink()
        check()  # reading the file here would release its lock
        with subprocess.Popen([sys.executable, "-c", script, str(folder)], stderr=subprocess.PIPE) as other:
            assert b"is in use by process" in other.stderr.read()
        (folder / "lock").unlink()
        with subprocess.Popen([sys.executable, "-c", script, str(folder)], stdout=subprocess.PIPE) as other:
            assert other.stdout.readline() == b"mine\n"
            with pytest.raises(CongraspError, match=f"in use by process {other.pid}"):
                check()
            other.kill()
