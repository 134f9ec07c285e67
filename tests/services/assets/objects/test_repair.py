"""Broken meshes: each is repaired with a note, or rejected with the remedy."""

import numpy as np
import pytest
import trimesh

from congrasp.services.assets.objects import repair
from congrasp.services.assets.objects.named import one_object
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.assets.objects.repair import closed, largest_body, reduced, without_hollows

RADIUS = 0.03


def ball(**options):
    return trimesh.creation.icosphere(subdivisions=2, radius=RADIUS, **options)


def test_an_opening_is_left_and_bodies_that_touch_stay_together():
    half, said = ball(), list[str]()
    half.update_faces(half.triangles_center[:, 2] < 0)
    assert len(closed(half, said).faces) == len(half.faces) and not said  # a bowl stays a bowl
    pair = trimesh.util.concatenate([ball(), ball().apply_translation([2 * RADIUS, 0, 0])])
    assert len(largest_body(pair, said).faces) == 2 * len(ball().faces) and not said


@pytest.mark.parametrize("gap", [-0.001, 0.0, 0.05])
@pytest.mark.parametrize("unit", ["m", "mm", "auto"])
def test_a_table_under_an_object_is_left_out(tmp_path, quick_import, unit, gap):
    table = trimesh.creation.box((0.55, 0.4, 0.02)).apply_translation([0.0, 0.0, -0.01 - RADIUS - gap])
    scan = trimesh.util.concatenate([table, ball()]).apply_scale(1000 if unit == "mm" else 1)
    scan.export(tmp_path / "scan.stl")
    obj = one_object(tmp_path / "scan.stl", ImportOptions(unit=unit, cache_dir=str(tmp_path / "cache")))
    np.testing.assert_allclose(np.ptp(obj.visual_vertices, axis=0), 2 * RADIUS, rtol=0.05)
    assert obj.notes[0] == "a flat body 6.7 times as wide as the rest was left out: a table"


def test_a_lid_is_no_table(tmp_path):
    lid = trimesh.creation.cylinder(0.12, 0.01)
    lid = trimesh.util.concatenate([lid, ball().apply_translation([0.0, 0.0, 0.03])])
    assert repair.without_table(lid, 1.0, []) is lid


@pytest.mark.parametrize(("neck", "filled"), [(0.004, True), (0.012, False)])
def test_a_hollow_that_no_finger_enters_is_filled(neck, filled):
    """A bottle with a wall of 3 mm."""
    outer = [(0, 0), (0.035, 0), (0.035, 0.12), (neck + 0.003, 0.15), (neck + 0.003, 0.18)]
    inner = [(neck, 0.18), (neck, 0.149), (0.032, 0.119), (0.032, 0.003), (0, 0.003)]
    bottle, full = (
        trimesh.creation.revolve(np.array(line), sections=32) for line in (outer + inner, [*outer, (0, 0.18)])
    )
    said = list[str]()
    shown = without_hollows(bottle, said)
    np.testing.assert_allclose(shown.volume, (full if filled else bottle).volume, rtol=0.01)
    assert repair.encloses(shown) and bool(said) == filled


def test_a_hollow_without_an_opening_is_filled():
    void = ball()
    void.apply_scale(0.9)
    void.invert()
    shown = without_hollows(trimesh.util.concatenate([ball(), void]), [])
    np.testing.assert_allclose(shown.volume, ball().volume, rtol=1e-6)


@pytest.mark.slow
def test_millions_of_triangles(tmp_path, quick_import, monkeypatch):
    monkeypatch.setattr(repair, "_REDUCED", 20_000)
    monkeypatch.setattr(repair, "MAX_FACES", 2_000)
    fine = trimesh.creation.icosphere(subdivisions=6, radius=RADIUS)
    fine.export(tmp_path / "fine.stl")
    obj = one_object(tmp_path / "fine.stl", ImportOptions(cache_dir=str(tmp_path / "cache")))
    notes = obj.notes
    assert notes[0] == "its 81,920 triangles were reduced to 2,000: a hand does not feel the rest"
    assert len(obj.visual_faces) <= 2_000 and not [note for note in notes if "open" in note]
    np.testing.assert_allclose(np.linalg.norm(obj.points, axis=-1), RADIUS, rtol=0.02)
    soup = fine.vertices[fine.faces].reshape(-1, 3)  # as STL files have it: no triangle shares a corner
    vertices, faces = reduced(soup, np.arange(len(soup)).reshape(-1, 3), [])
    assert trimesh.Trimesh(vertices, faces).is_watertight


def test_a_surface_without_an_outside_is_unchanged():
    strip = trimesh.Trimesh(*_moebius())
    said: list[str] = []
    assert closed(strip, said).faces.shape == strip.faces.shape
    assert not said


def _moebius():
    turns = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rim = [(np.cos(t) * (1 + s * np.cos(t / 2)), np.sin(t) * (1 + s * np.cos(t / 2)), s * np.sin(t / 2))
           for t in turns for s in (-0.2, 0.2)]  # fmt: skip
    faces = []
    for i in range(24):
        a, b = 2 * i, 2 * i + 1
        c, d = (2 * i + 2, 2 * i + 3) if i < 23 else (1, 0)
        faces += [(a, b, c), (b, d, c)]
    return rim, faces
