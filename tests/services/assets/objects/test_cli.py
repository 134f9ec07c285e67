"""`congrasp objects …` as a user meets it."""

import os
import re

import numpy as np
import pytest
import trimesh
from PIL import Image

from congrasp.common.errors import CongraspError
from congrasp.common.objects.store import Catalogue
from congrasp.services.assets.objects import assembly
from congrasp.services.assets.objects.named import find_object
from congrasp.services.cli import main as cli
from congrasp.services.cli.main import load
from tests.printed import errors

parse = load("objects")


def test_generate_list_and_show(tmp_path, capsys):
    folder = str(tmp_path / "things")
    assert (
        parse(
            [
                "generate",
                "--out",
                folder,
                "--count",
                "4",
                "--seed",
                "3",
                "--families",
                "mug",
                "knife",
            ]
        )()
        == 0
    )
    assert Catalogue(folder).list() == ["knife_3", "knife_5", "mug_4", "mug_6"]
    assert parse(["list", folder])() == 0
    output = capsys.readouterr().out
    assert "4 objects are in" in output
    assert all(word in output for word in ("mug_6", "knife_3", "handle", "blade"))
    assert parse(["list", folder, "--png", str(tmp_path / "all.png")])() == 0
    assert f"The picture is {tmp_path / 'all.png'}" in capsys.readouterr().out.replace("\n", "")
    assert Image.open(tmp_path / "all.png").width > 7 * 200
    (tmp_path / "things" / "bad.safetensors").write_bytes(b"no object")
    assert parse(["list", folder])() == 2
    captured = capsys.readouterr()
    assert "bad.safetensors cannot be read" in captured.err
    assert "mug_6" in captured.out
    picture = tmp_path / "knife.png"
    assert parse(["show", "knife_3", "--folder", folder, "--png", str(picture)])() == 0
    output = capsys.readouterr().out
    assert "handle" in output
    assert "resting pose 1" in output
    image = np.asarray(Image.open(picture).convert("RGB")).reshape(-1, 3).astype(int)
    green = (image[:, 1] - image[:, 0] > 60) & (image[:, 1] - image[:, 2] > 60)
    red = (image[:, 0] - image[:, 1] > 80) & (image[:, 0] - image[:, 2] > 60)
    assert green.sum() > 100
    assert red.sum() > 100


def test_resting_poses_are_listed_and_drawn(tmp_path, capsys):
    poses = find_object("mug:7").rest_poses
    assert parse(["rests", "mug:7", "--png", str(tmp_path / "rests.png")])() == 0
    rows = [
        line.strip("│ ").split("│")
        for line in capsys.readouterr().out.splitlines()
        if line.startswith("│")
    ]
    assert [int(row[0]) for row in rows] == list(range(1, len(poses) + 1))
    assert float(rows[0][1]) == pytest.approx(100 * poses[0][2], abs=0.05)
    assert {0, 180} < {int(row[2]) for row in rows}  # it stands on its bottom, and on its rim
    assert Image.open(tmp_path / "rests.png").width == len(poses) * (240 + 10) + 10


def test_import_continues_after_a_bad_mesh_with_an_exit_code(tmp_path, capsys, quick_import):
    trimesh.creation.box((0.04, 0.05, 0.06)).export(tmp_path / "good.stl")
    trimesh.creation.box((40, 50, 60)).export(tmp_path / "big.stl")
    (tmp_path / "text.ply").write_text("no mesh")
    paths = [str(tmp_path / name) for name in ("big.stl", "text.ply", "missing", "good.stl")]
    common = ["--out", str(tmp_path / "out"), "--cache-dir", str(tmp_path / "cache")]
    assert parse(["import", *paths, *common])() == 2
    captured = capsys.readouterr()
    lines = errors(captured.err)
    assert len(lines) == 3
    assert all(line.startswith("congrasp: error: ") for line in lines)
    assert "1 of 4 imported" in captured.out
    assert Catalogue(tmp_path / "out").list() == ["good"]
    assert parse(["import", paths[0], "--unit", "mm", *common])() == 0
    assert Catalogue(tmp_path / "out").list() == ["big", "good"]
    assert parse(["import", str(tmp_path / "good.stl"), "--mass", "0.25", *common])() == 0
    assert Catalogue(tmp_path / "out").get("good").mass == 0.25


def test_a_folder_s_unusable_files_are_named_and_its_mesh_is_imported(
    tmp_path, capsys, quick_import
):
    things = tmp_path / "things"
    (things / "folder.stl").mkdir(parents=True)
    os.mkfifo(things / "pipe.obj")
    (things / "gone.obj").symlink_to("nowhere.obj")
    trimesh.creation.box((0.04, 0.05, 0.06)).export(things / "good.ply", encoding="ascii")
    text = (things / "good.ply").read_text()
    (things / "x.ply").write_text(text.replace("float x", "float X"))
    (things / "list.ply").write_text(text.replace("list uchar int vertex_indices", "int corners"))
    (things / "zip.obj").write_text("PK\3\4 box.obj\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert (
        parse(
            [
                "import",
                str(things),
                "--out",
                str(tmp_path / "out"),
                "--cache-dir",
                str(tmp_path / "cache"),
            ]
        )()
        == 2
    )
    captured = capsys.readouterr()
    assert "1 of 7 imported" in captured.out
    assert len(errors(captured.err)) == 6
    for words in (
        *(
            "folder.stl is not a regular",
            "pipe.obj is not a regular",
            "gone.obj cannot be read: No such file",
        ),
        *(
            "x.ply .* lack x, y or z",
            "list.ply .* lack vertex_indices",
            "zip.obj is a zip archive that is damaged",
        ),
    ):
        assert re.search(words, captured.err)
    with pytest.raises(CongraspError, match=r"no file .*gone\.obj\. Did you mean .*pipe\.obj"):
        cli.run(["objects", "import", str(things / "gone.obj")])


@pytest.mark.parametrize(
    ("material", "fault"),
    [
        ("adamantium", r"--material is 'adamantium'\. Choose from the materials aluminium,"),
        ("handle=wood", r"--material names the part 'handle', which the object does not have"),
        ("wood,steel", "'wood,steel'"),
        ("=wood", r"--material is '=wood'\. Choose from the materials aluminium,"),
    ],
)
def test_a_material_is_refused_before_a_mesh_is_cut(tmp_path, monkeypatch, capsys, material, fault):
    trimesh.creation.box((0.04, 0.05, 0.06)).export(tmp_path / "a.stl")
    monkeypatch.setattr(assembly, "convex_pieces", None)
    assert (
        parse(
            [
                "import",
                str(tmp_path / "a.stl"),
                "--material",
                material,
                "--cache-dir",
                str(tmp_path),
            ]
        )()
        == 2
    )
    assert re.search(fault, capsys.readouterr().err)


def test_a_picture_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(CongraspError, match=r"x\.png could not be written"):
        parse(["show", "box:1", "--png", str(tmp_path / "file" / "x.png")])()
