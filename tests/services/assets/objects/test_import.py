"""Import of meshes: known solids, every kind of source, and one line for every kind of bad
input.
"""

import base64
import dataclasses
import json
import os
import re
import struct
import subprocess
import sys
import threading
import types

import numpy as np
import pytest
import trimesh

from congrasp.common.errors import CongraspError
from congrasp.common.objects import shapes
from congrasp.common.objects.resting import settle
from congrasp.common.objects.spec import MAX_MESH_PIECES, MAX_MESH_VERTICES
from congrasp.common.objects.store import digest
from congrasp.services.assets.objects import assembly, collision, decompose, meshes
from congrasp.services.assets.objects.mesh_files import read_mesh
from congrasp.services.assets.objects.named import objects_of
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.assets.objects.sources import find_sources
from tests.children import BUSY, following
from tests.limits import limited
from tests.solids import block, ell

SLOW = pytest.mark.slow
SIDES = np.array([0.04, 0.06, 0.08])
_PLY = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex %d\nproperty float x\nproperty float "
    b"y\nproperty float z\n"
)
_FACES = b"element face %d\nproperty list uchar int vertex_indices\nend_header\n"


@pytest.fixture
def options(tmp_path):
    return ImportOptions(cache_dir=str(tmp_path / "cache"))


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "glb"])
def test_mass_properties_of_a_block(tmp_path, options, quick_import, suffix):
    block(SIDES, (0.5, 0.1, -0.2)).export(tmp_path / f"block.{suffix}")
    (obj,) = objects_of(tmp_path / f"block.{suffix}", options)
    assert obj.name == "block"
    assert obj.family == "imported"
    assert [piece.kind for piece in obj.pieces] == ["mesh"]
    # 192 cm^3 of 500 kg/m^3; I = m/12 (b^2 + c^2).
    np.testing.assert_allclose(obj.mass, 0.096, rtol=1e-5)
    np.testing.assert_allclose(np.sort(np.ptp(obj.visual_vertices, axis=0)), SIDES, rtol=1e-5)
    sides = np.ptp(obj.visual_vertices.astype(float), axis=0)
    expected = 0.096 / 12 * (np.sum(sides**2) - sides**2)
    np.testing.assert_allclose(obj.inertia, np.diag(expected), rtol=1e-4, atol=1e-10)
    np.testing.assert_allclose(obj.visual_vertices.mean(0), 0, atol=1e-6)
    distance = np.abs(np.abs(obj.points) - sides / 2).min(-1)
    np.testing.assert_allclose(distance, 0, atol=1e-6)
    assert (np.einsum("ij,ij->i", obj.points, obj.normals) > 0.019).all()
    np.testing.assert_allclose(sorted(obj.rest_poses[:, 2]), np.repeat(SIDES / 2, 2), atol=1e-3)


def test_pieces_and_halves_of_a_block(tmp_path, options):
    block(SIDES).export(tmp_path / "block.stl")
    (obj,) = objects_of(tmp_path / "block.stl", options)
    assert abs(obj.volume_error) < 1e-3
    assert obj.surface_error < 1e-4
    assert obj.notes[-1].startswith("1 convex piece stands for it: ")
    assert sorted(obj.graspable.tolist()) == [False, True]
    # Neither half of it can be held in all of its resting poses, but two thirds can.
    assert obj.non_graspable_points.mean() == pytest.approx(0.35, abs=0.01)


def test_an_unchanged_mesh_comes_from_the_cache(tmp_path, options, quick_import, monkeypatch):
    path = tmp_path / "block.stl"
    block(SIDES).export(path)
    (first,) = objects_of(path, options)
    with monkeypatch.context() as patch:
        patch.setattr(meshes, "assemble", lambda *_, **__: pytest.fail("built again"))
        (second,) = objects_of(path, options)
    assert digest(second) == digest(first)
    (denser,) = objects_of(path, ImportOptions(density=900.0, cache_dir=options.cache_dir))
    assert denser.mass > first.mass
    block(1.5 * SIDES).export(path)
    (larger,) = objects_of(path, options)
    np.testing.assert_allclose(np.ptp(larger.visual_vertices, axis=0), 1.5 * SIDES, rtol=1e-5)
    for cached in (tmp_path / "cache").iterdir():
        cached.write_bytes(b"damaged")
    assert digest(objects_of(path, options)[0]) == digest(larger)


