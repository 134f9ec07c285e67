"""Objects without labelled parts are cut where a hand can close on the graspable half, or are said to be uncovered."""

import dataclasses

import numpy as np
import pytest
import trimesh

from congrasp.common.objects.procedural import generate
from congrasp.services.assets.objects import regions
from congrasp.services.assets.objects.meshes import UNLABELLED
from congrasp.services.assets.objects.named import objects_of
from congrasp.services.assets.objects.options import ImportOptions


@pytest.fixture
def imported(tmp_path, quick_import):
    """Imports a mesh, without a decomposition and its errors."""

    def run(mesh):
        mesh.export(tmp_path / "thing.stl")
        (obj,) = objects_of(tmp_path / "thing.stl", ImportOptions(cache_dir=str(tmp_path / "cache")))
        return regions.cut_to_hold(obj)

    return run


def test_halves_that_can_be_held_stay(imported):
    obj = imported(trimesh.creation.cylinder(0.02, 0.2))
    assert obj.part_names == UNLABELLED and 0.45 < obj.graspable[obj.labels].mean() < 0.55
    assert regions.covered(obj).all() and regions.UNCOVERED not in obj.notes


def test_halves_that_cannot_be_held_are_cut_elsewhere(imported):
    """A can of 4 x 4 cm: of neither half fingers keep a centimetre off the other, as they are that thick."""
    obj = imported(trimesh.creation.cylinder(0.02, 0.04))
    assert regions.covered(obj).any()
    halved = obj.points[:, 2] > 0
    for half in (halved, ~halved):
        plain = dataclasses.replace(obj, labels=np.where(half, 0, 1), graspable=np.array([True, False]))
        assert regions.covered(plain).sum() < regions.covered(obj).sum()
    # The pieces follow the labels.
    assert {piece.part for piece in obj.pieces} <= {0, 1}


def test_an_object_without_a_graspable_half_has_a_note(monkeypatch):
    free = regions.covered

    def never(obj, *, use_affordance=True):
        return np.zeros(len(obj.rest_poses), bool) if use_affordance else free(obj, use_affordance=False)

    monkeypatch.setattr(regions, "covered", never)
    obj = generate(3, "cylinder")
    cut = regions.cut_to_hold(obj)
    assert cut.notes == (*obj.notes, regions.UNCOVERED)
    np.testing.assert_array_equal(cut.labels, obj.labels)


@pytest.mark.parametrize("family", ["ball", "prism", "box", "lathed"])
@pytest.mark.parametrize("seed", [1_000_000, *(pytest.param(1_000_000 + i, marks=pytest.mark.slow) for i in (1, 2))])
def test_a_cut_covers_no_fewer_resting_poses(family, seed):
    obj = generate(seed, family)
    cut = regions.cut_to_hold(obj)
    assert regions.covered(cut).sum() >= regions.covered(obj).sum()
    assert 0.1 <= cut.graspable[cut.labels].mean() <= 0.9
    np.testing.assert_array_equal(cut.points, obj.points)
