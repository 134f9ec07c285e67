"""Evaluation of an untrained policy: the command from end to end, and what it refuses."""

import dataclasses
import hashlib
import importlib.metadata
import json

import numpy as np
import pytest

from congrasp.common.config import NetworkConfig, RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.objects import procedural
from congrasp.common.objects.store import Catalogue
from congrasp.common.policy import bundle as bundles
from congrasp.services.cli.main import load
from congrasp.services.evaluate.evaluator import Evaluator
from congrasp.services.evaluate.loads import Load
from congrasp.services.evaluate.paper import CENTER_GROUP
from congrasp.services.train.command import untrained

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
    assert read["policy"]["sha256"] == hashlib.sha256(policy.read_bytes()).hexdigest()
    assert read["version"] == importlib.metadata.version("congrasp") and read["exam"] is None and read["machine"]
    for row, sample in zip(read["rows"], samples.values(), strict=True):
        assert row["distinct"] <= row["episodes"] and row["success_all"] <= row["success"]
        assert row["pool"] == 3 and sum(obj["episodes"] for obj in row["objects"]) == row["episodes"] >= 3
        assert {obj["episodes"] for obj in row["objects"]} == {row["episodes"] // row["covered"]}
        assert all(obj["name"] in printed and obj.keys() >= {"success", "held_2s", "clean"} for obj in row["objects"])
        assert row["paper"] is None  # its composed rows are of captured constraints
        assert np.all(sample.values["length"] == CONFIG.task.approach_steps + 200)  # with the table, and 2 s without
        assert sample.link_force.shape == (row["episodes"], 25, 16)
        assert sample.torque.shape == (row["episodes"], 25, 20) and 0.0 < sample.torque.max() <= 1.0


@pytest.mark.slow
def test_the_exam_has_a_row_of_the_hands_centre_alone_and_rows_of_loads(evaluator):
    told = []
    row, rules = evaluator.row_by_center(3, told.append)
    assert row.group == CENTER_GROUP and row.episodes == 3 == told[-1] and row.paper.success == 0.96
    assert 0 < rules.kept < rules.kept_by_center < 1
    light, heavy = evaluator.rows_under_loads([Load("light", mass=(0.1, 0.1)), Load("heavy", mass=(2, 2))], print, 3)
    assert (light.group, light.mass_kg, heavy.mass_kg) == ("light", pytest.approx(0.1), pytest.approx(2.0))
    assert light.constraint == "heading" and light.paper is None and heavy.diverged == 0


def test_a_row_is_the_same_alone_and_among_others(evaluator):
    """Equal to the last digit, whatever was simulated before it."""
    names = ["affordance", "heading"]
    among = evaluator.samples(names, 6)
    for name in names:
        alone = evaluator.samples([name], 6)[name]
        for key, column in among[name].values.items():
            np.testing.assert_array_equal(alone.values[key], column, err_msg=f"{name}: {key}")


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


@pytest.mark.slow
def test_an_episode_to_look_at_is_one_of_so_many_attempts(evaluator):
    """The pool has three objects, so that a batch is larger than one attempt, and smaller than nine."""
    for attempts in (1, 9):
        episode = evaluator.episode("heading", attempts)
        assert episode.meta["object"] in {obj.name for obj in OBJECTS} and not episode.meta["success"]
        assert len(episode.arrays["table"]) == len(episode.arrays["q"]) > CONFIG.task.approach_steps


@pytest.mark.parametrize("arguments", [["--episodes", "0"], ["--pool", "-1"], ["--friction", "nan"]])
def test_numbers_out_of_range_are_refused(policy, arguments):
    with pytest.raises(CongraspError, match="must"):
        load("evaluate")(["--policy", str(policy), *arguments])()


def test_nominal_mass_and_friction(monkeypatch):
    monkeypatch.setattr("congrasp.services.evaluate.evaluator.build_bank", lambda *arguments: None)
    ranged = dataclasses.replace(CONFIG.task, mass_range=(0.8, 1.5), friction_range=(0.6, 1.0))
    task = Evaluator(untrained(CONFIG), OBJECTS, task=ranged).task
    assert task.mass_range == (1.0, 1.0) and task.friction_range == (1.0, 1.0)
    assert Evaluator(untrained(CONFIG), OBJECTS, task=ranged, friction=3.0).task.friction_range == (3.0, 3.0)
