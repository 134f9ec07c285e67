"""Names in the files of data sets lead nowhere else."""

import pathlib
import types

import pytest

from congrasp.common.errors import CongraspError
from congrasp.services.assets.captures import build, dexycb
from congrasp.services.assets.captures.dexycb import calibrated_shape
from congrasp.services.assets.captures.grab import hand_template
from congrasp.services.assets.captures.sequence import Dropped, Meshes


def test_names_in_data_sets_stay_inside_their_folders(tmp_path):
    (tmp_path / "x.obj").write_text("v 0 0 0\n")
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "y.obj").write_text("v 0 0 0\n")
    meshes = Meshes((tmp_path / "in",))
    assert meshes.find("a", "none", "y") == tmp_path / "in" / "y.obj"
    for name in ("../x", str(tmp_path / "x"), ".."):
        with pytest.raises(CongraspError, match="cannot name the mesh"):
            meshes.find("a", name)
    with pytest.raises(CongraspError, match="cannot name a calibration"):
        calibrated_shape("a", tmp_path / "in", "/../../x")
    inside, outside = ({"rhand/vtemp": name} for name in ("y.obj", "../x.obj"))
    assert hand_template(tmp_path / "in", inside) == pathlib.Path(tmp_path / "in" / "y.obj")
    assert hand_template(tmp_path / "in", outside) is None


def test_objects_of_one_name_and_different_meshes_get_different_names(tmp_path, monkeypatch):
    named = []
    monkeypatch.setattr(
        build, "import_sources", lambda sources, options: named.extend(sources) or []
    )
    files = [tmp_path / folder / "cup.obj" for folder in "aba"]
    for file in files[:2]:
        file.parent.mkdir()
        file.write_text("v 0 0 0\n")
    build.import_shapes(
        [types.SimpleNamespace(mesh=file, object_name="cup") for file in files], print
    )
    assert [(source.path, source.name) for source in named] == [
        (files[0], "cup"),
        (files[1], "cup-2"),
    ]


def dropped_for(folder, text):
    """Reads the one sequence of a data set, whose `meta.yml` has this text."""
    session = folder / "subject" / "session"
    session.mkdir(parents=True)
    (session / "meta.yml").write_text(text)
    (sequence,) = dexycb.read(folder, Meshes(()), types.SimpleNamespace())
    return sequence


@pytest.mark.parametrize("text", ["[" * 50_000, "a: " * 5, "\x00", "- a", "a: &x [1]\nb: [*x, *x]"])
def test_damaged_settings_drop_their_sequence(tmp_path, text):
    assert isinstance(dropped_for(tmp_path, text), Dropped)


def test_a_mesh_folder_without_a_mesh_or_with_several_is_refused(tmp_path):
    with pytest.raises(CongraspError, match="contains no STL"):
        build.source_of(tmp_path)
    for name in "ab":
        (tmp_path / f"{name}.stl").write_bytes(b"")
    with pytest.raises(CongraspError, match="contains 2 objects"):
        build.source_of(tmp_path)


@pytest.mark.parametrize("value", ["a", "[1]", "{b: 1}", "null"])
def test_settings_of_other_types_drop_their_sequence_alone(tmp_path, value):
    text = f"mano_sides: [right]\nycb_ids: [1]\nycb_grasp_ind: {value}\nmano_calib: [x]\n"
    dropped = dropped_for(tmp_path, text)
    assert isinstance(dropped, Dropped)
    assert dropped.rule == "wrong layout"
