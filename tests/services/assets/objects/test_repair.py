"""Broken meshes: each is repaired with a note, or rejected with the remedy."""

import numpy as np
import pytest
import trimesh

from congrasp.common.errors import CongraspError
from congrasp.services.assets.objects import repair
from congrasp.services.assets.objects.meshes import import_source
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.assets.objects.repair import closed, largest_body, reduced
from congrasp.services.assets.objects.sources import find_sources

RADIUS = 0.03


def ball(**options):
    return trimesh.creation.icosphere(subdivisions=2, radius=RADIUS, **options)


@pytest.fixture
def brought(tmp_path, quick_import):
    """Imports a mesh, or bytes, from a file of a name; returns the object and its notes."""

    def bring(content, name="thing.stl", **options):
        path = tmp_path / name
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            content.export(path)
        (source,) = find_sources(path)
        obj = import_source(source, ImportOptions(unit="guess", cache_dir=str(tmp_path / "cache"), **options))
        return obj, obj.notes

    return bring


def test_a_sound_mesh_has_no_notes(brought):
    _, notes = brought(ball())
    assert [note for note in notes if "convex piece stands for it" not in note] == []


def test_millimetres_for_metres(brought):
    mesh = ball()
    mesh.apply_scale(1000)
    obj, notes = brought(mesh)
    assert notes[0] == (
        "it would be 60 m long in metres, so its numbers are taken as millimetres: 6 cm "
        "(if that is wrong, add --unit or --scale)"
    )
    np.testing.assert_allclose(np.ptp(obj.visual_vertices, axis=0), 2 * RADIUS, rtol=0.01)
    mesh.apply_scale(0.1)  # 6 of what may be centimetres or inches
    with pytest.raises(CongraspError, match=r"'--unit cm' \(6 cm\); if inches, add '--unit in' \(15.2 cm\)"):
        brought(mesh, "unclear.stl")


def test_inside_out(brought):
    mesh = ball()
    mesh.invert()
    obj, notes = brought(mesh)
    assert "it was inside out and was turned" in notes
    assert (obj.normals * obj.points).sum(-1).min() > 0


def test_some_triangles_inside_out(brought):
    mesh = ball()
    mesh.faces[::7] = np.asarray(mesh.faces)[::7, ::-1]
    obj, notes = brought(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False))
    assert "some of its triangles faced inwards and were turned" in notes
    assert (obj.normals * obj.points).sum(-1).min() > 0


def test_a_small_hole_is_closed_and_an_opening_is_left(brought):
    mesh = ball()
    mesh.update_faces(np.arange(len(mesh.faces)) > 1)  # two triangles that meet in one corner
    obj, notes = brought(mesh)
    assert "2 holes in its surface were closed" in notes
    np.testing.assert_allclose(obj.mass, max(500 * ball().volume, 0.05), rtol=0.02)
    half = ball()
    half.update_faces(half.triangles_center[:, 2] < 0)
    said: list[str] = []
    assert len(closed(half, said).faces) == len(half.faces) and not said  # a bowl stays a bowl


def test_two_bodies(brought):
    far = ball()
    far.apply_scale(0.5)
    far.apply_translation([0.2, 0, 0])
    obj, notes = brought(trimesh.util.concatenate([far, ball()]))
    assert notes[0].startswith("it holds 2 separate bodies; the largest was taken (80% of the surface)")
    np.testing.assert_allclose(np.ptp(obj.visual_vertices, axis=0), 2 * RADIUS, rtol=0.01)
    touching = ball()
    touching.apply_translation([2 * RADIUS, 0, 0])
    said: list[str] = []
    assert len(largest_body(trimesh.util.concatenate([touching, ball()]), said).faces) == 2 * len(ball().faces)
    assert not said


@pytest.mark.slow
def test_millions_of_triangles(brought, monkeypatch):
    monkeypatch.setattr(repair, "_REDUCED", 20_000)
    monkeypatch.setattr(repair, "MAX_FACES", 2_000)
    fine = trimesh.creation.icosphere(subdivisions=6, radius=RADIUS)
    obj, notes = brought(fine)
    assert notes[0] == "its 81,920 triangles were reduced to 2,000: a hand does not feel the rest"
    assert len(obj.visual_faces) <= 2_000 and not [note for note in notes if "open" in note]
    np.testing.assert_allclose(np.linalg.norm(obj.points, axis=-1), RADIUS, rtol=0.02)
    soup = fine.vertices[fine.faces].reshape(-1, 3)  # as STL files have it: no triangle shares a corner
    vertices, faces = reduced(soup, np.arange(len(soup)).reshape(-1, 3), [])
    assert trimesh.Trimesh(vertices, faces).is_watertight


def test_points_that_are_not_finite(brought):
    mesh = ball()
    mesh.vertices[3] = np.nan
    obj, notes = brought(mesh, "thing.ply")
    assert notes[0] == "1 of its points is not a number and was left out"
    assert "1 hole in its surface was closed" in notes and np.isfinite(obj.visual_vertices).all()
    mesh.vertices[:40] = np.nan
    with pytest.raises(CongraspError, match=r"bad.ply has 40 vertices that are not finite numbers. Repair or export"):
        brought(mesh, "bad.ply")


def test_notes_come_back_from_the_cache(brought):
    mesh = ball()
    mesh.invert()
    assert brought(mesh)[1] == brought(mesh)[1] != []


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
