"""Checkpoints: exact, atomic, found without their link, and left out where they are damaged."""

import os
import resource

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from congrasp.common.errors import CongraspError
from congrasp.learner.algorithms.ppo import PPO
from congrasp.learner.checkpoint import Checkpoints
from tests.learner import toy


def tree(value: float) -> dict:
    return {
        "device": {"half": jnp.full((2, 3), value, jnp.float16), "key": jax.random.PRNGKey(int(value))},
        "host": np.array([value, 2.0**60 + 512]),
        "steps": 2**40 + int(value),
    }


def test_leaves_come_back_where_and_what_they_were(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(tree(1.0), {"hub": {"seen": [1, 2]}, "run_id": "e"}, 1)
    loaded, meta = checkpoints.load(tree(0.0))
    assert meta == {"hub": {"seen": [1, 2]}, "run_id": "e"}
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


@pytest.mark.filterwarnings("ignore:os.fork")
def test_a_process_that_dies_while_writing_leaves_the_previous_checkpoint(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save({"host": np.ones(3)}, {}, 1)
    child = os.fork()
    if not child:
        os.fsync = lambda descriptor: os._exit(9)  # gone after the data were written, before the rename
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
    said: list[str] = []
    loaded, _ = checkpoints.load(tree(0.0), lambda level, text: said.append(text))
    assert not any("\n" in text for text in said)
    return loaded["host"][0], said


@pytest.mark.parametrize("link", ["missing", "dangling", "of an older one"])
def test_the_newest_checkpoint_is_found_whatever_the_link_says(tmp_path, link):
    checkpoints = Checkpoints(tmp_path)
    for version in (8, 9, 10):
        checkpoints.save(tree(version), {}, version)
    (tmp_path / "latest").unlink()
    if link != "missing":
        name = "nothing" if link == "dangling" else "checkpoint_000000008.safetensors"
        (tmp_path / "latest").symlink_to(name)
    value, said = lines_of(checkpoints)
    assert value == 10.0 and said == [f"Resuming from the checkpoint {tmp_path}/checkpoint_000000010.safetensors."]


def test_damaged_checkpoints_are_left_out_named_and_kept(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    paths = [checkpoints.save(tree(version), {}, version) for version in (1, 2, 3)]
    paths[2].write_bytes(paths[2].read_bytes()[:-3])
    paths[1].write_bytes(b"")
    value, said = lines_of(checkpoints)
    assert value == 1.0 and len(said) == 3
    assert "000000003.safetensors is damaged: The message" in said[0] and "000000002.safetensors is damaged" in said[1]
    checkpoints.save(tree(7.0), {}, 3)  # training comes to update 3 again
    assert len((tmp_path / "checkpoint_000000003.safetensors.aside").read_bytes()) > 0
    assert lines_of(checkpoints)[0] == 7.0
