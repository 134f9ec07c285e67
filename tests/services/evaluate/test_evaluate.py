"""Evaluation of an untrained policy: the command from end to end, rows of every kind, and what it refuses."""

import dataclasses
import hashlib
import importlib.metadata
import json
import types

import numpy as np
import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.objects.store import Catalogue
from congrasp.common.policy import bundle as bundles
from congrasp.services.cli.main import load
from congrasp.services.evaluate import episodes as simulation
from congrasp.services.evaluate import protocol, references
from congrasp.services.evaluate.evaluator import Evaluator
from congrasp.services.evaluate.failures import failure_sheets
from congrasp.services.evaluate.loads import Load
from congrasp.services.evaluate.paper import CENTER_GROUP
from tests import task

EPISODES = task.BATCH
"""Of every row, so that all rows share their programs."""
OBJECTS = sorted(task.OBJECTS, key=lambda obj: obj.name)
"""In a folder's order: the command finds the references of these."""


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """Folder of the references: few attempts, in small batches."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        patch.setattr(references, "_ATTEMPTS", 4)
        patch.setattr(references, "ENGINES", {"native": types.SimpleNamespace(batch=16)})
        yield folder / "congrasp" / "references"


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    path = tmp_path_factory.mktemp("policy") / "policy.safetensors"
    bundles.save(task.policy(), path)
    return path


@pytest.fixture(scope="module")
def evaluator():
    return Evaluator(task.policy(), OBJECTS, batch=task.BATCH)


def test_references_are_grasps_and_made_once(evaluator, cache, monkeypatch):
    policy, told = references.reference_policy(task.policy())[0], []
    arguments = (policy, evaluator.task, evaluator.objects, evaluator._bank)
    made = references.make(*arguments, physics="native", threads=2, progress=lambda *counts: told.append(counts))
    assert made.grasps[:, 0].sum() > 8  # most of the 16 episodes succeed
    assert told[-1][0] >= made.grasps.sum() and [count for count, _ in told] == sorted(count for count, _ in told)
    monkeypatch.setattr(references, "Episodes", None)  # nothing is simulated again
    again = references.make(*arguments, physics="native", threads=2)
    assert isinstance(again, references.References)
    np.testing.assert_array_equal(again.bank.pose_q, made.bank.pose_q)
    np.testing.assert_array_equal(again.grasps, made.grasps)
    (kept,) = cache.iterdir()
    whole = kept.read_bytes()
    kept.write_bytes(whole[:1000])
    with pytest.raises(TypeError):  # damaged ones are made again
        references.make(*arguments, physics="native", threads=2)
    kept.write_bytes(whole)


def test_the_command_evaluates_by_the_protocol(policy, tmp_path, capsys, monkeypatch):
    hold = task.TASK.hold_steps
    monkeypatch.setattr(protocol, "HOLD_SECONDS", hold * task.TASK.control_dt)  # the programs are the evaluator's
    monkeypatch.setattr(simulation, "two_seconds", lambda task: 0)  # without the stress test, too
    folder, out, samples = tmp_path / "objects", tmp_path / "rows.json", {}
    for obj in OBJECTS:
        Catalogue(folder).add(obj)
    row = Evaluator.row
    monkeypatch.setattr(Evaluator, "row", lambda self, name, sample: row(self, name, samples.setdefault(name, sample)))
    arguments = ["--policy", str(policy), "--objects", str(folder), "--table", "composed", "--by", "object"]
    assert (
        load("evaluate")([*arguments, "--episodes", str(EPISODES), "--batch", str(EPISODES), "--json", str(out)])() == 0
    )
    read, printed = json.loads(out.read_text()), capsys.readouterr().out
    names = [(row["constraint"], row["group"]) for row in read["rows"]]
    assert names == [("pose+trajectory", ""), ("pose+trajectory", "aligned pairs"), ("trajectory+affordance", "")]
    assert all(row["hand"] == "human" and 0 <= row["held_2s"] <= row["success"] <= 1 for row in read["rows"])
    assert read["physics"] == "native" and "grasps of the reference policy of the human hand" in printed
    assert read["policy"]["sha256"] == hashlib.sha256(policy.read_bytes()).hexdigest()
    assert read["version"] == importlib.metadata.version("congrasp") and read["exam"] is None and read["machine"]
    for row, sample in zip(read["rows"], samples.values(), strict=True):
        assert row["distinct"] <= row["episodes"] and row["success_all"] <= row["success"]
        assert row["pool"] == 4 and sum(obj["episodes"] for obj in row["objects"]) == row["episodes"] >= EPISODES
        assert {obj["episodes"] for obj in row["objects"]} == {row["episodes"] // row["covered"]}
        assert all(obj["name"] in printed and obj.keys() >= {"success", "held_2s", "clean"} for obj in row["objects"])
        assert row["paper"] is None  # its composed rows are of captured constraints
        assert np.all(sample.values["length"] == task.TASK.approach_steps + hold)  # with the table, and without
        assert sample.link_force.shape == (row["episodes"], hold, 16)
        assert sample.torque.shape == (row["episodes"], hold, 20) and 0.0 < sample.torque.max() <= 1.0


def test_rows_by_the_hand_centre_and_under_loads(evaluator):
    told = []
    row, rules = evaluator.row_by_center(EPISODES, told.append)
    assert row.group == CENTER_GROUP and row.episodes == EPISODES == told[-1] and row.paper.success == 0.96
    assert 0 < rules.kept < rules.kept_by_center <= 1 - rules.from_below + 1e-9 and 0 < rules.opposed <= 1
    levels = [Load("light", mass=(0.1, 0.1)), Load("heavy", mass=(2, 2))]
    light, heavy = evaluator.rows_under_loads(levels, print, EPISODES)
    assert (light.group, light.mass_kg, heavy.mass_kg) == ("light", pytest.approx(0.1), pytest.approx(2.0))
    assert light.constraint == "heading" and light.paper is None and heavy.diverged == 0


def test_rows_are_independent(evaluator):
    """Equal to the last digit, whatever was simulated before it."""
    names = ["affordance", "heading"]
    among = evaluator.samples(names, EPISODES)
    for name in names:
        alone = evaluator.samples([name], EPISODES)[name]
        for key, column in among[name].values.items():
            np.testing.assert_array_equal(alone.values[key], column, err_msg=f"{name}: {key}")


def test_rows_of_fingers_and_of_a_force_limit(evaluator):
    samples = evaluator.samples(["fingers", "force"], EPISODES)
    for name, mask in (("fingers", "mask_fingers"), ("force", "mask_force_limit")):
        sample, ratio = samples[name], samples[name].values[f"{name}_ratio"]
        assert (sample.values[mask] == 1).all() and ((ratio >= 0) & (ratio <= 1)).all()
        row = evaluator.row(name, sample)
        assert (row.constraint, row.episodes, row.paper) == (name, EPISODES, None)
        assert f"{name}_ratio" in row.errors and row.errors["heading_rad"] is None
        assert (row.errors[f"{name}_ratio"] is None) == (row.success == 0)
        assert {"force_peak_n", "force_mean_n"} <= set(row.to_json())


def test_a_constraint_that_no_object_allows(evaluator, monkeypatch):
    bank = evaluator._bank
    none = bank._replace(has_affordance=np.zeros_like(bank.has_affordance))
    monkeypatch.setattr(evaluator, "_bank", none)
    with pytest.raises(CongraspError, match="None of the 4 objects allows the constraint 'affordance'"):
        evaluator.samples(["heading", "affordance"], 1)
    names, errors = evaluator.allowed(["heading", "affordance"])
    assert names == ["heading"] and "'affordance'" in str(errors[0])
    with pytest.raises(CongraspError, match="'affordance'"):
        evaluator.allowed(["affordance", "trajectory+affordance"])
    with pytest.raises(CongraspError, match="trajectory\\+affordance"):
        evaluator.plan("trajectory+affordance", 1)


@pytest.mark.slow
def test_failures_of_an_untrained_policy_are_drawn(evaluator):
    sample = evaluator.samples(["heading"], EPISODES, keep=True)["heading"]
    assert not sample.values["held"].any()
    ((name, sheet, causes),) = failure_sheets(evaluator, task.policy(), ["heading"], successes=2, failures=2)
    assert name == "heading" and len(causes) == 2 and "held" not in causes
    assert sheet.shape[0] > 2 * 225 and sheet.shape[1] > 5 * 300


@pytest.mark.parametrize("arguments", [["--episodes", "0"], ["--pool", "-1"], ["--friction", "nan"]])
def test_numbers_out_of_range(policy, arguments):
    with pytest.raises(CongraspError, match="must"):
        load("evaluate")(["--policy", str(policy), *arguments])()


def test_nominal_mass_and_friction_and_two_seconds(monkeypatch):
    assert protocol.two_seconds(task.TASK) == 200
    monkeypatch.setattr("congrasp.services.evaluate.evaluator.build_bank", lambda *arguments: None)
    ranged = dataclasses.replace(task.TASK, mass_range=(0.8, 1.5), friction_range=(0.6, 1.0))
    found = Evaluator(task.policy(), task.OBJECTS, task=ranged).task
    assert found.mass_range == (1.0, 1.0) and found.friction_range == (1.0, 1.0)
    assert Evaluator(task.policy(), task.OBJECTS, task=ranged, friction=3.0).task.friction_range == (3.0, 3.0)
