import os
import pathlib
import resource
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from common.errors import CongraspError
from learner.algorithms.ppo import PPO
from learner.checkpoint import Checkpoints
from services.bench import toy
from tests.learner.test_ppo import rollout

ROOT = pathlib.Path(__file__).resolve().parents[2]


def run_stream(directory: pathlib.Path, first: int, last: int) -> None:
    """Runs updates `first` to `last` - 1 of a fixed stream, from the checkpoint that is there, and leaves one."""
    algorithm = PPO(toy.SPEC, toy.SETTINGS)
    state = algorithm.init(3)
    checkpoints = Checkpoints(directory)
    if first:
        state, meta = checkpoints.load(state)
        assert meta == {"next": first}
    for seed in range(first, last):
        state, _ = algorithm.update(state, rollout(toy.bundle_of(state), seed))
    checkpoints.save(state, {"next": last}, state.version)


def in_a_fresh_process(script: str, directory: pathlib.Path) -> int:
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    return subprocess.run([sys.executable, "-c", script, str(directory)], env=environment, timeout=120).returncode


def test_half_save_load_half_equals_the_whole_bit_for_bit(tmp_path):
    run_stream(tmp_path / "whole", 0, 6)
    run_stream(tmp_path / "halves", 0, 3)
    script = """
import pathlib, sys
from tests.learner.test_checkpoint import run_stream
run_stream(pathlib.Path(sys.argv[1]), 3, 6)
"""
    assert in_a_fresh_process(script, tmp_path / "halves") == 0
    whole, halves = ((tmp_path / name / "latest").read_bytes() for name in ("whole", "halves"))
    assert whole == halves


def tree(value: float) -> dict:
    return {
        "device": {"half": jnp.full((2, 3), value, jnp.float16), "key": jax.random.PRNGKey(int(value))},
        "host": np.array([value, 2.0**60 + 512]),
        "steps": 2**40 + int(value),
    }


def test_leaves_come_back_where_and_what_they_were(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(tree(1.0), {"hub": {"seen": [1, 2]}, "epoch": "e"}, 1)
    loaded, meta = checkpoints.load(tree(0.0))
    assert meta == {"hub": {"seen": [1, 2]}, "epoch": "e"}
    jax.tree.map(np.testing.assert_array_equal, loaded, tree(1.0))
    assert isinstance(loaded["device"]["half"], jax.Array)
    assert isinstance(loaded["host"], np.ndarray) and loaded["host"].dtype == np.float64
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
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))  # the kernel refuses to write more than 100 bytes
    try:
        with pytest.raises(CongraspError, match=r"checkpoint_000000002\.safetensors could not be written") as caught:
            checkpoints.save(tree(2.0), {}, 2)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "\n" not in str(caught.value)
    assert checkpoints.load(tree(0.0))[0]["host"][0] == 1.0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["checkpoint_000000001.safetensors", "latest"]


def test_a_process_that_dies_while_writing_leaves_the_previous_checkpoint(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(tree(1.0), {}, 1)
    script = """
import os, pathlib, sys
import learner.checkpoint as checkpoint
from tests.learner.test_checkpoint import tree
checkpoint.sync_directory = lambda path: None
os.fsync = lambda descriptor: os._exit(9)  # gone after the data were written, before the rename
checkpoint.Checkpoints(pathlib.Path(sys.argv[1])).save(tree(2.0), {}, 2)
"""
    assert in_a_fresh_process(script, tmp_path) == 9
    assert checkpoints.load(tree(0.0))[0]["host"][0] == 1.0


def test_a_checkpoint_of_a_version_with_another_optimiser_is_one_line(tmp_path):
    """Adam's moments at the top, and the learning rate beside them."""
    state = PPO(toy.SPEC, toy.SETTINGS).init(0)
    _, adam = state.optimizer.inner_state
    before = {**state._asdict(), "optimizer": adam[0], "learning_rate": jnp.float32(1e-3)}
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(before, {}, 1)
    with pytest.raises(CongraspError, match=r"'optimizer/.*' is missing .*and the version of congrasp, that") as caught:
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
