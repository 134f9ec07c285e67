"""Policies that come with the package."""

import pathlib
import tomllib

import pytest

from common.errors import CongraspError
from common.policy import bundle as bundles
from common.policy import pretrained as module
from common.policy.pretrained import policy_file, pretrained_file, pretrained_hands

ROOT = pathlib.Path(module.__file__).resolve().parents[2]


def test_a_command_takes_what_it_is_given_before_what_is_shipped(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_FOLDER", tmp_path)
    given = tmp_path / "mine.safetensors"
    assert policy_file(given) == given
    with pytest.raises(CongraspError, match=r"none comes with this installation for the hand 'human'.*--policy"):
        policy_file(None)
    with pytest.raises(CongraspError, match="no hand 'paw'"):
        policy_file(None, "paw")
    (tmp_path / "human.safetensors").touch()
    assert policy_file(None) == pretrained_file("human") == tmp_path / "human.safetensors"
    assert pretrained_file("allegro") is None


def test_what_is_shipped_is_installed_and_can_be_loaded():
    data = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    patterns = [pathlib.Path("common/policy", pattern) for pattern in data["common.policy"]]
    assert [module._FOLDER.relative_to(ROOT) / "*.safetensors"] == patterns
    assert pretrained_hands() == ["human", "allegro", "sharpa"]
    assert {path.stem for path in module._FOLDER.glob("*.safetensors")} == {
        f"{hand}{kind}" for hand in pretrained_hands() for kind in ("", "-reference")
    }
    for hand in pretrained_hands():
        assert bundles.load(policy_file(None, hand)).spec.hand == hand
