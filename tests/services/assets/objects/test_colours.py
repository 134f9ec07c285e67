"""Objects keep the colours of their files, wherever these stand in them."""

import dataclasses
import pathlib
import re

import numpy as np
import pytest
import trimesh
from PIL import Image

from congrasp.common.errors import CongraspError
from congrasp.common.objects import store
from congrasp.common.objects.spec import COLOUR_POINTS, Colours
from congrasp.services.assets.objects.colours import sample_colours
from congrasp.services.assets.objects.meshes import import_source
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.assets.objects.sources import find_sources
from congrasp.services.viz.camera import Camera
from congrasp.services.viz.episode_scene import object_at
from congrasp.services.viz.raster import render_scene
from tests.episodes import episode

RED = (255, 0, 0)
GREEN = (0, 255, 0)
BLUE = (0, 0, 255)
SIDE = 0.1


def cube() -> trimesh.Trimesh:
    """From the origin to (0.1, 0.1, 0.1) m, with corners of its own for each face."""
    box = trimesh.creation.box((SIDE, SIDE, SIDE)).apply_translation(np.full(3, SIDE / 2))
    return trimesh.Trimesh(
        box.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False
    )


def textured(path: pathlib.Path) -> pathlib.Path:
    """A cube whose half towards x = 0 is red, and the other blue, by an image."""
    box = cube()
    picture = Image.new("RGB", (64, 8), RED)
    picture.paste(BLUE, (32, 0, 64, 8))
    uv = np.stack([box.vertices[:, 0] / SIDE, np.full(len(box.vertices), 0.5)], -1)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture)
    box.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    box.export(path)
    return path


def test_an_image_is_looked_up_where_it_lies_on_the_surface(tmp_path):
    samples = sample_colours([textured(tmp_path / "cube.glb")], seed=0)
    assert samples is not None
    assert samples.points.shape == (COLOUR_POINTS, 3) == samples.values.shape
    x = samples.points[:, 0]
    assert (samples.values[x < 0.04] == RED).all()
    assert (samples.values[x > 0.06] == BLUE).all()
    assert (np.abs(samples.points).min(0) >= 0).all()
    assert samples.points.max() <= SIDE + 1e-6
    even = x[: COLOUR_POINTS // 2]
    # As many points on each face, as it has a sixth of the area.
    assert np.isclose(even, 0).mean() == pytest.approx(1 / 6, abs=0.02)
    # Four faces have a border between the two colours: eight times as many points are known there.
    near_border = np.abs(x - SIDE / 2) < 0.001
    assert near_border.mean() > 5 * (0.002 / SIDE) * (4 / 6)


@pytest.mark.parametrize("suffix", ["ply", "glb", "obj"])
def test_colours_of_corners_are_mixed_in_between(suffix, tmp_path):
    box = cube()
    colours = np.where(box.vertices[:, 2:] > SIDE / 2, GREEN, RED)
    box.visual = trimesh.visual.ColorVisuals(box, vertex_colors=np.c_[colours, np.full(36, 255)])
    box.export(tmp_path / f"cube.{suffix}")
    samples = sample_colours([tmp_path / f"cube.{suffix}"], seed=0, up="z")
    assert samples is not None
    np.testing.assert_allclose(samples.values[:, 1], 255 * samples.points[:, 2] / SIDE, atol=1.5)


def test_a_material_without_an_image_is_its_colour(tmp_path):
    (tmp_path / "cube.mtl").write_text("newmtl paint\nKd 1.0 0.5 0.0\n")
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in cube().vertices)
    faces = "".join(f"f {3 * i + 1} {3 * i + 2} {3 * i + 3}\n" for i in range(12))
    (tmp_path / "cube.obj").write_text(f"mtllib cube.mtl\n{corners}usemtl paint\n{faces}")
    samples = sample_colours([tmp_path / "cube.obj"], seed=0)
    assert samples is not None
    assert (np.abs(samples.values.astype(int) - (255, 127, 0)) <= 1).all()


def test_files_without_colours_have_none(tmp_path):
    for suffix in ("stl", "obj", "ply", "glb"):
        cube().export(tmp_path / f"cube.{suffix}")
        assert sample_colours([tmp_path / f"cube.{suffix}"], seed=0) is None


def test_colours_of_an_imported_object_are_stored_and_drawn(tmp_path, quick_import):
    (source,) = find_sources(textured(tmp_path / "cube.glb"))
    obj = import_source(source, ImportOptions(scale=0.5, cache_dir=str(tmp_path / "cache")))
    assert obj.colours is not None
    x = obj.colours.points[:, 0]
    assert x.min() == pytest.approx(-0.025, abs=1e-3)
    assert x.max() == pytest.approx(0.025, abs=1e-3)
    assert (obj.colours.values[x < -0.005] == RED).all()
    assert (obj.colours.values[x > 0.005] == BLUE).all()
    assert np.ptp(obj.scaled(2.0).colours.points) == pytest.approx(2 * np.ptp(obj.colours.points))
    store.save(obj, tmp_path / "cube.safetensors")
    for ours, theirs in zip(
        obj.colours, store.load(tmp_path / "cube.safetensors").colours, strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)

    plain = dataclasses.replace(
        episode(),
        object_vertices=obj.visual_vertices,
        object_faces=obj.visual_faces,
        colours=obj.colours,
    )
    picture = render_scene(
        [object_at(plain, 0, painted=False)],
        Camera(plain.object_position[0] + [0, -0.5, 0.0], plain.object_position[0]),
        (60, 60),
    )
    left = picture[30, 25].astype(int)
    right = picture[30, 35].astype(int)
    assert left[0] > left[2] + 60
    assert right[2] > right[0] + 60


def test_an_image_that_cannot_be_read_costs_the_colours_alone(tmp_path):
    textured(tmp_path / "cube.glb")
    content = (tmp_path / "cube.glb").read_bytes()
    start = content.index(b"\x89PNG")
    (tmp_path / "cube.glb").write_bytes(content[: start + 40] + bytes(40) + content[start + 80 :])
    assert sample_colours([tmp_path / "cube.glb"], seed=0) is None


def test_invalid_texture_coordinates_cost_only_the_colours(tmp_path, quick_import):
    box = cube()
    box.visual = trimesh.visual.TextureVisuals(
        uv=np.full((36, 2), np.nan), image=Image.new("RGB", (4, 4), RED)
    )
    box.export(tmp_path / "cube.obj")
    (source,) = find_sources(tmp_path / "cube.obj")
    obj = import_source(source, ImportOptions(scale=1.0, cache_dir=str(tmp_path / "cache")))
    assert obj.colours is None
    assert any(re.fullmatch("its colours are left out: .*[^.]", note) for note in obj.notes), (
        obj.notes
    )


def test_an_object_file_with_half_of_its_colours_is_refused(tmp_path, quick_import):
    (source,) = find_sources(textured(tmp_path / "cube.glb"))
    obj = import_source(source, ImportOptions(scale=1.0, cache_dir=str(tmp_path / "cache")))
    store.save(
        dataclasses.replace(obj, colours=Colours(obj.colours.points, obj.colours.values[:-1])),
        tmp_path / "bad.safetensors",
    )
    with pytest.raises(CongraspError, match="colour_values has the shape"):
        store.load(tmp_path / "bad.safetensors")
