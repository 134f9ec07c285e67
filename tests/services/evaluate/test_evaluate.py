"""Evaluation of an untrained policy: the command from end to end, and what it refuses."""

import contextlib
import dataclasses
import itertools
import json
from unittest import mock

import numpy as np
import pytest

from actors.env import metric_names
from common.config import NetworkConfig, RunConfig
from common.errors import CongraspError
from common.objects import procedural
from common.objects.store import Catalogue
from common.policy import bundle as bundles
from services.cli.main import load
from services.evaluate.evaluator import Evaluator
from services.evaluate.scores import Sample, matching
from services.evaluate.unseen import evaluate_objects, procedural_pools
from services.evaluate.worlds import sampling_config
from services.train.command import untrained

CONFIG = RunConfig(network=NetworkConfig(hidden=(16,), encoder=4))
OBJECTS = procedural.generate_many(3, 1_000_000)


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    path = tmp_path_factory.mktemp("policy") / "policy.safetensors"
    bundles.save(untrained(CONFIG), path)
    return path


@pytest.fixture(scope="module")
def evaluator():
    return Evaluator(untrained(CONFIG), OBJECTS, batch=16)


def test_the_command_measures_rows_by_the_protocol(policy, tmp_path, capsys, monkeypatch):
    folder, out, samples = tmp_path / "objects", tmp_path / "rows.json", {}
    for obj in OBJECTS:
        Catalogue(folder).add(obj)
    row = Evaluator.row
    monkeypatch.setattr(Evaluator, "row", lambda self, name, sample: row(self, name, samples.setdefault(name, sample)))
    arguments = ["--policy", str(policy), "--objects", str(folder), "--table", "composed"]
    assert load("evaluate")([*arguments, "--episodes", "3", "--batch", "8", "--json", str(out)])() == 0
    read = json.loads(out.read_text())
    assert [row["constraint"] for row in read["rows"]] == ["pose+trajectory", "trajectory+affordance"]
    assert all(row["hand"] == "human" and 0 <= row["held_2s"] <= row["success"] <= 1 for row in read["rows"])
    assert read["physics"] == "native" and "pose+trajectory" in capsys.readouterr().out
    for name, sample in samples.items():
        assert len(sample.values["success"]) == 3 and matching(sample.values, name, CONFIG.task).all()
        assert np.all(sample.values["length"] == 250)  # 50 steps with the table, 2 s without
        assert sample.link_force.shape == (3, 25, 16) and sample.torque.shape == (3, 25, 20)
        assert 0.0 < sample.torque.max() <= 1.0


def test_every_pool_of_objects_gets_its_share_of_the_episodes(monkeypatch):
    told, built = [], []

    def samples_of_pools(self, constraint, pools, episodes, progress):
        for pool in itertools.chain([self.objects], pools):
            self.objects = pool
            progress(episodes)
            values = {name: np.ones(episodes, np.float32) for name in metric_names(CONFIG.task)}
            values["object_index"] = np.arange(episodes, dtype=np.float32) % len(pool)
            yield Sample(values, np.ones((episodes, 25, 16)), np.ones((episodes, 25, 20)))

    monkeypatch.setattr(Evaluator, "samples_of_pools", samples_of_pools)
    monkeypatch.setattr("services.evaluate.evaluator.build_bank", lambda *arguments: built.append(arguments))
    pools = procedural_pools(6, 1_000_000, largest=3)
    settings = {"physics": "native", "batch": 0, "threads": 1, "seed": 0, "friction": 1.0, "progress": told.append}
    whole, *groups = evaluate_objects(untrained(CONFIG), pools, 15, **settings)
    assert told == [15, 30] and len(built) == 1
    assert (whole.episodes, whole.objects, whole.success) == (30, 6, 1.0)
    by_size = [(row.group.split(" ")[0], row.episodes, row.objects) for row in groups[:3]]
    assert by_size == [("small", 10, 2), ("medium", 10, 2), ("large", 10, 2)]
    assert sum(row.episodes for row in groups if row.group.startswith("family")) == 30