def test_imports_are_parallel_and_fail_alone(tmp_path, options, quick_import, monkeypatch):
    """Each of three imports waits for the others to begin."""
    started = threading.Barrier(3)
    real = meshes.assemble

    def build(*arguments, **options):
        started.wait(20)
        return real(*arguments, **options)

    monkeypatch.setattr(meshes, "assemble", build)
    monkeypatch.setattr(meshes, "cores", lambda: 3)
    monkeypatch.setattr(meshes, "memory", lambda: 1 << 40)
    for name, factor in (("a", 1.0), ("b", 1000.0), ("c", 0.5)):
        block(factor * SIDES).export(tmp_path / f"{name}.stl")
    imports = dict(meshes.import_sources(find_sources(tmp_path), options))
    assert [isinstance(imports[i], CongraspError) for i in range(3)] == [False, True, False]
    assert imports[0].name == "a"
    assert imports[2].name == "c"
    assert "b.stl is 80 m long" in str(imports[1])


def test_an_unexpected_error_reaches_the_caller(tmp_path, options, monkeypatch):
    block(SIDES).export(tmp_path / "a.stl")
    monkeypatch.setattr(meshes, "assemble", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        list(meshes.import_sources(find_sources(tmp_path), options))


@pytest.fixture
def hull_alone(monkeypatch):
    """Every decomposition ends with the convex hull; halves are not cut again."""

    def hull(vertices, faces, **options):
        return decompose.Decomposition([shapes.hull_of(vertices).points], "hull", ["coacd failed"])

    monkeypatch.setattr(collision, "decompose", hull)
    monkeypatch.setattr(assembly, "cut_to_hold", lambda obj: obj)


def test_an_open_mesh_counts_its_hull(tmp_path, options, hull_alone):
    mesh = block(SIDES)
    mesh.update_faces(np.arange(12) > 1)
    mesh.export(tmp_path / "open.stl")
    (obj,) = objects_of(tmp_path / "open.stl", options)
    assert any("surface is open" in note and "convex hull" in note for note in obj.notes)
    assert (obj.volume_error, obj.notes[-1].endswith("because the mesh is open")) == (None, True)
    np.testing.assert_allclose(obj.mass, 0.096, rtol=1e-4)


def folder_of(path, mesh, *pieces):
    """A folder of a mesh and convex pieces that stand for it."""
    path.mkdir()
    mesh.export(path / f"{path.name}.stl")
    for i, piece in enumerate(pieces):
        piece.export(path / f"contact{i}.stl")
    return path


def test_coarse_pieces_are_replaced(tmp_path, options):
    mesh = ell()
    (obj,) = objects_of(folder_of(tmp_path / "ell", mesh, mesh.convex_hull), options)
    assert 2 <= len(obj.pieces) <= 3
    assert obj.surface_error < 3e-3
    assert abs(obj.volume_error) < 0.05
    np.testing.assert_allclose(
        sum(shapes.volume(piece) for piece in obj.pieces), mesh.volume, rtol=0.02
    )
    # The middle of the hull's longest side is 3 cm from either leg; the hull fills 36 cm^3 beside
    # the 56 of the mesh, less what thinning takes: 2 * 3 mm of 20.
    note = re.search(
        r"cut from its mesh, for its own 1 are coarser: .*most ([0-9.]+) mm off .* ([0-9.]+)% too large",
        obj.notes[-1],
    )
    assert abs(float(note[1]) - 30) < 0.3
    assert abs(float(note[2]) - 100 * (92 / 56 * 0.7 - 1)) < 2


def test_close_pieces_are_kept(tmp_path, options, monkeypatch):
    monkeypatch.setattr(assembly, "cut_to_hold", lambda obj: obj)
    monkeypatch.setattr(collision, "decompose", lambda *_, **__: pytest.fail("cut"))
    (obj,) = objects_of(
        folder_of(tmp_path / "block", block(SIDES), block(SIDES - [0, 0, 0.0024])), options
    )
    np.testing.assert_allclose(
        np.sort(np.ptp(obj.pieces[0].vertices, axis=0)), [0.04, 0.06, 0.0776], rtol=1e-5
    )
    assert obj.notes[-1].startswith(
        "its own 1 convex piece stands for it: their surface is at most 1.2 mm off"
    )


def test_pieces_are_kept_if_a_cut_is_no_closer(tmp_path, options, hull_alone):
    mesh = ell()
    pieces = [
        block((0.08, 0.02, 0.02), (0.04, 0.01, 0.01)),
        block((0.02, 0.05, 0.02), (0.01, 0.045, 0.01)),
    ]
    # A leg is 1 cm too short
    (obj,) = objects_of(folder_of(tmp_path / "ell", mesh, *pieces), options)
    np.testing.assert_allclose(
        sorted(shapes.volume(piece) for piece in obj.pieces), [20e-6, 32e-6], rtol=1e-4
    )
    np.testing.assert_allclose(obj.surface_error, 0.01, atol=5e-4)
    assert len(obj.notes) == 1
    assert obj.notes[0].startswith("its own 2 convex pieces stand for it: ")
    assert obj.notes[0].endswith("; pieces cut from its mesh are no closer")


def decomposed(mesh):
    return decompose.decompose(mesh.vertices, mesh.faces, volume=mesh.volume)


@SLOW
def test_an_open_sphere_is_cut_by_coacd():
    sphere = trimesh.creation.icosphere(4, 0.04)
    sphere.update_faces(sphere.triangles_center[:, 2] < 0.02)
    result = decompose.decompose(sphere.vertices, sphere.faces, volume=None)
    assert result.method == "coacd"
    assert result.notes == []


def replace_module(folder, monkeypatch, name, text):
    """Puts another module of a name before the installed one, for child processes."""
    (folder / f"{name}.py").write_text(text)
    monkeypatch.setenv("PYTHONPATH", f"{folder}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")


def failing(function):
    """A decomposer's module whose function fails on every mesh."""
    return f"def Mesh(*_): pass\ndef {function}(*_, **__): raise RuntimeError('broken')"


def test_vhacd_and_then_the_hull_replace_a_coacd_that_fails(tmp_path, monkeypatch):
    mesh = ell()
    replace_module(tmp_path, monkeypatch, "coacd", failing("run_coacd"))
    result = decomposed(mesh)
    assert result.method == "vhacd"
    assert result.notes == ["coacd failed (RuntimeError: broken)"]
    volume = sum(shapes.hull_of(piece).volume for piece in result.pieces)
    assert 0.8 * mesh.volume < volume < 1.2 * mesh.volume
    replace_module(tmp_path, monkeypatch, "vhacdx", failing("compute_vhacd"))
    result = decomposed(mesh)
    assert result.method == "hull"
    assert len(result.pieces) == 1
    np.testing.assert_allclose(
        shapes.hull_of(result.pieces[0]).volume, 0.08**2 * 0.02 - 0.06**2 / 2 * 0.02, rtol=1e-6
    )
    assert "hull" in result.notes[-1]


RUNS = "def Mesh(*_): pass\ndef run_coacd(*_, **__):\n    import os\n    "
SURROUNDINGS = {
    "absent library": ("raise ImportError('libgomp.so.1')", "libgomp"),
    "broken package": ("raise RuntimeError('broken')", "did not start .*broken"),
    "other processor": ("import os\nos.kill(os.getpid(), 4)", "did not start"),
    "too few threads": ("raise RuntimeError('can\\'t start new thread')", "out of threads"),
    "full disk": (RUNS + "raise OSError(28, 'No space left on device')", "No space left"),
    "too few files": (RUNS + "raise OSError(24, 'Too many open files')", "Too many open files"),
    "lazy import": (RUNS + "import absent_package", "absent_package"),
    "no memory": (RUNS + "bytearray(1 << 50)", "out of memory"),
    "no memory for native code": (
        RUNS + "os.write(2, b'std::bad_alloc\\n')\n    os.abort()",
        "out of memory",
    ),
    "ended by others": (RUNS + "os.kill(os.getpid(), 15)", "SIGTERM"),
    "killed by the system": (RUNS + "os.kill(os.getpid(), 9)", "killed by the system"),
}
"""Failures that are not the mesh's, as modules in place of CoACD, and what their errors name."""


@pytest.mark.parametrize("name", SURROUNDINGS)
def test_failure_of_the_surroundings_is_an_error(tmp_path, monkeypatch, name):
    """It makes no other shape."""
    text, named = SURROUNDINGS[name]
    replace_module(tmp_path, monkeypatch, "coacd", text)
    with pytest.raises(CongraspError, match=f"coacd .*{named}"):
        decomposed(ell())


def test_a_process_that_cannot_start_is_an_error(monkeypatch):
    monkeypatch.setattr(sys, "executable", "/absent/python")
    with pytest.raises(CongraspError, match="coacd did not start"):
        decomposed(ell())


def test_a_cut_beyond_its_limit_is_an_error(monkeypatch):
    """No other shape replaces one that a slow machine does not finish."""
    monkeypatch.setattr(decompose, "MAX_PROCESSOR_S", 0.01)
    with pytest.raises(CongraspError, match=r"coacd took longer than 0\.01 s"):
        decomposed(ell())


def test_pieces_do_not_depend_on_free_memory_threads_or_load(monkeypatch):
    pipe = trimesh.creation.annulus(0.02, 0.024, 0.05, sections=24)
    idle = decomposed(pipe)
    monkeypatch.setattr("psutil.virtual_memory", lambda: types.SimpleNamespace(available=1 << 20))
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        monkeypatch.setenv(name, "3")
    busy = [subprocess.Popen([sys.executable, "-c", BUSY], env=following()) for _ in range(3)]
    try:
        loaded = decomposed(pipe)
    finally:
        for process in busy:
            process.kill()
            process.wait()
    assert loaded.method == idle.method == "coacd"
    assert len(loaded.pieces) == len(idle.pieces) > 4
    for first, second in zip(idle.pieces, loaded.pieces, strict=True):
        assert first.tobytes() == second.tobytes()


def test_a_hull_of_an_ell_is_not_reliable(tmp_path, options, hull_alone):
    """An ell's hull has 64 % more volume, and is far from its surface."""
    ell().export(tmp_path / "ell.stl")
    (obj,) = objects_of(tmp_path / "ell.stl", options)
    assert not obj.shape_reliable
    close = dataclasses.replace(obj, volume_error=0.0)
    assert [
        dataclasses.replace(close, surface_error=d).shape_reliable for d in (0.0049, 0.0051)
    ] == [True, False]


def test_a_busy_machine_changes_no_shape(monkeypatch):
    """A child that gets no processor time is no reason for another shape."""
    monkeypatch.setattr(decompose, "MAX_WALL_CLOCK_RATIO", 0.001)
    mesh = ell()
    with pytest.raises(
        CongraspError, match=r"The machine is too busy: coacd .* Stop other programs and try again"
    ):
        decomposed(mesh)


def test_decomposer_that_dies_is_reported(monkeypatch):
    monkeypatch.setattr(decompose, "write_pieces", os.abort)  # which its arguments end at once
    result = decomposed(ell())
    assert result.method == "hull"
    assert result.notes[0].startswith("coacd failed (")
    assert result.notes[1].startswith("vhacd failed (")


# One whose own pieces are kept, one with holes, and two with parts.
@pytest.mark.parametrize(
    "name", ["cubemedium", "knife", *(pytest.param(x, marks=SLOW) for x in ("phone", "hammer"))]
)
def test_scanned_objects_come_within_the_budget_and_rest(shared_objects, options, name):
    (obj,) = objects_of(shared_objects / name, options)
    assert obj.name == name
    assert len(obj.pieces) <= MAX_MESH_PIECES
    assert all(len(piece.vertices) <= MAX_MESH_VERTICES for piece in obj.pieces)
    assert obj.surface_error < 3e-3
    assert abs(obj.volume_error) < 0.05
    assert obj.notes[-1].startswith("its own 1 convex piece") == (name == "cubemedium")
    if name in ("hammer", "knife"):
        assert obj.part_names == {"hammer": ("head", "neck"), "knife": ("blade", "handle")}[name]
        assert obj.graspable.tolist() == [False, True]
    assert 0.1 <= obj.non_graspable_points.mean() <= 0.9
    settled = settle(obj, obj.rest_poses[0], 5.0)
    assert settled.speed < 0.01
    assert settled.moved < 0.01


@pytest.mark.slow
def test_a_bowl_is_as_thin_as_its_wall(tmp_path, options):
    """A hemisphere of 12 cm with a wall of 2 mm: the hulls of its pieces alone would be half as
    large again.
    """
    turn = np.linspace(-np.pi / 2, 0, 13)
    outside, inside = (r * np.column_stack([np.cos(turn), np.sin(turn)]) for r in (0.06, 0.058))
    outside[0, 0] = inside[0, 0] = 0.0
    trimesh.creation.revolve(np.concatenate([outside, inside[::-1]]), sections=48).export(
        tmp_path / "bowl.stl"
    )
    (obj,) = objects_of(tmp_path / "bowl.stl", options)
    assert obj.surface_error < 3e-3
    assert abs(obj.volume_error) < 0.05


def test_given_convex_pieces_are_used(tmp_path, options, quick_import):
    folder = tmp_path / "ell"
    folder.mkdir()
    first = block((0.08, 0.02, 0.02))
    second = block((0.02, 0.02, 0.06), (0.03, 0, 0.04))
    trimesh.util.concatenate([first, second]).export(folder / "ell.stl")
    first.export(folder / "contact0.stl")
    second.export(folder / "contact1.stl")
    first.export(folder / "ell_handle.stl")
    second.export(folder / "ell_blade.stl")
    (obj,) = objects_of(folder, options)
    assert obj.part_names == ("blade", "handle")
    assert obj.graspable.tolist() == [False, True]
    volumes = sorted(shapes.volume(piece) for piece in obj.pieces)
    np.testing.assert_allclose(volumes, [24e-6, 32e-6], rtol=1e-4)
    assert [piece.part for piece in sorted(obj.pieces, key=shapes.volume)] == [0, 1]


def test_coacd_cuts_an_ell_in_two():
    mesh = ell()
    result = decomposed(mesh)
    assert result.method == "coacd"
    assert 2 <= len(result.pieces) <= 3
    np.testing.assert_allclose(
        sum(shapes.hull_of(piece).volume for piece in result.pieces), mesh.volume, rtol=0.05
    )


# --- files that announce more than they hold ---


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
    return (
        struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
        + text
        + rest
    )


def _many(tree):
    tree["nodes"] = [{"mesh": 0}] * 9000
    tree["scenes"][0]["nodes"] = list(range(9000))


def _twice(tree):
    tree["nodes"] = [{"children": [i + 1, i + 1]} for i in range(40)] + [{"mesh": 0}]


def _fallback(tree):
    tree.update(
        buffers=[{"byteLength": 1 << 20}, *tree["buffers"]],
        extensionsRequired=["EXT_meshopt_compression"],
    )


@pytest.mark.parametrize(
    ("name", "data", "why"),
    [
        pytest.param(
            "a.ply",
            _PLY % 4_000_000_000 + _FACES % 1,
            "announces 4000000000 rows",
            id="PLY vertices",
        ),
        pytest.param(
            "a.ply",
            _PLY % 0 + _FACES % 4_000_000_000 + bytes(99),
            "announces 4000000000",
            id="PLY faces",
        ),
        pytest.param(
            "a.ply",
            b"ply\nformat ascii 1.0\nelement vertex -5\nend_header\n",
            "without values",
            id="PLY -5",
        ),
        pytest.param(
            "a.ply", b"ply\n" + b"comment\n" * 10_000, "does not end", id="PLY without an end"
        ),
        pytest.param("a.ply", _POINTS, "only 4 points. Make a surface", id="PLY without faces"),
        pytest.param(
            "a.stl", bytes(80) + b"\xff" * 4 + bytes(50), "has 0 triangles with an area", id="STL"
        ),
        pytest.param(
            "a.glb",
            _glb(lambda t: t["accessors"][0].update(count=1 << 33)),
            "has a count",
            id="GLB count",
        ),
        pytest.param(
            "a.glb",
            _glb(
                lambda t: t["accessors"].extend(
                    [{"count": 900, "type": "MAT4", "componentType": 5126}] * 2000
                )
            ),
            "accessors take",
            id="GLB accessors without data",
        ),
        pytest.param("a.glb", _glb(_twice), "two parents", id="GLB nodes that multiply"),
        pytest.param(
            "a.glb",
            _glb(lambda t: t.update(nodes=[{"mesh": 0}] * 20_000)),
            "more than 10000",
            id="GLB nodes",
        ),
        pytest.param("a.glb", b"glTF" + b"\xff" * 40, "announces", id="GLB length"),
        pytest.param("a.glb", _glb()[:-90], "it was cut: it has 150 of 240 bytes", id="GLB cut"),
        pytest.param("a.glb", _glb(_fallback), "is compressed with meshopt", id="GLB meshopt"),
        pytest.param(
            "a.glb",
            _glb(lambda t: t["bufferViews"][0].update(byteLength="x")),
            "of 'x'",
            id="GLB 'x'",
        ),
    ],
)
def test_a_file_that_announces_too_much_is_refused_unread(tmp_path, name, data, why):
    (tmp_path / name).write_bytes(data)
    message = limited(read_mesh, tmp_path / name)
    assert message.startswith(f"CongraspError: {tmp_path / name}"), message
    assert why in message, message


def _inline(tree):
    tree["buffers"][0]["uri"] = (
        f"data:application/octet-stream;base64,{base64.b64encode(_glb()[-240:]).decode()}"
    )


def test_a_scene_of_many_instances_is_read_in_bounded_memory(tmp_path):
    (tmp_path / "a.glb").write_bytes(_glb(_many))
    assert "Trimesh" in limited(read_mesh, tmp_path / "a.glb")


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(
            _glb(lambda t: [t.pop("scenes"), t.pop("scene", None)]),
            id="no scenes, all nodes are shown",
        ),
        pytest.param(
            _glb(lambda t: t["buffers"][0].update(byteLength=242)), id="padding is announced"
        ),
        pytest.param(
            _glb(lambda t: t["buffers"][0].update(byteLength="x")), id="a length that is of no use"
        ),
        pytest.param(_glb(_inline)[:-248], id="numbers in an address"),
    ],
)
def test_an_uncommon_glb_is_read(tmp_path, data):
    (tmp_path / "a.glb").write_bytes(data)
    assert len(read_mesh(tmp_path / "a.glb").faces) == 12
