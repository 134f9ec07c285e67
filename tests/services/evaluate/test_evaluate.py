"""Evaluation of an untrained policy: the command from end to end, and what it refuses."""

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
from services.evaluate.scores import Sample
from services.evaluate.unseen import evaluate_objects, procedural_pools
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
    arguments = ["--policy", str(policy), "--objects", str(folder), "--table", "composed", "--by", "object"]
    assert load("evaluate")([*arguments, "--episodes", "3", "--batch", "8", "--json", str(out)])() == 0
    read, printed = json.loads(out.read_text()), capsys.readouterr().out
    names = [(row["constraint"], row["group"]) for row in read["rows"]]
    assert names == [("pose+trajectory", ""), ("pose+trajectory", "aligned pairs"), ("trajectory+affordance", "")]
    assert all(row["hand"] == "human" and 0 <= row["held_2s"] <= row["success"] <= 1 for row in read["rows"])
    assert read["physics"] == "native" and "grasps of the reference policy of the human hand" in printed
    for row, sample in zip(read["rows"], samples.values(), strict=True):
        assert row["pool"] == 3 and sum(obj["episodes"] for obj in row["objects"]) == row["episodes"] >= 3
        assert {obj["episodes"] for obj in row["objects"]} == {row["episodes"] // row["covered"]}
        assert all(obj["name"] in printed and obj.keys() >= {"success", "held_2s", "clean"} for obj in row["objects"])
        assert row["paper"] is None  # its composed rows are of captured constraints
        assert np.all(sample.values["length"] == 250)  # 50 steps with the table, 2 s without
        assert sample.link_force.shape == (row["episodes"], 25, 16)
        assert sample.torque.shape == (row["episodes"], 25, 20) and 0.0 < sample.torque.max() <= 1.0


def test_a_row_is_the_same_alone_and_among_others(evaluator):
    """Equal to the last digit, whatever was simulated before it."""
    names = ["affordance", "heading"]
    among = evaluator.samples(names, 6)
    for name in names:
        alone = evaluator.samples([name], 6)[name]
        for key, column in among[name].values.items():
            np.testing.assert_array_equal(alone.values[key], column, err_msg=f"{name}: {key}")


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
    assert (whole.episodes, whole.covered, whole.success) == (30, 6, 1.0)
    by_size = [(row.group.split(" ")[0], row.episodes, row.covered) for row in groups[:3]]
    assert by_size == [("small", 10, 2), ("medium", 10, 2), ("large", 10, 2)]
    assert sum(row.episodes for row in groups if row.group.startswith("family")) == 30
    assert whole.paper.success == 0.927 and groups[2].paper.success == 0.917 and groups[3].paper is None


def test_other_pools_take_the_place_of_the_first(monkeypatch):
    """With nothing compiled anew; their constraints are drawn from seeds of their own."""
    built, runs = [], []

    def build_bank(hand, task, objects, seed):
        built.append((list(objects), seed))
        return len(built)

    monkeypatch.setattr("services.evaluate.evaluator.build_bank", build_bank)
    evaluator, running = Evaluator(untrained(CONFIG), OBJECTS[:1], seed=5), mock.MagicMock()
    running.__enter__.return_value = running
    monkeypatch.setattr(evaluator, "_episodes", lambda episodes: running)
    monkeypatch.setattr(evaluator, "plan", lambda name, episodes: (name, episodes, evaluator.objects))
    monkeypatch.setattr(evaluator, "_run", lambda running, name, plan, bank, progress: runs.append((plan[2], bank)))
    pools = [OBJECTS[1:2], OBJECTS[2:3]]
    assert list(evaluator.samples_of_pools("heading", pools, 2)) == [None] * 3
    assert built == [(OBJECTS[:1], 5), (OBJECTS[1:2], 6), (OBJECTS[2:3], 7)]
    assert runs == [(OBJECTS[:1], 1), (pools[0], 2), (pools[1], 3)]
    assert running.replace_objects.call_args_list == [mock.call(pool) for pool in pools]


def test_procedural_pools_hold_different_objects_in_equal_numbers():
    pools = list(procedural_pools(5, 1_000_000, largest=2))
    assert [len(pool) for pool in pools] == [2, 2, 2]
    names = [obj.name for pool in pools for obj in pool]
    assert names == [obj.name for obj in procedural.generate_many(6, 1_000_000)]


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
