"""Cache of constraint banks."""

import dataclasses

import jax
import numpy as np
import pytest

from congrasp.common.hands import get_hand
from congrasp.common.objects import procedural
from congrasp.common.task.config import RewardWeights, TaskConfig
from congrasp.common.task.sampling import cache
from congrasp.common.task.sampling.bank import SHARED, ConstraintBank
from congrasp.common.task.sampling.cache import cached_bank

HAND = get_hand("human")
TASK = TaskConfig()
OBJECTS = [procedural.generate(seed, "box") for seed in range(2)]


@pytest.fixture(autouse=True)
def _cache_of_small_pools(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cache, "MIN_OBJECTS", 2)


class Builder:
    """Makes banks of random numbers, and counts its calls."""

    def __init__(self):
        self.built = 0

    def __call__(self) -> ConstraintBank:
        self.built += 1
        rng = np.random.default_rng(self.built)
        fields = {name: rng.normal(size=(2, 3)).astype(np.float32) for name in SHARED}
        fields["avoid"] = rng.random((2, 3)) > 0.5
        return ConstraintBank(**fields)


def test_bank_is_built_once():
    build = Builder()
    first = cached_bank(HAND, TASK, OBJECTS, 0, build)
    again = cached_bank(HAND, TASK, OBJECTS, 0, build)
    assert build.built == 1
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        assert isinstance(b, jax.Array)
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("hand", "task", "objects", "seed"),
    [
        (HAND, TASK, OBJECTS, 1),
        (HAND, TASK, OBJECTS[::-1], 0),
        (HAND, dataclasses.replace(TASK, headings="above"), OBJECTS, 0),
        (HAND, dataclasses.replace(TASK, trajectory_points=20), OBJECTS, 0),
        (get_hand("allegro"), TASK, OBJECTS, 0),
    ],
    ids=["seed", "objects", "headings", "waypoints", "hand"],
)
def test_other_arguments_build_another_bank(hand, task, objects, seed):
    build = Builder()
    cached_bank(HAND, TASK, OBJECTS, 0, build)
    cached_bank(hand, task, objects, seed, build)
    assert build.built == 2


def test_irrelevant_settings_reuse_a_bank():
    build = Builder()
    cached_bank(HAND, TASK, OBJECTS, 0, build)
    cached_bank(
        HAND,
        dataclasses.replace(TASK, reward=RewardWeights(force=7.0), p_pose=0.1),
        OBJECTS,
        0,
        build,
    )
    assert build.built == 1


def test_damaged_file_is_rebuilt(tmp_path):
    build = Builder()
    cached_bank(HAND, TASK, OBJECTS, 0, build)
    (file,) = (tmp_path / "congrasp" / "banks").iterdir()
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(data)
    cached_bank(HAND, TASK, OBJECTS, 0, build)
    cached_bank(HAND, TASK, OBJECTS, 0, build)
    assert build.built == 2


def test_cache_keeps_the_last_used_banks(tmp_path):
    build = Builder()
    for seed in range(cache.MAX_FILES + 2):
        cached_bank(HAND, TASK, OBJECTS, seed, build)
    assert len(list((tmp_path / "congrasp" / "banks").iterdir())) == cache.MAX_FILES
    cached_bank(HAND, TASK, OBJECTS, cache.MAX_FILES + 1, build)
    assert build.built == cache.MAX_FILES + 2
