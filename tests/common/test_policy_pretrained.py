"""Policies that come with the package."""

import dataclasses
import itertools
import pathlib
import tomllib

import pytest

from congrasp.common.config import NetworkConfig, RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.files import hand_text
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy import pretrained as module
from congrasp.common.policy import ship
from congrasp.common.policy.pretrained import (
    hands_with_policy,
    named_policy,
    own_policy_file,
    policy_file,
    pretrained_file,
    pretrained_hands,
)
from congrasp.common.task.config import TaskConfig
from congrasp.services.evaluate.lineup import read_entrants
from congrasp.services.train.command import untrained

ROOT = pathlib.Path(module.__file__).resolve().parents[2]


def test_a_given_policy_precedes_the_shipped_one(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "FOLDER", tmp_path)
    custom = tmp_path / "mine.safetensors"
    assert policy_file(custom) == custom
    with pytest.raises(
        CongraspError, match=r"this installation has none for the hand 'human'.*--policy"
    ):
        policy_file(None)
    with pytest.raises(CongraspError, match="no hand 'paw'"):
        policy_file(None, "paw")
    (tmp_path / "human.safetensors").touch()
    assert policy_file(None) == pretrained_file("human") == tmp_path / "human.safetensors"
    assert pretrained_file("allegro") is None


def test_a_custom_hand_has_its_custom_policy(tmp_path, monkeypatch):
    monkeypatch.setenv("CONGRASP_HANDS", str(tmp_path))
    get_hand.cache_clear()
    hand = dataclasses.replace(get_hand("human"), name="mine")
    (tmp_path / "mine.json").write_text(hand_text(hand))
    assert pretrained_file("mine") is None
    assert hands_with_policy() == pretrained_hands()
    with pytest.raises(CongraspError, match=r"for the hand 'mine'.*congrasp hands train"):
        policy_file(None, "mine")
    task = TaskConfig(hand=get_hand("mine").reference, constraints=("heading",))
    small = RunConfig(task=task, network=NetworkConfig(hidden=(8,), encoder=4))
    bundles.save(untrained(small), own_policy_file("mine"))
    assert (
        policy_file(None, "mine")
        == tmp_path / "mine.safetensors"
        == pretrained_file(get_hand("mine").reference)
    )
    assert hands_with_policy() == [*pretrained_hands(), "mine"]
    # Another hand of the same name as one of the package does not get the package's policy.
    (tmp_path / "human.json").write_text(hand_text(get_hand("human")))
    assert pretrained_file(str(tmp_path / "human.json")) is None
    assert pretrained_file("human").parent == module.FOLDER
    # Nor has a hand that was changed since the policy of the hand as it was before.
    (tmp_path / "mine.json").write_text(hand_text(dataclasses.replace(hand, object_scale=0.9)))
    get_hand.cache_clear()
    with pytest.raises(CongraspError, match=r"for an earlier version of the hand's file.*--policy"):
        policy_file(None, "mine")
    get_hand.cache_clear()


def test_shipped_policies_are_installed_and_load():
    data = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"][
        "package-data"
    ]
    patterns = [
        pathlib.Path("congrasp/common/policy", pattern)
        for pattern in data["congrasp.common.policy"]
    ]
    assert [module.FOLDER.relative_to(ROOT) / "*.safetensors"] == patterns
    assert pretrained_hands() == ["human", "allegro", "sharpa"]
    assert {path.stem for path in module.FOLDER.glob("*.safetensors")} == {
        f"{hand}{kind}"
        for hand, kind in itertools.product(
            pretrained_hands(), ("", "-reference", "-student", "-camera")
        )
    }
    for hand in pretrained_hands():
        assert bundles.load(policy_file(None, hand)).spec.hand == hand


@pytest.mark.parametrize("file", sorted(module.FOLDER.glob("*.safetensors")), ids=lambda f: f.stem)
def test_shipped_policy_has_no_critic(file):
    assert not bundles.load(file).has_critic


def test_shipping_leaves_out_the_critic(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(module, "FOLDER", tmp_path)
    task = TaskConfig(constraints=("heading",))
    trained = untrained(RunConfig(task=task, network=NetworkConfig(hidden=(8,), encoder=4)))
    bundles.save(trained, tmp_path / "run.safetensors")
    ship.main([str(tmp_path / "run.safetensors"), "mine"])
    shipped = bundles.load(tmp_path / "mine.safetensors")
    assert not shipped.has_critic
    assert shipped.actor_sha256 == trained.actor_sha256
    assert trained.actor_sha256 in capsys.readouterr().out


def test_a_policy_of_the_package_is_given_by_its_name(tmp_path, monkeypatch):
    """Unless a file here has it."""
    monkeypatch.chdir(tmp_path)
    name = "allegro-student"
    file = named_policy(name)
    assert file == policy_file(pathlib.Path(name)) == module.FOLDER / f"{name}.safetensors"
    student = bundles.load(file).task
    teacher = bundles.load(policy_file(None, "allegro")).task
    assert student.observation == "tracked"
    assert student.hand == teacher.hand
    (entrant,) = read_entrants([name])
    assert entrant.hand == "allegro"
    assert entrant.method == "student"
    (tmp_path / name).touch()
    assert policy_file(pathlib.Path(name)) == pathlib.Path(name)
    assert policy_file(pathlib.Path("folder", name)) == pathlib.Path("folder", name)
