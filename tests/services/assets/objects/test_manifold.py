"""Meshes whose bodies touch along edges become manifolds of the same shape."""

import hypothesis.strategies as st
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings

from congrasp.services.assets.objects.decompose import decompose
from congrasp.services.assets.objects.manifold import manifold


def touching(*boxes: tuple[tuple[float, float, float], tuple[float, float, float]]):
    """Boxes, each by its lowest corner and its sides, with common vertices where they touch."""
    meshes = []
    for low, sides in boxes:
        center = np.add(low, np.divide(sides, 2))
        transform = trimesh.transformations.translation_matrix(center)
        meshes.append(trimesh.creation.box(sides, transform))
    mesh = trimesh.util.concatenate(meshes)
    mesh.merge_vertices()
    return mesh


def test_an_edge_of_two_boxes_belongs_to_both():
    mesh = touching(((0, 0, 0), (1, 1, 1)), ((1, 1, 0), (1, 1, 1)))
    assert len(mesh.vertices) == 14
    assert not mesh.is_watertight
    vertices, faces = manifold(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    bodies = trimesh.Trimesh(vertices, faces, process=False).split()
    assert sorted(body.volume for body in bodies) == pytest.approx([1.0, 1.0])
    assert len(vertices) == 16


def test_a_wall_between_two_boxes_ends_the_one_and_begins_the_other():
    mesh = touching(((0, 0, 0), (1, 1, 1)), ((0, 0, 1), (1, 1, 2)))
    vertices, faces = manifold(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    bodies = trimesh.Trimesh(vertices, faces, process=False).split()
    assert sorted(body.volume for body in bodies) == pytest.approx([1.0, 2.0])


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 26), min_size=1, max_size=10, unique=True))
def test_the_shape_of_cubes_of_a_grid_is_unchanged(cells):
    cubes = [((n % 3, n // 3 % 3, n // 9), (1, 1, 1)) for n in cells]
    mesh = touching(*cubes)
    vertices, faces = manifold(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    grid = trimesh.Trimesh(vertices, faces, process=False)
    assert grid.is_watertight
    assert grid.volume == pytest.approx(len(cells))
    np.testing.assert_array_equal(grid.triangles, mesh.triangles)


def test_a_manifold_is_unchanged():
    sphere = trimesh.creation.icosphere(subdivisions=1)
    vertices, faces = manifold(np.asarray(sphere.vertices), np.asarray(sphere.faces))
    np.testing.assert_array_equal(vertices, sphere.vertices)
    np.testing.assert_array_equal(faces, sphere.faces)


def test_an_open_mesh_has_none():
    box = trimesh.creation.box()
    assert manifold(np.asarray(box.vertices), np.asarray(box.faces)[1:]) is None


def test_pieces_of_stacked_boxes_are_the_boxes():
    mesh = touching(((0, 0, 0), (0.06, 0.06, 0.05)), ((0, 0, 0.05), (0.06, 0.02, 0.08)))
    volume = 0.06 * 0.06 * 0.05 + 0.06 * 0.02 * 0.08
    result = decompose(np.asarray(mesh.vertices), np.asarray(mesh.faces), volume=volume)
    assert sorted(len(piece) for piece in result.pieces) == [8, 8]
    sides = sorted(tuple(np.round(np.ptp(piece, axis=0), 6)) for piece in result.pieces)
    assert sides == [(0.06, 0.02, 0.08), (0.06, 0.06, 0.05)]
