"""A run's folder: its configuration, and checkpoints, which are exact, atomic, and left out where
damaged.
"""

import dataclasses
import os
import resource
import signal
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from congrasp.common.config import RunConfig
from congrasp.common.errors import CongraspError
from congrasp.learner.algorithms.ppo import PPO
from congrasp.learner.checkpoint import Checkpoints
from congrasp.learner.hub.used_rollouts import AuditLog
from congrasp.learner.run_directory import (
    config_checksum,
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
from tests.learner import toy


@pytest.fixture
def run(tmp_path):
    config = dataclasses.replace(get_preset("quickstart"), environments=3, updates=7)
    create_run(tmp_path / "run", config)
    return tmp_path / "run", config


def test_settings_of_the_learner_alone_may_change(run):
    folder, config = run
    changed = dataclasses.replace(config, updates=9, ppo=dataclasses.replace(config.ppo, clip=0.1))
    continue_run(folder, changed)
    assert open_run(folder) == changed


@pytest.mark.parametrize(
    "change", [{"environments": 4}, {"rollout_steps": 5}, {"name": "other"}, {"algorithm": "a2c"}]
)
def test_settings_of_the_actors_may_not_change(run, change):
    folder, config = run
    with pytest.raises(
        CongraspError, match=rf"cannot change '{next(iter(change))}'.* Start another run\."
    ):
        continue_run(folder, dataclasses.replace(config, **change))
    assert open_run(folder) == config


def test_resuming_starts_from_the_runs_configuration(run):
    folder, config = run
    assert defaults(["--resume", "--run-dir", str(folder)]) == {"config": config}
    assert defaults([f"--run-dir={folder}", "--or-resume", "--preset", "human"])["config"] == config
    assert defaults(["--run-dir", str(folder), "--preset=human"]) == {"config": get_preset("human")}
    with pytest.raises(CongraspError, match="hand 'human', but --preset allegro is for another"):
        defaults(["--resume", "--run-dir", str(folder), "--preset", "allegro"])
    assert defaults(["--or-resume", "--run-dir", str(folder / "none")])["config"] == get_preset(
        "quickstart"
    )


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
def test_an_invalid_configuration_names_its_file(run, text):
    folder, _ = run
    (folder / "config.json").write_bytes(text)
    with pytest.raises(CongraspError, match=r"run/config\.json ") as caught:
        open_run(folder)
    assert "\n" not in str(caught.value)


def test_an_existing_run_is_not_started_again(run):
    folder, config = run
    assert not has_checkpoints(folder)
    (folder / "policy.safetensors").write_bytes(b"a policy")
    with pytest.raises(
        CongraspError, match=r"no checkpoint to resume from, .*policy\..* another .* with --initial"
    ):
        has_checkpoints(folder)
    (folder / "policy.safetensors").unlink()
    (folder / "checkpoints").mkdir()
    (folder / "checkpoints" / "latest").symlink_to("gone")
    with pytest.raises(
        CongraspError,
        match=r"latest shows that it had one\. In another --run-dir, start another run\.",
    ):
        has_checkpoints(folder)
    (folder / "checkpoints" / "checkpoint_000000004.safetensors").touch()
    assert has_checkpoints(folder)
    (folder / "config.json").unlink()
    with pytest.raises(CongraspError, match=r"has checkpoint_000000004.* no config\.json"):
        create_run(folder, config)


@pytest.mark.parametrize(
    "damage", [b"", bytes(21), b"\xff\xfe", b"0" * 20 + b"\n", b"9" * 20 + b"\n", b"-5"]
)
def test_versions_continue_from_journals_without_the_version_file(run, damage):
    folder, _ = run
    assert published_version(folder) == -1
    note_version(folder, 22)
    assert published_version(folder) == 22
    (folder / "version").write_bytes(damage)
    assert published_version(folder) == (0 if damage == b"0" * 20 + b"\n" else -1)
    log = AuditLog(folder, "0")
    log.begin("session", "run", 3, 1, kept=True)
    assert published_version(folder) == 3
    log.record_uses(21, [], [])
    assert published_version(folder) == 22


def test_one_learner_at_a_time_until_it_dies(run):
    folder, config = run
    script = (
        "import pathlib, sys, time; from congrasp.learner.run_directory import exclusive\n"
        "with exclusive(pathlib.Path(sys.argv[1])): print('mine', flush=True); time.sleep(600)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script, str(folder)], stdout=subprocess.PIPE
    ) as other:
        assert other.stdout.readline() == b"mine\n"
        with listening(folder, "tcp/127.0.0.1:7"), pytest.raises(CongraspError) as refused:
            continue_run(folder, dataclasses.replace(config, updates=9))
        error = f"in use by process {other.pid}, which listens at tcp/127.0.0.1:7. Stop it first"
        assert error in str(refused.value)
        assert open_run(folder) == config
        other.kill()
        assert other.wait() == -signal.SIGKILL
    continue_run(folder, dataclasses.replace(config, updates=9))
    with exclusive(folder) as check:
        assert (folder / "lock").read_text().strip() == str(os.getpid())
        (folder / "lock").unlink()
        check()  # reading the file here would release its lock
        with subprocess.Popen(
            [sys.executable, "-c", script, str(folder)], stderr=subprocess.PIPE
        ) as other:
            assert b"is in use by process" in other.stderr.read()
        (folder / "lock").unlink()
        with subprocess.Popen(
            [sys.executable, "-c", script, str(folder)], stdout=subprocess.PIPE
        ) as other:
            assert other.stdout.readline() == b"mine\n"
            with pytest.raises(CongraspError, match=f"in use by process {other.pid}"):
                check()
            other.kill()


# --- checkpoints ---


def tree(value: float) -> dict:
    return {
        "device": {
            "half": jnp.full((2, 3), value, jnp.float16),
            "key": jax.random.PRNGKey(int(value)),
        },
        "host": np.array([value, 2.0**60 + 512]),
        "steps": 2**40 + int(value),
    }


def test_leaves_round_trip_with_type_and_place(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(tree(1.0), {"hub": {"seen": [1, 2]}, "run_id": "e"}, 1)
    loaded, meta = checkpoints.load(tree(0.0))
    assert meta == {"hub": {"seen": [1, 2]}, "run_id": "e"}
    jax.tree.map(np.testing.assert_array_equal, loaded, tree(1.0))
    assert isinstance(loaded["device"]["half"], jax.Array)
    assert isinstance(loaded["host"], np.ndarray)
    assert loaded["host"].dtype == np.float64
    assert isinstance(loaded["steps"], int)


def test_three_are_kept_and_the_latest_is_the_newest(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    for version in range(1, 6):
        checkpoints.save(tree(version), {}, version)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == [*(f"checkpoint_00000000{v}.safetensors" for v in (3, 4, 5)), "latest"]
    assert checkpoints.load(tree(0.0))[0]["host"][0] == 5.0


def test_a_full_disk_is_one_clear_error_and_the_previous_checkpoint_is_intact(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(tree(1.0), {}, 1)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    # The kernel refuses to write more than 100 bytes
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
    try:
        with pytest.raises(
            CongraspError, match=r"checkpoint_000000002\.safetensors could not be written"
        ) as caught:
            checkpoints.save(tree(2.0), {}, 2)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "\n" not in str(caught.value)
    assert checkpoints.load(tree(0.0))[0]["host"][0] == 1.0
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "checkpoint_000000001.safetensors",
        "latest",
    ]


@pytest.mark.filterwarnings("ignore:os.fork")
def test_a_process_that_dies_while_writing_leaves_the_previous_checkpoint(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save({"host": np.ones(3)}, {}, 1)
    child = os.fork()
    if not child:
        # Gone after the data were written, before the rename
        os.fsync = lambda descriptor: os._exit(9)
        try:
            checkpoints.save({"host": np.zeros(3)}, {}, 2)
        finally:
            os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9
    np.testing.assert_array_equal(checkpoints.load({"host": np.zeros(3)})[0]["host"], np.ones(3))


def test_a_checkpoint_of_a_version_with_another_optimiser_is_one_line(tmp_path):
    """Adam's moments at the top, and the learning rate beside them."""
    state = PPO(toy.SPEC, toy.SETTINGS).init(0)
    _, adam = state.optimizer.inner_state
    before = {**state._asdict(), "optimizer": adam[0], "learning_rate": jnp.float32(1e-3)}
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(before, {}, 1)
    with pytest.raises(
        CongraspError, match=r"'optimizer/.*' is missing .*configuration and version of congrasp"
    ) as caught:
        checkpoints.load(state)
    assert "\n" not in str(caught.value)


def test_no_checkpoint_a_damaged_one_and_one_of_another_shape(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    with pytest.raises(CongraspError, match="no checkpoint"):
        checkpoints.load(tree(0.0))
    path = checkpoints.save(tree(1.0), {}, 1)
    with pytest.raises(CongraspError, match="'host'"):
        checkpoints.load({**tree(0.0), "host": np.zeros(3)})
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(CongraspError, match="damaged"):
        checkpoints.load(tree(0.0))


def lines_of(checkpoints: Checkpoints) -> tuple[float, list[str]]:
    """The value in the checkpoint that is found, and what was said."""
    lines: list[str] = []
    loaded, _ = checkpoints.load(tree(0.0), lambda level, text: lines.append(text))
    assert not any("\n" in text for text in lines)
    return loaded["host"][0], lines


@pytest.mark.parametrize("link", ["missing", "dangling", "of an older one"])
def test_the_newest_checkpoint_is_found_with_any_link(tmp_path, link):
    checkpoints = Checkpoints(tmp_path)
    for version in (8, 9, 10):
        checkpoints.save(tree(version), {}, version)
    (tmp_path / "latest").unlink()
    if link != "missing":
        name = "nothing" if link == "dangling" else "checkpoint_000000008.safetensors"
        (tmp_path / "latest").symlink_to(name)
    value, lines = lines_of(checkpoints)
    assert value == 10.0
    assert lines == [f"Resuming from the checkpoint {tmp_path}/checkpoint_000000010.safetensors."]


def test_damaged_checkpoints_are_left_out_named_and_kept(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    paths = [checkpoints.save(tree(version), {}, version) for version in (1, 2, 3)]
    paths[2].write_bytes(paths[2].read_bytes()[:-3])
    paths[1].write_bytes(b"")
    value, lines = lines_of(checkpoints)
    assert value == 1.0
    assert len(lines) == 3
    assert "000000003.safetensors is damaged: The message" in lines[0]
    assert "000000002.safetensors is damaged" in lines[1]
    checkpoints.save(tree(7.0), {}, 3)  # training comes to update 3 again
    assert len((tmp_path / "checkpoint_000000003.safetensors.aside").read_bytes()) > 0
    assert lines_of(checkpoints)[0] == 7.0


def edited_config(text: bytes, kind: str) -> bytes:
    """The text of a configuration with one change."""
    if kind == "bit":
        return text.replace(b'"gamma": 0.9', b'"gamma": 0.8', 1)
    if kind == "editor":
        return b"\xef\xbb\xbf" + text.replace(b"\n", b"\r\n")
    return text


@pytest.mark.parametrize("stored", ["both", "checkpoint", "file", "neither"])
@pytest.mark.parametrize("kind", ["bit", "editor", "none"])
def test_a_changed_config_is_refused_on_resume(tmp_path, stored, kind):
    config = RunConfig()
    create_run(tmp_path, config)
    path = tmp_path / "config.json"
    text = path.read_bytes()
    meta = {}
    if stored in ("both", "checkpoint"):
        meta["config"] = config_checksum(text)
    Checkpoints(tmp_path / "checkpoints").save(tree(1.0), meta, 1)
    if stored in ("checkpoint", "neither"):
        (tmp_path / "config.sha256").unlink()
    path.write_bytes(edited_config(text, kind))
    assert (path.read_bytes() == text) == (kind == "none")
    if kind == "bit" and stored != "neither":
        with pytest.raises(CongraspError, match=r"config\.json.*start another run\."):
            continue_run(tmp_path, open_run(tmp_path))
    else:
        continue_run(tmp_path, open_run(tmp_path))


def damage_config(folder):
    path = folder / "config.json"
    path.write_bytes(edited_config(path.read_bytes(), "bit"))
    continue_run(folder, open_run(folder))


REFUSED = {
    "damaged configuration": damage_config,
    "changed size": lambda folder: continue_run(folder, RunConfig(environments=7)),
    "no checkpoint": lambda folder: has_checkpoints(folder),
}
"""Actions on the folder of a run that end in the proposal of another one."""


@pytest.mark.parametrize("has_policy", [True, False])
@pytest.mark.parametrize("name", REFUSED)
def test_a_proposed_policy_exists(tmp_path, name, has_policy):
    folder = tmp_path / "a run"
    create_run(folder, RunConfig())
    policy = folder / "policy.safetensors"
    if has_policy:
        policy.write_bytes(b"a policy")
    (folder / "checkpoints").mkdir()
    (folder / "checkpoints" / "latest").symlink_to("gone")
    with pytest.raises(CongraspError, match=r"tart another run") as caught:
        REFUSED[name](folder)
    assert (f"--initial '{policy}'" in str(caught.value)) == has_policy


UNUSABLE = {
    "link to nothing": lambda path: path.symlink_to("absent/folder"),
    "file": lambda path: path.write_text("of the user"),
    "link to a file": lambda path: path.symlink_to(__file__),
}
"""What is in place of a run's folder."""


@pytest.mark.parametrize("below", ["", "a/b"])
@pytest.mark.parametrize("name", UNUSABLE)
def test_a_run_dir_that_cannot_be_made_is_named(tmp_path, name, below):
    UNUSABLE[name](tmp_path / "run")
    with pytest.raises(CongraspError, match=r"--run-dir is .*/run"):
        create_run(tmp_path / "run" / below, RunConfig())


def test_a_run_dir_may_be_a_link(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "run").symlink_to("disk")
    create_run(tmp_path / "run", RunConfig())
    assert open_run(tmp_path / "disk") == open_run(tmp_path / "run") == RunConfig()


def test_a_setting_that_may_change_changes_on_resume(tmp_path):
    create_run(tmp_path, RunConfig())
    text = (tmp_path / "config.json").read_bytes()
    Checkpoints(tmp_path / "checkpoints").save(tree(1.0), {"config": config_checksum(text)}, 1)
    more = dataclasses.replace(RunConfig(), updates=RunConfig().updates + 1)
    continue_run(tmp_path, more)
    continue_run(tmp_path, open_run(tmp_path))
    assert open_run(tmp_path) == more