def test_other_pools_take_the_place_of_the_first(monkeypatch):
    worker, built = mock.Mock(), []

    def build_bank(hand, task, objects, seed):
        built.append((list(objects), seed))
        return len(built)

    monkeypatch.setattr("services.evaluate.evaluator.build_bank", build_bank)
    monkeypatch.setattr("services.evaluate.evaluator.measure", lambda worker, task, objects: worker.measure(objects))
    evaluator = Evaluator(untrained(CONFIG), OBJECTS[:1], seed=5)
    monkeypatch.setattr(evaluator, "_worker", lambda task, episodes: contextlib.nullcontext(worker))
    monkeypatch.setattr(evaluator, "_gather", lambda worker, names, episodes, progress: {"heading": evaluator.objects})
    pools = [OBJECTS[1:2], OBJECTS[2:3]]
    assert list(evaluator.samples_of_pools("heading", pools, 2)) == [OBJECTS[:1], *pools]
    assert built == [(OBJECTS[:1], 5), (OBJECTS[1:2], 6), (OBJECTS[2:3], 7)]
    # The worlds begin anew each time: what was under way belongs to objects that are gone.
    calls = [
        (mock.call.replace_objects(pool, bank), mock.call.measure(pool), mock.call.restart())
        for pool, bank in zip(pools, (2, 3), strict=True)
    ]
    assert worker.mock_calls == [*calls[0], *calls[1]]


def test_procedural_pools_hold_different_objects_in_equal_numbers():
    pools = list(procedural_pools(5, 1_000_000, largest=2))
    assert [len(pool) for pool in pools] == [2, 2, 2]
    names = [obj.name for pool in pools for obj in pool]
    assert names == [obj.name for obj in procedural.generate_many(6, 1_000_000)]


def test_only_constraints_that_differ_between_rows_are_sampled():
    def chances(*constraints):
        task = sampling_config(CONFIG.task, constraints)
        return task.p_affordance, task.p_pose, task.p_trajectory

    assert chances("heading") == (0, 0, 0)
    assert chances("trajectory+affordance") == (1, 0, 1)
    assert chances("pose+trajectory", "trajectory+affordance") == (0.5, 0.5, 1)
    assert chances("heading", "pose") == (0, 0.5, 0)


def test_a_pool_that_never_allows_a_constraint_is_an_error(evaluator, monkeypatch):
    bank = evaluator._bank
    none = bank._replace(has_affordance=np.zeros_like(bank.has_affordance))
    monkeypatch.setattr(evaluator, "_bank", none)
    with pytest.raises(CongraspError, match="None of the 3 objects allows the constraint 'affordance'"):
        evaluator.samples(["heading", "affordance"], 1)
    names, errors = evaluator.allowed(["heading", "affordance"])
    assert names == ["heading"] and "'affordance'" in str(errors[0])
    with pytest.raises(CongraspError, match="'affordance'"):
        evaluator.allowed(["affordance", "trajectory+affordance"])
    with pytest.raises(CongraspError, match="trajectory\\+affordance"):
        evaluator.episode("trajectory+affordance")


@pytest.mark.parametrize("arguments", [["--episodes", "0"], ["--pool", "-1"], ["--friction", "nan"]])
def test_numbers_out_of_range_are_refused(policy, arguments):
    with pytest.raises(CongraspError, match="must"):
        load("evaluate")(["--policy", str(policy), *arguments])()


def test_nominal_mass_and_friction(monkeypatch):
    monkeypatch.setattr("services.evaluate.evaluator.build_bank", lambda *arguments: None)
    ranged = dataclasses.replace(CONFIG.task, mass_range=(0.8, 1.5), friction_range=(0.6, 1.0))
    task = Evaluator(untrained(CONFIG), OBJECTS, task=ranged).task
    assert task.mass_range == (1.0, 1.0) and task.friction_range == (1.0, 1.0)
    assert Evaluator(untrained(CONFIG), OBJECTS, task=ranged, friction=3.0).task.friction_range == (3.0, 3.0)
