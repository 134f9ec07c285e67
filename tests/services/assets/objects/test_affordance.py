"""Partitions from part meshes, painted vertices, half-spaces and cuts that a hand can hold; and
what is refused.
"""

import dataclasses

import numpy as np
import pytest
import trimesh

from congrasp.common.errors import CongraspError
from congrasp.common.objects import store
from congrasp.common.objects.procedural import generate
from congrasp.services.assets.objects import affordance
from congrasp.services.assets.objects.affordance import (
    find_painted,
    in_half_space,
    on_part_mesh,
    two_parts,
)
from congrasp.services.assets.objects.assembly import UNLABELLED
from congrasp.services.assets.objects.named import objects_of
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.cli.main import load
from tests.services.conftest import quick_imports

EDGES = np.array([0.05, 0.05, 0.12])
SHIFT = np.array([0.01, 0.02, 0.06])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A box, its lower part, and the box with its lower vertices painted green, in millimetres."""
    folder = tmp_path_factory.mktemp("box")
    mesh = trimesh.creation.box(EDGES * 1000).apply_translation(SHIFT * 1000)
    mesh = mesh.subdivide().subdivide().subdivide()
    mesh.export(folder / "box.stl")
    low = trimesh.creation.box(EDGES * [1000, 1000, 500]).apply_translation(
        SHIFT * 1000 - [0, 0, 30]
    )
    low.export(folder / "low.stl")
    colours = np.where((mesh.vertices[:, 2] < 60)[:, None], [0, 255, 0, 255], [255, 0, 0, 255])
    trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colours, process=False).export(
        folder / "painted.ply"
    )
    return folder


@pytest.fixture(scope="module")
def box(folder):
    with quick_imports():
        return objects_of(
            folder / "box.stl", ImportOptions(unit="mm", cache_dir=str(folder / "cache"))
        )[0]


def test_each_source_finds_the_lower_half(box, folder):
    below = box.points[:, 2] < 0
    # A border lies between two vertices, or on the part's own lid
    near = np.abs(box.points[:, 2]) < 0.009
    for plus in (
        in_half_space(box, (0, 0, -2), 0.0),
        on_part_mesh(box, folder / "low.stl"),
        find_painted(box, folder / "painted.ply", (0, 255, 0)),
    ):
        assert plus.shape == (512,)
        assert np.array_equal(plus[~near], below[~near])
    labelled = two_parts(box, below, "half")
    np.testing.assert_array_equal(labelled.non_graspable_points, ~below)
    assert labelled.name == "half"
    assert labelled.part_names == ("grasp", "avoid")


@pytest.mark.parametrize("kind", ["patch", "flat", "points"])
def test_a_part_may_be_a_patch_of_the_surface(box, folder, tmp_path, kind):
    """Such as one that is cut out of a scan: it is open, and may be flat."""
    mesh = trimesh.load(folder / "box.stl")
    patch = mesh.submesh([mesh.triangles_center[:, 0] > mesh.bounds[1, 0] - 1e-3], append=True)
    if kind == "flat":
        (_, y, z), (x, y1, z1) = patch.bounds
        patch = trimesh.Trimesh(
            [(x, y, z), (x, y1, z), (x, y1, z1), (x, y, z1)], [[0, 1, 2], [0, 2, 3]]
        )
    if kind == "points":
        patch = trimesh.PointCloud(trimesh.sample.sample_surface(patch, 3000, seed=0)[0])
    patch.export(tmp_path / "part.ply")
    depth = box.points[:, 0].max() - box.points[:, 0]
    labelled = on_part_mesh(box, tmp_path / "part.ply")
    assert labelled[depth < 1e-3].all()
    assert not labelled[depth > 0.005].any()


def test_a_part_whose_triangles_lack_vertices_is_refused(box, tmp_path):
    points = "".join(f"property float {axis}\n" for axis in "xyz")
    header = (
        f"ply\nformat ascii 1.0\nelement vertex 3\n{points}element face 1\nproperty list uchar int "
        f"vertex_indices\n"
    )
    (tmp_path / "part.ply").write_text(f"{header}end_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n")
    with pytest.raises(
        CongraspError, match=r"part\.ply has too many triangles, or triangles whose"
    ):
        on_part_mesh(box, tmp_path / "part.ply")


def test_the_command_stores_the_new_object(box, folder, tmp_path, capsys):
    catalogue = store.Catalogue(tmp_path)
    catalogue.add(box)
    run = ["affordance", "box", "--folder", str(tmp_path)]
    assert load("objects")([*run, "--painted", str(folder / "painted.ply"), "--name", "low"])() == 0
    assert (
        load("objects")(
            [*run, "--half-space", "0", "0", "1", "0", "--invert", "--name", "also-low"]
        )()
        == 0
    )
    assert "of the surface of low is graspable" in capsys.readouterr().out
    for name in ("low", "also-low"):
        obj = catalogue.get(name)
        assert obj.points[~obj.non_graspable_points][:, 2].max() < 0.009


@pytest.fixture
def imported(tmp_path, quick_import):
    """Imports a mesh, without a decomposition and its errors."""

    def run(mesh):
        mesh.export(tmp_path / "thing.stl")
        (obj,) = objects_of(
            tmp_path / "thing.stl", ImportOptions(cache_dir=str(tmp_path / "cache"))
        )
        return affordance.cut_to_hold(obj)

    return run


def test_halves_that_can_be_held_stay(imported):
    obj = imported(trimesh.creation.cylinder(0.02, 0.2))
    assert obj.part_names == UNLABELLED
    assert 0.45 < obj.graspable[obj.labels].mean() < 0.55
    assert affordance.find_covered_rests(obj).all()
    assert affordance.UNCOVERED not in obj.notes


def test_halves_that_cannot_be_held_are_cut_elsewhere(imported):
    """A can of 4 x 4 cm: of neither half fingers keep a centimetre off the other, as they are that
    thick.
    """
    obj = imported(trimesh.creation.cylinder(0.02, 0.04))
    assert affordance.find_covered_rests(obj).any()
    halved = obj.points[:, 2] > 0
    for half in (halved, ~halved):
        plain = dataclasses.replace(
            obj, labels=np.where(half, 0, 1), graspable=np.array([True, False])
        )
        assert affordance.find_covered_rests(plain).sum() < affordance.find_covered_rests(obj).sum()
    # The pieces follow the labels.
    assert {piece.part for piece in obj.pieces} <= {0, 1}


def test_an_object_without_a_graspable_half_has_a_note(monkeypatch):
    free = affordance.find_covered_rests

    def never(obj, *, use_affordance=True):
        return (
            np.zeros(len(obj.rest_poses), bool)
            if use_affordance
            else free(obj, use_affordance=False)
        )

    monkeypatch.setattr(affordance, "find_covered_rests", never)
    obj = generate(3, "cylinder")
    cut = affordance.cut_to_hold(obj)
    assert cut.notes == (*obj.notes, affordance.UNCOVERED)
    np.testing.assert_array_equal(cut.labels, obj.labels)


@pytest.mark.parametrize("family", ["ball", "prism", "box", "lathed"])
@pytest.mark.parametrize(
    "seed", [1_000_000, *(pytest.param(1_000_000 + i, marks=pytest.mark.slow) for i in (1, 2))]
)
def test_a_cut_covers_no_fewer_resting_poses(family, seed):
    obj = generate(seed, family)
    cut = affordance.cut_to_hold(obj)
    assert affordance.find_covered_rests(cut).sum() >= affordance.find_covered_rests(obj).sum()
    assert 0.1 <= cut.graspable[cut.labels].mean() <= 0.9
    np.testing.assert_array_equal(cut.points, obj.points)
