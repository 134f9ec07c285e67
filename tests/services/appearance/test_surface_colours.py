"""Colours of surfaces, and meshes that are subdivided for them."""

import numpy as np
import pytest
import trimesh

from congrasp.common.objects.spec import Colours
from congrasp.services.appearance import surface_colours
from congrasp.services.appearance.subdivision import bisect_longest, subdivide
from congrasp.services.appearance.surface_colours import colours_at, paint_surface


@pytest.mark.parametrize("sections", [8, 512, 2048])
def test_the_surface_stays_and_faces_are_bounded(sections):
    # Slivers, where there are many sections
    mesh = trimesh.creation.cylinder(0.03, 0.15, sections=sections)
    vertices, faces = subdivide(mesh.vertices, mesh.faces, 0.003, 9_000)
    fine = trimesh.Trimesh(vertices, faces, process=False)
    assert len(mesh.faces) < len(faces) <= 9_000
    assert fine.area == pytest.approx(mesh.area, rel=1e-4)
    assert fine.volume == pytest.approx(mesh.volume, rel=1e-4)
    assert vertices.dtype == np.float32
    assert faces.dtype == np.int32


def test_edges_become_short():
    mesh = trimesh.creation.cylinder(0.03, 0.15, sections=8)
    vertices, faces = subdivide(mesh.vertices, mesh.faces, 0.004, 100_000)
    corners = vertices[faces]
    assert np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max() <= 0.004 + 1e-6


def test_a_mesh_of_many_faces_is_left_as_it_is():
    mesh = trimesh.creation.icosphere(3)
    vertices, faces = subdivide(mesh.vertices, mesh.faces, 0.001, 1_000)
    np.testing.assert_array_equal(faces, mesh.faces)
    np.testing.assert_allclose(vertices, mesh.vertices, atol=1e-6)


def test_more_triangles_than_the_limit_are_unchanged():
    mesh = trimesh.creation.icosphere(2)
    corners = mesh.vertices[mesh.faces]
    bisected = bisect_longest(corners, 0.01, max_triangles=100)
    assert len(bisected) == len(corners)
    assert sorted(bisected.tolist()) == sorted(corners.tolist())


RED = (255, 0, 0)
BLUE = (0, 0, 255)


def test_a_colour_is_a_mean_of_similar_ones():
    """At distances of 1 and 2 m, 1.5 on average, weights are exp(-(1 / 1.5)^2) = .6412 and
    exp(-(2 / 1.5)^2) = .1690; colours 10 apart are similar to exp(-10^2 / (2 x 24^2)) = .9169.
    """
    points = np.array([[0, 0, -1], [0, 0, 2]], np.float32)
    here = np.zeros((1, 3))
    similar = Colours(points, np.array([(200, 0, 0), (190, 0, 0)], np.uint8))
    # (.6412 x 200 + .1690 x .9169 x 190) / (.6412 + .1690 x .9169) = 198.05
    np.testing.assert_array_equal(colours_at(here, similar), [[198, 0, 0]])
    different = Colours(points, np.array([RED, BLUE], np.uint8))
    np.testing.assert_array_equal(colours_at(here, different), [RED])


def test_an_edge_between_two_colours_is_sharp():
    """On the edge colours are pure, and two points' spacing away they are all that of their side."""
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform(0, 0.1, (8000, 2)), np.zeros(8000)].astype(np.float32)
    colours = Colours(points, np.where(points[:, :1] < 0.05, RED, BLUE).astype(np.uint8))
    along = np.linspace(0.01, 0.09, 300)

    def red_at(x):
        return colours_at(np.c_[np.full(300, x), along, np.zeros(300)], colours)[:, 0]

    assert set(red_at(0.05).tolist()) == {0, 255}
    assert (red_at(0.048) == 255).all()
    assert (red_at(0.052) == 0).all()


def test_a_painted_mesh_is_cut_once_until_it_or_its_colours_change(monkeypatch):
    cuts = []

    def counted(*mesh):
        cuts.append(mesh)
        return subdivide(*mesh)

    monkeypatch.setattr(surface_colours, "subdivide", counted)
    ball = trimesh.creation.icosphere(2, 0.0317)
    colours = Colours(
        np.array([[0, 0, -1], [0, 0, 1]], np.float32),
        np.array([[255, 0, 0], [0, 0, 255]], np.uint8),
    )
    first = paint_surface(ball.vertices, ball.faces, colours)
    again = paint_surface(
        np.array(ball.vertices), np.array(ball.faces, np.int32), Colours(*map(np.array, colours))
    )
    assert len(cuts) == 1
    assert all(a is b for a, b in zip(first, again, strict=True))
    with pytest.raises(ValueError, match="read-only"):
        first[2][0] = 0
    other = paint_surface(ball.vertices, ball.faces, colours._replace(values=colours.values[::-1]))
    assert len(cuts) == 2
    assert not np.array_equal(other[2], first[2])
    paint_surface(1.01 * ball.vertices, ball.faces, colours)
    assert len(cuts) == 3
