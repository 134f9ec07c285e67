"""Evaluation of an untrained policy: the command from end to end, rows of every kind, and what it
refuses.
"""

import dataclasses
import hashlib
import importlib.metadata
import json
import math
import types

import numpy as np
import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.objects.store import Catalogue
from congrasp.common.policy import bundle as bundles
from congrasp.common.runtime.engines import ENGINES
from congrasp.common.task.sampling import cache as bank_cache
from congrasp.services.cli.main import load
from congrasp.services.evaluate import episodes as simulation
from congrasp.services.evaluate import plan, references
from congrasp.services.evaluate.episodes import Episodes
from congrasp.services.evaluate.experiment import Experiment, Variation
from congrasp.services.evaluate.heading_rules import heading_rules
from congrasp.services.evaluate.paper.figures import CENTER_GROUP
from congrasp.services.evaluate.pictures import failure_sheets
from congrasp.services.evaluate.variations import Center, Load
from congrasp.services.train.students import TRACKERS
from tests import task

OBJECTS = sorted(task.OBJECTS, key=lambda obj: obj.name)
"""In a folder's order: the command finds bank and references of these."""
EPISODES = len(OBJECTS)
"""Of every row, so that all rows share their programs."""


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """Folder of the references: few attempts, in small batches; and of the bank."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        patch.setattr(bank_cache, "MIN_OBJECTS", 1)
        patch.setattr(references, "MAX_ATTEMPTS", 2)
        patch.setattr(references, "ENGINES", {"native": types.SimpleNamespace(batch=8)})
        yield


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    path = tmp_path_factory.mktemp("policy") / "policy.safetensors"
    bundles.save(task.policy(), path)
    return path


@pytest.fixture(scope="module")
def experiment():
    return Experiment(
        task.policy(), OBJECTS, episodes=EPISODES, batch=EPISODES, hold=task.TASK.hold_steps
    )


@pytest.fixture(scope="module")
def alone(experiment):
    """Results of two rows, each simulated without the other."""
    results = {}
    for constraint in ("affordance", "heading"):
        (results[constraint],) = experiment.run([Variation(constraint)])
    return results


def test_references_are_grasps_and_made_once(experiment, monkeypatch):
    policy = references.reference_policy(task.policy())[0]
    progress = []
    arguments = (policy, experiment.task, experiment.scaled, experiment.bank)
    first = references.make(
        *arguments, physics="native", progress=lambda *counts: progress.append(counts)
    )
    assert first.grasps[:, 0].sum() > 4  # most of the 8 episodes succeed
    assert progress[-1][0] >= first.grasps.sum()
    assert [count for count, _ in progress] == sorted(count for count, _ in progress)
    monkeypatch.setattr(references, "Episodes", None)  # nothing is simulated again
    again = references.make(*arguments, physics="native")
    assert isinstance(again, references.References)
    np.testing.assert_array_equal(again.bank.pose_q, first.bank.pose_q)
    np.testing.assert_array_equal(again.grasps, first.grasps)


def test_the_command_evaluates_by_the_protocol(policy, tmp_path, capsys, monkeypatch):
    hold = task.TASK.hold_steps
    # The programs are the experiment's
    monkeypatch.setattr(plan, "REQUIRED_HOLD_S", hold * task.TASK.control_dt)
    monkeypatch.setattr(
        simulation, "required_hold_steps", lambda task: 0
    )  # without the stress test, too
    folder = tmp_path / "objects"
    out = tmp_path / "rows.json"
    samples = {}
    for obj in OBJECTS:
        Catalogue(folder).add(obj)
    row = Experiment.row
    monkeypatch.setattr(
        Experiment,
        "row",
        lambda self, variation, sample: row(self, variation, samples.setdefault(variation, sample)),
    )
    arguments = [
        "--policy",
        str(policy),
        "--objects",
        str(folder),
        "--table",
        "composed",
        "--by",
        "object",
    ]
    assert (
        load("evaluate")(
            [*arguments, "--episodes", "3", "--batch", str(EPISODES), "--json", str(out)]
        )()
        == 0
    )
    read = json.loads(out.read_text())
    printed = capsys.readouterr().out
    names = [(row["constraint"], row["group"]) for row in read["rows"]]
    assert names == [
        ("pose+trajectory", ""),
        ("pose+trajectory", "aligned pairs"),
        ("trajectory+affordance", ""),
    ]
    assert all(
        row["hand"] == "human" and 0 <= row["held_2s"] <= row["success"] <= 1
        for row in read["rows"]
    )
    assert read["physics"] == "native"
    assert "grasps of the reference policy of the human hand" in printed
    assert read["policy"]["actor_sha256"] == bundles.load(policy).actor_sha256
    assert read["policy"]["sha256"] == hashlib.sha256(policy.read_bytes()).hexdigest()
    assert read["version"] == importlib.metadata.version("congrasp")
    assert read["exam"] is None
    assert read["machine"]
    for row, sample in zip(read["rows"], samples.values(), strict=True):
        assert row["distinct"] <= row["episodes"]
        assert row["success_all"] <= row["success"]
        assert row["pool"] == 4
        assert sum(obj["episodes"] for obj in row["objects"]) == row["episodes"] >= 3
        assert {obj["episodes"] for obj in row["objects"]} == {row["episodes"] // row["covered"]}
        assert all(
            obj["name"] in printed and obj.keys() >= {"success", "held_2s", "clean"}
            for obj in row["objects"]
        )
        assert row["paper"] is None  # its composed rows are of captured constraints
        # With the table, and without
        assert np.all(sample.values["length"] == task.TASK.approach_steps + hold)
        assert sample.link_force.shape == (row["episodes"], hold, 16)
        assert sample.torque.shape == (row["episodes"], hold, 20)
        assert 0.0 < sample.torque.max() <= 1.0


def test_rows_by_the_hand_centre_and_under_loads(experiment):
    light, heavy, center = (
        result.row
        for result in experiment.run(
            [Load(label="light", mass=(0.1, 0.1)), Load(label="heavy", mass=(2, 2)), Center()]
        )
    )
    assert center.group == CENTER_GROUP
    assert center.episodes == EPISODES
    assert center.paper.success == 0.96
    assert light.group == "light"
    assert light.mass_kg == pytest.approx(0.1)
    assert heavy.mass_kg == pytest.approx(2.0)
    assert light.constraint == "heading"
    assert light.paper is None
    assert heavy.diverged == 0
    assert center.mass_kg == pytest.approx(np.mean([obj.mass for obj in experiment.scaled])), (
        "its own objects again"
    )


def test_shares_of_the_rules_for_headings(experiment):
    """They add up, and agree with the bank."""
    rules = heading_rules(experiment)
    bank = experiment.bank
    assert rules.kept + rules.from_below + rules.no_room == pytest.approx(1.0)
    assert 0 <= rules.moved <= 1
    assert 0 < rules.kept < rules.kept_by_center <= 1 - rules.from_below + 1e-9
    assert 0 < rules.opposed <= 1
    unchanged = 0
    for heading_index, rests in zip(
        np.asarray(bank.heading_index), np.asarray(bank.rest), strict=True
    ):
        different = len(np.unique(rests, axis=0))
        unchanged += sum(len(set(indices)) for indices in heading_index[0, :different])
    assert rules.kept * 256 * sum(
        len(obj.rest_poses) for obj in experiment.scaled
    ) == pytest.approx(unchanged)


def test_rows_are_independent_and_kept_episodes_are_drawn(experiment, alone):
    """Equal to the last digit, whatever was simulated before it, and whether every step is
    recorded.
    """
    among = experiment.run([Variation("affordance"), Variation()], keep=True)
    for expected, result in zip(alone.values(), among, strict=True):
        for key, column in result.sample.values.items():
            np.testing.assert_array_equal(
                expected.sample.values[key], column, err_msg=f"{result.variation}: {key}"
            )
        assert expected.row.to_json() == result.row.to_json()
        assert not expected.examples(1, 1)
    heading = among[1]
    assert len(heading.held) == heading.sample.values["held"].sum() == EPISODES - len(heading.lost)
    ((name, sheet, causes),) = failure_sheets(experiment, [heading], successes=2, failures=2)
    assert name == "heading"
    assert len(causes) == len(heading.examples(2, 2))
    assert sheet.shape[0] > 2 * 225
    assert sheet.shape[1] > 5 * 300


def test_rows_in_common_batches_are_the_same_episodes(experiment, alone, monkeypatch):
    """As engines on a device run them."""
    changed = [
        Center(),
        Load(label="heavy", mass=(2, 2)),
        Load(label="light", mass=(0.02, 0.02)),
    ]
    center, heavy, light = experiment.run(changed)
    separate = [alone["affordance"], center, alone["heading"], heavy, light]
    monkeypatch.setitem(ENGINES, "native", ENGINES["native"]._replace(on_device=True))
    batches = []
    run = Episodes.run

    def counted(*arguments, **options):
        batches.append(arguments)
        return run(*arguments, **options)

    monkeypatch.setattr(Episodes, "run", counted)
    progress = []
    tracked = dataclasses.replace(experiment, track=lambda label, total: progress.append)
    together = tracked.run([result.variation for result in separate])
    episodes = sum(result.row.episodes for result in separate)
    assert len(batches) == math.ceil(episodes / EPISODES)
    assert progress[-1] == episodes
    assert progress == sorted(progress)
    for expected, result in zip(separate, together, strict=True):
        for key, column in expected.sample.values.items():
            np.testing.assert_array_equal(result.sample.values[key], column, err_msg=key)
        assert result.row.to_json() == expected.row.to_json()


def test_a_stopped_evaluation_resumes_at_its_current_row(experiment, alone, tmp_path, monkeypatch):
    variations = [Variation("affordance"), Variation()]
    simulated = []
    sample = Experiment.sample

    def stopping(experiment, simulator, variation, *arguments):
        simulated.append(variation.constraint)
        if simulated == ["affordance", "heading"]:
            raise KeyboardInterrupt
        return sample(experiment, simulator, variation, *arguments)

    monkeypatch.setattr(Experiment, "sample", stopping)
    with pytest.raises(KeyboardInterrupt):
        experiment.run(variations, stored=tmp_path)
    rows = [result.row.to_json() for result in experiment.run(variations, stored=tmp_path)]
    assert simulated == ["affordance", "heading", "heading"]
    assert rows == [result.row.to_json() for result in alone.values()]
    dataclasses.replace(experiment, seed=1).run(variations[:1], stored=tmp_path)
    assert simulated[3:] == ["affordance"]  # with other settings again


def test_rows_of_fingers_and_of_a_force_limit(experiment):
    for result, mask in zip(
        experiment.run([Variation("fingers"), Variation("force")]),
        ("mask_fingers", "mask_force_limit"),
        strict=True,
    ):
        name = result.variation.constraint
        sample = result.sample
        row = result.row
        ratio = sample.values[f"{name}_ratio"]
        assert (sample.values[mask] == 1).all()
        assert ((ratio >= 0) & (ratio <= 1)).all()
        assert (row.constraint, row.episodes, row.paper) == (name, EPISODES, None)
        assert f"{name}_ratio" in row.errors
        assert row.errors["heading_rad"] is None
        assert (row.errors[f"{name}_ratio"] is None) == (row.success == 0)
        assert {"force_peak_n", "force_mean_n"} <= set(row.to_json())


def test_a_constraint_that_no_object_allows(experiment):
    bank = experiment.bank
    none = bank._replace(has_affordance=np.zeros_like(bank.has_affordance))
    without_constraint = dataclasses.replace(experiment, constraints=none)
    heading, affordance, composed = map(
        Variation, ("heading", "affordance", "trajectory+affordance")
    )
    with pytest.raises(
        CongraspError, match="None of the 4 objects allows the constraint 'affordance'"
    ):
        without_constraint.run([heading, affordance])
    allowed, errors = without_constraint.allowed([heading, affordance])
    assert allowed == [heading]
    assert "'affordance'" in str(errors[0])
    with pytest.raises(CongraspError, match="'affordance'"):
        without_constraint.allowed([affordance, composed])
    with pytest.raises(CongraspError, match="trajectory\\+affordance"):
        without_constraint.plan(composed)


@pytest.mark.parametrize(
    "arguments", [["--episodes", "0"], ["--pool", "-1"], ["--friction", "nan"]]
)
def test_numbers_out_of_range(policy, arguments):
    with pytest.raises(CongraspError, match="must"):
        load("evaluate")(["--policy", str(policy), *arguments])()


def test_nominal_mass_and_friction_and_two_seconds():
    assert Experiment(task.policy(), []).steps == plan.required_hold_steps(task.TASK) == 200
    ranged = dataclasses.replace(
        task.TASK,
        mass_range=(0.8, 1.5),
        friction_range=(0.6, 1.0),
        gain_range=(0.8, 1.2),
        sensing=TRACKERS,
    )
    evaluated_task = Experiment(dataclasses.replace(task.policy(), task=ranged), []).task
    assert (
        evaluated_task.mass_range
        == evaluated_task.friction_range
        == evaluated_task.gain_range
        == (1.0, 1.0)
    )
    assert evaluated_task.sensing == task.TASK.sensing, "a perfect tracker"
    assert Experiment(task.policy(), [], friction=3.0).task.friction_range == (3.0, 3.0)
