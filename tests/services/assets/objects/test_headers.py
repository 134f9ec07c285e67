"""Mesh files that announce more than they hold."""

import json
import struct

import pytest
import trimesh

from congrasp.services.assets.objects.mesh_files import read_mesh
from tests.limits import limited

_PLY = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex %d\nproperty float x\nproperty float y\nproperty float z\n"
)
_FACES = b"element face %d\nproperty list uchar int vertex_indices\nend_header\n"
_POINTS = (
    _PLY.replace(b"binary_little_endian", b"ascii") % 4
    + _FACES.replace(b"%d", b"0\nproperty int part")
    + b"1 2 3\n" * 4
)


def _glb(change=lambda tree: None):
    data = trimesh.creation.box().export(file_type="glb")
    length = int.from_bytes(data[12:16], "little")
    tree = json.loads(data[20 : 20 + length])
    change(tree)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


def _many(tree):
    tree["nodes"] = [{"mesh": 0}] * 9000
    tree["scenes"][0]["nodes"] = list(range(9000))


def _twice(tree):
    tree["nodes"] = [{"children": [i + 1, i + 1]} for i in range(40)] + [{"mesh": 0}]


@pytest.mark.parametrize(
    ("name", "data", "why"),
    [
        pytest.param("a.ply", _PLY % 4_000_000_000 + _FACES % 1, "announces 4000000000 rows", id="PLY vertices"),
        pytest.param("a.ply", _PLY % 0 + _FACES % 4_000_000_000 + bytes(99), "announces 4000000000", id="PLY faces"),
        pytest.param("a.ply", b"ply\nformat ascii 1.0\nelement vertex -5\nend_header\n", "without values", id="PLY -5"),
        pytest.param("a.ply", b"ply\n" + b"comment\n" * 10_000, "does not end", id="PLY without an end"),
        pytest.param("a.ply", _POINTS, "only 4 points. Make a surface", id="PLY without faces"),
        pytest.param("a.stl", bytes(80) + b"\xff" * 4 + bytes(50), "only 0 proper triangles", id="STL"),
        pytest.param("a.glb", _glb(lambda t: t["accessors"][0].update(count=1 << 33)), "has a count", id="GLB count"),
        pytest.param(
            "a.glb",
            _glb(lambda t: t["accessors"].extend([{"count": 900, "type": "MAT4", "componentType": 5126}] * 2000)),
            "accessors take",
            id="GLB accessors without data",
        ),
        pytest.param("a.glb", _glb(_twice), "two parents", id="GLB nodes that multiply"),
        pytest.param(
            "a.glb", _glb(lambda t: t.update(nodes=[{"mesh": 0}] * 20_000)), "more than 10000", id="GLB nodes"
        ),
        pytest.param("a.glb", b"glTF" + b"\xff" * 40, "announces", id="GLB length"),
        pytest.param("a.glb", _glb()[:-90], "it was cut: it has 150 of 240 bytes", id="GLB cut"),
    ],
)
def test_what_announces_more_than_it_holds_is_refused_before_it_is_read(tmp_path, name, data, why):
    (tmp_path / name).write_bytes(data)
    said = limited(read_mesh, tmp_path / name)
    assert said.startswith(f"CongraspError: {tmp_path / name}") and why in said, said


def test_a_scene_that_shows_a_mesh_often_is_read_in_bounded_memory(tmp_path):
    (tmp_path / "a.glb").write_bytes(_glb(_many))
    assert "Trimesh" in limited(read_mesh, tmp_path / "a.glb")


def test_a_glb_without_scenes_shows_all_of_its_nodes(tmp_path):
    (tmp_path / "a.glb").write_bytes(_glb(lambda tree: [tree.pop("scenes"), tree.pop("scene", None)]))
    assert len(read_mesh(tmp_path / "a.glb").faces) == 12
