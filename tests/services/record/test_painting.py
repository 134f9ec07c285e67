"""A mesh that is cut finer is the same surface, and no larger than it may be."""

import numpy as np
import pytest
import trimesh

from congrasp.common.objects.spec import Colours
from congrasp.services.record import palette
from congrasp.services.record.palette import finer, nearest, painted


@pytest.mark.parametrize("sections", [8, 512, 2048])
def test_the_surface_stays_and_faces_are_bounded(sections):
    mesh = trimesh.creation.cylinder(0.03, 0.15, sections=sections)  # slivers, where there are many sections
    vertices, faces = finer(mesh.vertices, mesh.faces, 0.003, 9_000)
    fine = trimesh.Trimesh(vertices, faces, process=False)
    assert len(mesh.faces) < len(faces) <= 9_000
    assert fine.area == pytest.approx(mesh.area, rel=1e-4) and fine.volume == pytest.approx(mesh.volume, rel=1e-4)
    assert vertices.dtype == np.float32 and faces.dtype == np.int32


def test_edges_become_short():
    mesh = trimesh.creation.cylinder(0.03, 0.15, sections=8)
    vertices, faces = finer(mesh.vertices, mesh.faces, 0.004, 100_000)
    corners = vertices[faces]
    assert np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max() <= 0.004 + 1e-6


def test_a_mesh_of_many_faces_is_left_as_it_is():
    mesh = trimesh.creation.icosphere(3)
    vertices, faces = finer(mesh.vertices, mesh.faces, 0.001, 1_000)
    np.testing.assert_array_equal(faces, mesh.faces)
    np.testing.assert_allclose(vertices, mesh.vertices, atol=1e-6)


def test_points_take_the_colour_of_the_nearest():
    colours = Colours(np.array([[0, 0, -1], [0, 0, 1]], np.float32), np.array([[255, 0, 0], [0, 0, 255]], np.uint8))
    np.testing.assert_array_equal(
        nearest(np.array([[0.3, 0, 0.2], [0.0, 0.9, -0.1]]), colours), [[0, 0, 255], [255, 0, 0]]
    )
    box = trimesh.creation.box((0.02, 0.02, 0.02))
    vertices, _, found = painted(box.vertices, box.faces, colours)
    above = vertices[:, 2] > 1e-6
    assert (found[above] == [0, 0, 255]).all() and above.sum() > 8


def test_a_painted_mesh_is_cut_once_until_it_or_its_colours_change(monkeypatch):
    cuts = []

    def counted(*mesh):
        cuts.append(mesh)
        return finer(*mesh)

    monkeypatch.setattr(palette, "finer", counted)
    ball = trimesh.creation.icosphere(2, 0.0317)
    colours = Colours(np.array([[0, 0, -1], [0, 0, 1]], np.float32), np.array([[255, 0, 0], [0, 0, 255]], np.uint8))
    first = painted(ball.vertices, ball.faces, colours)
    again = painted(np.array(ball.vertices), np.array(ball.faces, np.int32), Colours(*map(np.array, colours)))
    assert len(cuts) == 1 and all(a is b for a, b in zip(first, again, strict=True))
    with pytest.raises(ValueError, match="read-only"):
        first[2][0] = 0
    other = painted(ball.vertices, ball.faces, colours._replace(values=colours.values[::-1]))
    assert len(cuts) == 2 and not np.array_equal(other[2], first[2])
    painted(1.01 * ball.vertices, ball.faces, colours)
    assert len(cuts) == 3
