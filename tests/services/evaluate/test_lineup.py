"""Which policies the tables of several compare."""

import dataclasses
import json

import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import pretrained_hands
from congrasp.common.task.methods import with_method
from congrasp.services.cli.main import load
from congrasp.services.evaluate import tables
from congrasp.services.evaluate.captured import CapturedObjects
from congrasp.services.evaluate.lineup import ABLATION, line_up, read_entrants
from congrasp.services.train.command import untrained
from tests.rows import row
from tests.task import CONFIG


@pytest.fixture
def saved(tmp_path):
    """Saves an untrained policy of a method, and returns its file."""

    def save(method, hand="human", folder=""):
        config = CONFIG if method == "ours" else with_method(CONFIG, method)
        config = dataclasses.replace(config, task=dataclasses.replace(config.task, hand=hand))
        path = tmp_path / (folder or f"{hand}-{method}") / "policy.safetensors"
        bundles.save(untrained(config), path)
        return path

    return save


def who(lineup):
    return [(one.hand, one.method, tables) for one, tables in lineup.entrants]


def test_hands_are_those_with_a_pretrained_policy_unless_policies_are_named(saved):
    everyone = [(hand, "ours", ("single",)) for hand in pretrained_hands()]
    assert who(line_up(["hands"], [], "human")) == everyone
    assert len(everyone) == 3
    named = read_entrants([str(saved("ours")), str(saved("ours", "allegro"))])
    assert who(line_up(["hands"], named, "human")) == [
        ("human", "ours", ("single",)),
        ("allegro", "ours", ("single",)),
    ]


def test_a_method_without_a_policy_is_named_and_no_error(saved):
    entrants = read_entrants([f"no-feedforward={saved('no-feedforward')}"])
    lineup = line_up(["ablation"], entrants, "human")
    assert who(lineup) == [("human", "ours", ("single",)), ("human", "no-feedforward", ("single",))]
    absent = [(one.hand, one.method, one.reason) for one in lineup.missing]
    assert absent == [
        ("human", name, "not trained")
        for name in ABLATION
        if name not in ("ours", "no-feedforward")
    ]


def test_a_student_is_compared_with_the_pretrained_policy(saved):
    student = read_entrants([str(saved("student"))])
    both = [("human", "ours", ("sensing",)), ("human", "student", ("sensing",))]
    assert who(line_up(["sensing"], student, "human")) == both
    assert who(line_up(["sensing"], [], "allegro")) == [("allegro", "ours", ("sensing",))]
    lineup = line_up(["single", "sensing"], student, "human")
    assert dict((name, tables) for _, name, tables in who(lineup)) == {
        "student": ("single", "sensing"),
        "ours": ("sensing",),
    }


def test_a_policy_is_evaluated_once_for_all_its_tables(saved):
    entrants = read_entrants([str(saved("ours"))])
    lineup = line_up(["single", "composed", "hands", "ablation", "single"], entrants, "human")
    assert who(lineup) == [("human", "ours", ("single", "composed"))]
    assert who(line_up(["composed"], [], "allegro")) == [("allegro", "ours", ("composed",))]


def test_a_folder_means_the_policies_of_its_runs(saved, tmp_path):
    for method in ("ours", "two-phase"):
        saved(method)
    assert [one.method for one in read_entrants([str(tmp_path)])] == ["ours", "two-phase"]
    assert [one.method for one in read_entrants([str(tmp_path / "human-ours")])] == ["ours"]


def test_a_method_that_does_not_learn_takes_any_policys_hand(saved):
    (one,) = read_entrants([f"pd={saved('ours')}"])
    assert one.method == "pd"
    assert one.policy.task.control.finger_scale == 0.0


@pytest.mark.parametrize(
    ("texts", "words"),
    [
        (["graspxl={ours}"], "has the method 'ours', not 'graspxl'"),
        (["levitate={ours}"], "no method 'levitate'"),
        (["{ours}", "{other}"], "Two policies have the hand 'human' and the method 'ours'"),
        (["{empty}"], "contains no policy.safetensors"),
        (["/nonexistent/policy.safetensors"], "cannot be read"),
    ],
)
def test_incomparable_entrants_are_refused(saved, tmp_path, texts, words):
    (tmp_path / "empty").mkdir()
    names = {
        "ours": saved("ours"),
        "other": saved("ours", folder="other"),
        "empty": tmp_path / "empty",
    }
    with pytest.raises(CongraspError, match=words):
        read_entrants([text.format(**names) for text in texts])


def test_the_command_prints_and_writes_all_of_them(saved, tmp_path, capsys, monkeypatch):
    def evaluate_tables(own, names, pools, kept, *, keep):
        assert names == ("single",)
        assert own.episodes == 7
        assert pools is None
        assert not keep
        return tables.Evaluation(
            own, [], [row("heading", 0.9, 0.8, 0.95, method=own.policy.task.method)], [], ""
        )

    monkeypatch.setattr(tables, "evaluate_tables", evaluate_tables)
    monkeypatch.setattr("congrasp.services.evaluate.exams.exam_pool", lambda exam, count: [])
    files = [str(saved("ours")), f"no-feedforward={saved('no-feedforward')}"]
    command = [
        "--table",
        "ablation",
        "--policy",
        *files,
        "--episodes",
        "7",
        "--json",
        str(tmp_path / "rows.json"),
    ]
    assert load("evaluate")(command)() == 0
    printed = capsys.readouterr().out
    read = json.loads((tmp_path / "rows.json").read_text())
    assert "2 policies, on procedural objects (figures)" in printed
    assert printed.count("not trained") == 3
    assert [one["method"] for one in read["rows"]] == ["ours", "no-feedforward"]
    assert [one["method"] for one in read["policies"]] == ["ours", "no-feedforward"]
    missing = [(one["method"], one["reason"]) for one in read["missing"]]
    assert missing == [
        (name, "not trained") for name in ("no-dynamic-center", "single-stage", "two-phase")
    ]
    assert not (tmp_path / "rows.json.parts").exists()


def test_captured_sets_of_one_hand_are_not_evaluated_with_another(monkeypatch, tmp_path):
    sets = CapturedObjects([], None, "human", "captured")
    monkeypatch.setattr(
        "congrasp.services.evaluate.captured.captured_objects", lambda folder, split, objects: sets
    )
    monkeypatch.setattr(
        "congrasp.services.assets.objects.named.objects_of", lambda *arguments, **options: []
    )
    command = ["--hand", "allegro", "--objects", str(tmp_path), "--constraints", str(tmp_path)]
    with pytest.raises(
        CongraspError,
        match=r"sets are for the hand 'human', but the policy is for 'allegro'.*--hand allegro",
    ):
        load("evaluate")(command)()
