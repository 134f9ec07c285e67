"""Volumes of open meshes by winding numbers, against formulas."""

import numpy as np
import pytest
import trimesh

from congrasp.services.assets.objects.fidelity import fidelity
from congrasp.services.assets.objects.winding import open_volume, winding_numbers
from tests.solids import block

SIDES = np.array([0.04, 0.06, 0.08])


def open_box():
    """A box without its top."""
    mesh = block(SIDES)
    mesh.update_faces(mesh.triangles_center[:, 2] < SIDES[2] / 2 - 1e-6)
    return np.asarray(mesh.triangles)


def volume_of(winding):
    return (winding.number > 0.5).sum() * winding.spacing**3


def number_at(winding, point):
    index = np.rint((np.asarray(point) - winding.low) / winding.spacing).astype(int)
    return winding.number[tuple(index)]


def test_numbers_of_a_closed_mesh_are_zero_and_one():
    ball = trimesh.creation.icosphere(3, 0.03)
    winding = winding_numbers(np.asarray(ball.triangles), 64)
    numbers = np.unique(winding.number.round(9))
    assert numbers.tolist() == [0.0, 1.0]
    np.testing.assert_allclose(volume_of(winding), ball.volume, rtol=2e-3)


def test_an_open_box_is_closed_by_the_plane_of_its_rim():
    winding = winding_numbers(open_box(), 64)
    np.testing.assert_allclose(volume_of(winding), SIDES.prod(), rtol=0.01)
    # The open side of a cube is a sixth of the directions from its middle.
    cube = block((0.06, 0.06, 0.06))
    cube.update_faces(cube.triangles_center[:, 2] < 0.029)
    number = number_at(winding_numbers(np.asarray(cube.triangles), 48), (0, 0, 0))
    np.testing.assert_allclose(number, 5 / 6, atol=0.06)


@pytest.mark.parametrize("height", [0.03, 0.037])
def test_a_sphere_with_a_hole_has_the_volume_below_the_hole(height):
    """Without its cap of height h = r - `height`: 4/3 pi r^3 - pi h^2 (3 r - h) / 3."""
    sphere = trimesh.creation.icosphere(4, 0.04)
    sphere.update_faces(sphere.triangles_center[:, 2] < height)
    cap = 0.04 - height
    expected = 4 / 3 * np.pi * 0.04**3 - np.pi * cap**2 * (3 * 0.04 - cap) / 3
    winding = winding_numbers(np.asarray(sphere.triangles), 64)
    np.testing.assert_allclose(volume_of(winding), expected, rtol=0.015)


def test_a_small_hole_leaves_a_volume_and_a_wide_one_does_not():
    sphere = trimesh.creation.icosphere(5, 0.04)
    sphere.update_faces(sphere.triangles_center[:, 2] < 0.0397)
    np.testing.assert_allclose(
        open_volume(np.asarray(sphere.triangles)), 4 / 3 * np.pi * 0.04**3, rtol=0.01
    )
    assert open_volume(open_box()) is None


def test_a_sheet_and_an_inside_out_mesh_have_no_volume():
    box = np.asarray(block(SIDES).triangles)
    assert open_volume(box[:2]) is None
    assert open_volume(box[:, ::-1]) is None


def test_two_surfaces_without_a_rim_enclose_the_wall_between_them():
    outer = trimesh.creation.icosphere(4, 0.04)
    inner = trimesh.creation.icosphere(4, 0.035)
    inner.invert()
    wall = np.concatenate([outer.triangles, inner.triangles[1:]])
    expected = 4 / 3 * np.pi * (0.04**3 - 0.035**3)
    np.testing.assert_allclose(open_volume(wall), expected, rtol=0.02)


def test_errors_of_an_open_mesh_use_its_volume():
    mesh = block(SIDES)
    mesh.update_faces(np.arange(12) > 1)
    piece = np.asarray(block(SIDES - [0, 0, 0.008]).vertices)
    errors = fidelity(np.asarray(mesh.triangles), [piece], False, SIDES.prod())
    np.testing.assert_allclose(errors.volume, -0.1, atol=3e-3)
