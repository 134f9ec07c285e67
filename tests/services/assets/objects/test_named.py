"""Objects that a user points to."""

import os
import pathlib
import re

import pytest
import trimesh

from congrasp.common.errors import CongraspError
from congrasp.common.objects.procedural import generate
from congrasp.common.objects.store import Catalogue, digest
from congrasp.services.assets.objects.named import find_object, objects_at


def test_a_family_and_a_seed_name_an_object_wherever_paths_do():
    (obj,) = objects_at(pathlib.Path("mug:7"))
    assert obj.name == "mug_7"
    assert digest(obj.load()) == digest(find_object("mug:7")) == digest(generate(7, "mug"))


@pytest.mark.parametrize("text", ["mug:", ":7", "mug:x", "nothing.obj"])
def test_other_text_is_a_path(tmp_path, monkeypatch, text):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CongraspError):
        objects_at(pathlib.Path(text))


def test_meshes_deeper_inside_are_named_without_hidden_ones(tmp_path):
    folder = tmp_path / "sets"
    for file in (
        "syn/.git/x.obj",
        "syn/__MACOSX/x.obj",
        "syn/a/._x.obj",
        "syn/id/models/model_normalized.obj",
    ):
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).touch()
    (folder / "syn" / "a" / "folder.obj").mkdir()
    with pytest.raises(
        CongraspError,
        match=r"deeper subfolders, such as \S+/syn/id/models/model_normalized\.obj\. ",
    ):
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


def test_objects_are_found_by_name_file_mesh_and_seed(tmp_path, monkeypatch, quick_import):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    obj = find_object("mug:7")
    path = Catalogue(tmp_path).add(obj)
    monkeypatch.chdir(tmp_path)
    assert (
        digest(find_object(str(path))) == digest(find_object("mug_7", str(tmp_path))) == digest(obj)
    )
    trimesh.creation.box((0.04, 0.05, 0.06)).export(tmp_path / "block.stl")
    assert find_object(str(tmp_path / "block.stl")).name == "block"
    with pytest.raises(CongraspError, match="no object 'mug_8'"):
        find_object("mug_8", str(tmp_path))
    with pytest.raises(CongraspError, match="no object family 'cat'"):
        find_object("cat:1")


def test_a_name_that_is_also_a_path_is_ambiguous(tmp_path, monkeypatch, quick_import):
    from congrasp.services.cli import constraints
    from congrasp.services.grasp.jobs import find_objects

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    stored = Catalogue("objects").add(find_object("mug:7"))
    (tmp_path / "mug_7").mkdir()
    (tmp_path / "mug_7" / "grasp.npz").touch()
    assert find_object("mug_7").name == "mug_7"  # which a folder of grasps leaves alone
    trimesh.creation.box((0.04, 0.05, 0.06)).export(tmp_path / "mug_7" / "block.stl")
    ambiguity = r"'mug_7' is ambiguous: .* Pass \./mug_7 or objects/mug_7\.safetensors"
    for find in (find_object, lambda name: constraints.Generate((name,))()):
        with pytest.raises(CongraspError, match=ambiguity):
            find("mug_7")
    ((mesh, mug), (error,)) = find_objects(["./mug_7", str(stored), "mug_7"])
    assert mesh.source
    assert not mug.source
    assert re.search(ambiguity, error.error)
