"""Meshes of captured objects: imported side by side, and those that cannot be used said why."""

import threading

import trimesh

from congrasp.common.errors import CongraspError
from congrasp.services.assets.captures.objects import import_meshes
from congrasp.services.assets.objects import meshes


def test_meshes_are_imported_side_by_side(tmp_path, monkeypatch):
    """Each of two imports waits for the other to begin."""
    both, real = threading.Barrier(2), meshes.import_source

    def import_source(source, options):
        both.wait(20)
        return real(source, options)

    monkeypatch.setattr(meshes, "import_source", import_source)
    monkeypatch.setattr(meshes, "cores", lambda: 2)
    files = {tmp_path / f"{name}.stl": name for name in ("can", "box")}
    trimesh.creation.cylinder(0.03, 0.1).export(tmp_path / "can.stl")
    trimesh.creation.box((0.04, 0.05, 0.06)).export(tmp_path / "box.stl")
    (tmp_path / "several").mkdir()
    told = []
    found = import_meshes({**files, tmp_path / "several": "several", tmp_path / "none.stl": "none"}, told.append)
    assert {path.stem: obj.name for path, obj in found.items() if not isinstance(obj, CongraspError)} == {
        "can": "can",
        "box": "box",
    }
    assert all(isinstance(found[tmp_path / name], CongraspError) for name in ("several", "none.stl"))
    assert sorted(text.split()[0] for text in told) == ["box", "can"] and told[-1].endswith("(2 of 2)")
