"""Objects that a user points to."""

import os
import pathlib

import pytest
import trimesh

from congrasp.common.errors import CongraspError
from congrasp.common.objects.procedural import generate
from congrasp.common.objects.store import digest
from congrasp.services.assets.objects.named import find_object, objects_at


def test_a_family_and_a_seed_name_an_object_wherever_paths_do():
    (found,) = objects_at(pathlib.Path("mug:7"))
    assert found.name == "mug_7" and digest(found.load()) == digest(find_object("mug:7")) == digest(generate(7, "mug"))


@pytest.mark.parametrize("text", ["mug:", ":7", "mug:x", "nothing.obj"])
def test_other_text_is_a_path(tmp_path, monkeypatch, text):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CongraspError):
        objects_at(pathlib.Path(text))


def test_meshes_deeper_inside_are_named_without_hidden_ones(tmp_path):
    folder = tmp_path / "sets"
    for file in ("syn/.git/x.obj", "syn/__MACOSX/x.obj", "syn/a/._x.obj", "syn/id/models/model_normalized.obj"):
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).touch()
    (folder / "syn" / "a" / "folder.obj").mkdir()
    with pytest.raises(CongraspError, match=r"deeper inside alone, such as \S+/syn/id/models/model_normalized\.obj\. "):
        objects_at(folder)


def test_a_family_that_does_not_exist_is_named():
    with pytest.raises(CongraspError, match="mugg"):
        objects_at(pathlib.Path("mugg:7"))


def test_a_file_of_that_name_comes_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pathlib.Path("mug:7").mkdir()
    with pytest.raises(CongraspError):  # an empty folder
        objects_at(pathlib.Path("mug:7"))


def test_a_name_in_another_encoding_is_a_name(tmp_path, quick_import):
    path = tmp_path / os.fsdecode(b"m\xfcg.stl")
    trimesh.creation.box((0.05, 0.05, 0.1)).export(path)
    assert find_object(str(path)).name == "m_g"
