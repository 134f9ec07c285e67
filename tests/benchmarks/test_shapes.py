"""The benchmark of shapes: errors of known solids, and imports that differ."""

import itertools
import json

import pytest
import trimesh

from congrasp.services.assets.objects.meshes import import_source
from tests.benchmarks import shapes as benchmark
from tests.solids import block, ell


def test_shapes_writes_both_errors_of_every_object(tmp_path):
    folder = tmp_path / "meshes"
    folder.mkdir()
    block((0.04, 0.06, 0.08)).export(folder / "block.stl")
    trimesh.creation.cylinder(0.03, 0.08).export(folder / "cylinder.stl")
    ell().export(folder / "ell.stl")
    file = tmp_path / "shapes.json"
    assert benchmark.shapes((folder,), json=file) == 0
    rows = json.loads(file.read_text())
    assert [row["name"] for row in rows] == ["block", "cylinder", "ell"]
    for row in rows:
        assert row["within"]
        assert row["same_pieces"]
        assert row["surface_mm"] < 3
        assert abs(row["volume_percent"]) < 5
        assert row["seconds"] > 0
    assert [row["pieces"] for row in rows[:2]] == [1, 1]
    assert rows[2]["pieces"] > 1


def test_shapes_fails_if_imports_differ(tmp_path, monkeypatch):
    meshes = []
    for height in (0.08, 0.09):
        file = tmp_path / f"{height}" / "block.stl"
        file.parent.mkdir()
        block((0.04, 0.06, height)).export(file)
        meshes.append(benchmark.find_sources(file)[0])
    turns = itertools.cycle(meshes)
    monkeypatch.setattr(
        benchmark, "import_source", lambda source, options: import_source(next(turns), options)
    )
    assert benchmark.shapes((meshes[0].path,), repeats=2) == 1
    assert benchmark.shapes((meshes[0].path,), repeats=1) == 0


@pytest.mark.slow
@pytest.mark.timeout(7200)  # 24 scans, each imported three times, once on a busy machine
def test_nine_of_ten_scans_are_within_and_the_same_on_a_busy_machine(tmp_path, shared_objects):
    file = tmp_path / "shapes.json"
    assert benchmark.shapes((shared_objects,), busy=4, json=file) == 0
    rows = json.loads(file.read_text())
    assert sum(row["within"] for row in rows) >= 0.9 * len(rows)
