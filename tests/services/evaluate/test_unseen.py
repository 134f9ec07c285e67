"""Objects in pools: each gets its share, what cannot be used is counted, and a stopped evaluation
goes on.
"""

import contextlib
import dataclasses
import functools
import itertools
import types

import numpy as np
import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.objects import procedural
from congrasp.common.objects.store import Catalogue
from congrasp.common.task.metrics import metric_names
from congrasp.services.evaluate import experiment
from congrasp.services.evaluate import pools as of_objects
from congrasp.services.evaluate.episodes import Sample
from congrasp.services.evaluate.exams import FAMILIES
from congrasp.services.evaluate.experiment import Experiment
from congrasp.services.evaluate.many_objects import evaluate_pools
from congrasp.services.evaluate.pools import (
    LoadedObjects,
    PoolLoaders,
    folder_pools,
    procedural_pools,
)
from tests.task import TASK, policy

OBJECTS = procedural.generate_many(5, 1_000_000)


@functools.cache
def experiment_without_objects():
    return Experiment(policy(), [])


@pytest.fixture
def simulated(monkeypatch):
    """Stands in for engine and constraints; lists the pools that were simulated."""
    done = []

    def build_bank(hand, task, objects, seed):
        return [obj.name for obj in objects]

    def plan(self, variation):
        assert self.bank == [obj.name for obj in self.objects]
        assert variation.constraint == "heading"
        index = np.tile(np.arange(len(self.objects)), self.episodes // len(self.objects))
        return types.SimpleNamespace(episodes=index, total=len(index))

    def sample(self, running, variation, plan, progress, *, stressed):
        done.append(([obj.name for obj in self.objects], stressed))
        progress(plan.total)
        values = {name: np.ones(plan.total, np.float32) for name in metric_names(TASK)}
        values |= {
            "object_index": plan.episodes.astype(np.float32),
            "clean": np.zeros(plan.total, np.float32),
        }
        values |= {
            "mass_kg": np.full(plan.total, 0.2, np.float32),
            "identity": np.arange(plan.total, dtype=np.uint32),
        }
        return Sample(
            values, np.ones((plan.total, 1, 2), np.float16), np.ones((plan.total, 1, 3), np.float16)
        )

    monkeypatch.setattr(experiment, "build_bank", build_bank)
    monkeypatch.setattr(Experiment, "plan", plan)
    monkeypatch.setattr(Experiment, "sample", sample)
    monkeypatch.setattr(Experiment, "simulator", lambda self: contextlib.nullcontext("simulator"))
    return done


def evaluated(
    pools, episodes, folder=None, *, seed=0, track=lambda label, total: lambda done: None
):
    """Rows of the test's policy."""
    return evaluate_pools(
        dataclasses.replace(
            experiment_without_objects(), episodes=episodes, seed=seed, track=track
        ),
        pools,
        folder,
    )


def pools_of(*groups, left_out=()):
    """Pools of these objects; `left_out` belongs to the first."""
    makes = [
        lambda i=i, group=group: LoadedObjects(group, [] if i else list(left_out))
        for i, group in enumerate(groups)
    ]
    return PoolLoaders("test", max(map(len, groups)), makes)


def test_episodes_of_an_object_do_not_depend_on_its_pool(simulated):
    told = []
    pools = pools_of(OBJECTS[:3], OBJECTS[3:], left_out=["broken"])
    all_pools, *groups = evaluated(pools, 11, track=lambda label, total: told.append)
    assert {obj["episodes"] for obj in all_pools.objects} == {2}
    assert [obj["name"] for obj in all_pools.objects] == [obj.name for obj in OBJECTS]
    assert all_pools.episodes == 10
    assert all_pools.covered == 5
    assert all_pools.pool == 6
    assert all_pools.success == 1.0
    assert told == [6, 12]  # the second pool is filled up, and what fills it does not count
    by_size = [row for row in groups if row.group.split(" ")[0] in ("small", "medium", "large")]
    assert sum(row.episodes for row in by_size) == 10
    assert {row.success_all for row in by_size} == {1.0}
    assert all_pools.success_all == pytest.approx(5 / 6)
    assert sum(row.episodes for row in groups if row.group.startswith("family")) == 10
    assert all_pools.paper.success == 0.927
    assert [stressed for _, stressed in simulated] == [200, 194]


def test_sizes_masses_and_families_are_those_of_the_objects(simulated):
    _, *groups = evaluated(pools_of(OBJECTS[:2], OBJECTS[2:4]), 4)
    for row in groups:
        if row.group.startswith("family"):
            names = {obj["name"] for obj in row.objects}
            assert names == {obj.name for obj in OBJECTS[:4] if f"family {obj.family}" == row.group}
    heaviest = max(OBJECTS[:4], key=lambda obj: obj.mass).name
    (heavy,) = [row for row in groups if row.group.startswith("heavy")]
    assert heaviest in {obj["name"] for obj in heavy.objects}


def test_a_stopped_evaluation_resumes_at_the_next_pool(simulated, tmp_path):
    complete = evaluated(pools_of(OBJECTS[:2], OBJECTS[2:4]), 8)
    simulated.clear()

    def stop():
        raise KeyboardInterrupt

    first = pools_of(OBJECTS[:2], OBJECTS[2:4])
    with pytest.raises(KeyboardInterrupt):
        evaluated(first._replace(loaders=[first.loaders[0], stop]), 8, tmp_path)
    assert len(simulated) == 1
    again = first._replace(loaders=[stop, first.loaders[1]])  # the first is not even made
    rows = evaluated(again, 8, tmp_path)
    assert [row.to_json() for row in rows] == [row.to_json() for row in complete]
    assert [names for names, _ in simulated] == [
        [o.name for o in OBJECTS[:2]],
        [o.name for o in OBJECTS[2:4]],
    ]
    evaluated(first, 8, tmp_path, seed=1)
    assert len(simulated) == 4  # other settings: both anew
    max(tmp_path.glob("*-00001.safetensors"), key=lambda file: file.stat().st_mtime_ns).write_bytes(
        b"cut off"
    )
    evaluated(first, 8, tmp_path, seed=1)
    assert len(simulated) == 5


def test_no_more_than_the_next_pool_is_made_ahead(simulated):
    loaded = []
    ahead = []

    def make(i):
        loaded.append(i)
        return LoadedObjects(OBJECTS[:1], [])

    pools = PoolLoaders("test", 1, [lambda i=i: make(i) for i in range(5)])
    evaluated(
        pools, 5, track=lambda label, total: lambda done: ahead.append(len(loaded) - len(simulated))
    )
    assert loaded == [0, 1, 2, 3, 4]
    assert max(ahead) <= 1


def test_objects_that_the_hand_cannot_approach_are_left_out_and_counted(
    simulated, monkeypatch, caplog
):
    lost = OBJECTS[1].name

    def build_bank(hand, task, objects, seed):
        names = [obj.name for obj in objects]
        if lost in names:
            raise CongraspError(f"The object '{lost}' cannot be approached.")
        return names

    def headings_of(task, obj, seed, given, scale, own):
        if obj.name == lost:
            raise CongraspError("no heading")
        return {"weight": np.float32(1.0)}

    monkeypatch.setattr(experiment, "build_bank", build_bank)
    monkeypatch.setattr(of_objects, "headings_of", headings_of)
    all_pools, *_ = evaluated(pools_of(OBJECTS[:3], OBJECTS[1:2]), 6)
    assert [obj["name"] for obj in all_pools.objects] == [OBJECTS[0].name, OBJECTS[2].name]
    assert all_pools.covered == 2
    assert all_pools.pool == 4
    assert lost in caplog.text
    with pytest.raises(CongraspError, match="None of the objects can be approached"):
        evaluated(pools_of(OBJECTS[1:2]), 6)


def _stub_headings(monkeypatch, weight_of):
    """Headings of objects are `weight_of(obj, index)`, None for an object without any."""

    def headings_of(task, obj, seed, given, scale, own):
        weight = weight_of(obj, seed[1])
        if weight is None:
            raise CongraspError(f"The object '{obj.name}' cannot be approached.")
        return {"weight": np.float32(weight)}

    def build_bank(hand, task, objects, seed):
        weights = [
            headings_of(task, obj, (seed, i), None, 1.0, None)["weight"]
            for i, obj in enumerate(objects)
        ]
        if not any(weights):
            raise CongraspError("They lie too flat.")
        return [obj.name for obj in objects]

    monkeypatch.setattr(experiment, "build_bank", build_bank)
    monkeypatch.setattr(of_objects, "headings_of", headings_of)


def _prepared(objects, pool_size):
    """The only pool, of these objects."""
    unmeasured = dataclasses.replace(experiment_without_objects(), measured=False)
    pools = pools_of(objects)._replace(pool_size=pool_size)
    with of_objects.prepare_pools(unmeasured, pools, [0]) as prepared:
        return next(prepared)


def test_object_with_an_unreachable_copy_is_left_out(simulated, monkeypatch):
    """The copy pads a pool, and has other random headings."""

    def weight_of(obj, index):
        return None if obj.name == OBJECTS[0].name and index == 4 else 1.0

    _stub_headings(monkeypatch, weight_of)
    pool = _prepared(OBJECTS[:4], pool_size=5)
    assert pool.left_out == [OBJECTS[0].name]
    assert pool.real_count == 3
    names = [obj.name for obj in pool.experiment.objects]
    assert names == [OBJECTS[i].name for i in (1, 2, 3, 1, 2)]


@pytest.mark.parametrize("neighbour", [1.0, None])
def test_flat_objects_remain_whatever_their_neighbours(neighbour, simulated, monkeypatch):
    weights = {OBJECTS[0].name: 0.0, OBJECTS[1].name: neighbour}
    _stub_headings(monkeypatch, lambda obj, index: weights.get(obj.name, 1.0))
    assert OBJECTS[0].name not in _prepared(OBJECTS[:3], pool_size=3).left_out


def test_pool_of_flat_objects_is_empty(simulated, monkeypatch):
    _stub_headings(monkeypatch, lambda obj, index: 0.0)
    pool = _prepared(OBJECTS[:2], pool_size=3)
    assert pool.real_count == 0
    assert pool.left_out == [obj.name for obj in OBJECTS[:2]]


def test_a_folder_is_divided_evenly_and_read_pool_by_pool(tmp_path, monkeypatch):
    monkeypatch.setattr(of_objects, "MAX_OBJECTS_WITH_MESHES", 2)
    for obj in OBJECTS:
        Catalogue(tmp_path).add(obj)
    pools = folder_pools(tmp_path, "native")
    (tmp_path / f"{sorted(obj.name for obj in OBJECTS)[-1]}.safetensors").write_bytes(b"damaged")
    assert folder_pools(tmp_path, "native").source != pools.source, (
        "results of other files are not resumed"
    )
    loaded = [make() for make in pools.loaders]
    assert pools.pool_size == 2
    assert [len(one.objects) for one in loaded] == [2, 2, 0]
    assert [one.left_out for one in loaded] == [[], [], [sorted(obj.name for obj in OBJECTS)[-1]]]


def test_procedural_pools_hold_different_objects_in_equal_numbers(monkeypatch):
    monkeypatch.setattr(of_objects, "MAX_OBJECTS_OFF_DEVICE", 2)
    pools = procedural_pools(5, "native", "development")
    objects = [make().objects for make in pools.loaders]
    assert pools.pool_size == 2
    assert [len(pool) for pool in objects] == [2, 2, 2]
    names = [obj.name for obj in itertools.chain(*objects)]
    assert names == [obj.name for obj in procedural.generate_many(6, 1_000_000, FAMILIES)]
