"""Errors of pieces against meshes whose volume and distance are known."""

import numpy as np
import pytest
import trimesh

from congrasp.services.assets.objects.fidelity import fidelity, interior, voxels
from tests.solids import block

SIDES = np.array([0.04, 0.06, 0.08])


def compared(mesh, pieces, closed=True):
    return fidelity(np.asarray(mesh.triangles), [np.asarray(piece.vertices) for piece in pieces], closed)


def test_a_convex_mesh_and_itself():
    ball = trimesh.creation.icosphere(radius=0.03)
    errors = compared(ball, [ball])
    np.testing.assert_allclose(errors, 0, atol=1e-12)


def test_a_piece_that_is_larger_all_around():
    errors = compared(block(SIDES), [block(SIDES + 0.004)])
    np.testing.assert_allclose(errors.volume, np.prod(1 + 0.004 / SIDES) - 1, atol=3e-3)
    # From a corner it is 2 mm along each of three axes; the spacing of the rays is 0.3 mm.
    np.testing.assert_allclose(errors.surface, 0.002 * np.sqrt(3), atol=5e-4)


def test_a_part_that_is_missing():
    errors = compared(block(SIDES), [block(SIDES - [0, 0, 0.01], (0, 0, -0.005))])
    np.testing.assert_allclose(errors.volume, -0.01 / 0.08, atol=3e-3)
    np.testing.assert_allclose(errors.surface, 0.01, atol=5e-4)


def test_pieces_that_overlap_count_once_and_pieces_that_touch_have_no_surface_between():
    upper = block((0.04, 0.06, 0.05), (0, 0, 0.015))
    for lower in (block((0.04, 0.06, 0.05), (0, 0, -0.015)), block((0.04, 0.06, 0.03), (0, 0, -0.025))):
        errors = compared(block(SIDES), [upper, lower])
        np.testing.assert_allclose(errors.volume, 0, atol=1e-6)
        assert errors.surface < 1e-6


def test_a_body_inside_of_the_mesh_is_no_surface():
    mesh = trimesh.util.concatenate([block(SIDES), block(SIDES / 2)])
    errors = compared(mesh, [block(SIDES)])
    np.testing.assert_allclose(errors.volume, 0, atol=1e-6)
    assert errors.surface < 1e-6


@pytest.mark.parametrize(("width", "counts"), [(0.001, False), (0.012, True)])
def test_a_slot_counts_if_the_ball_gets_in(width, counts):
    half = (0.04 - width) / 2
    sides = [block((half, 0.06, 0.08), (sign * (half + width) / 2, 0, 0)) for sign in (-1, 1)]
    slotted = trimesh.util.concatenate([*sides, block((0.04, 0.06, 0.02), (0, 0, -0.03))])
    errors = compared(slotted, [block(SIDES)])
    if counts:  # the middle of the slot's floor lies 6 cm below the filled top, its walls up to 14 mm from the sides
        assert 0.014 < errors.surface < 0.031
    else:
        assert errors.surface < 0.002


@pytest.mark.parametrize(("top", "counts"), [(0.01, False), (0.005, True)])
def test_a_void_between_pieces_counts_if_the_ball_gets_in(top, counts):
    """Slabs around a void of 2 cm in a cube of 6 cm; the last leaves a slot of 5 mm, or none."""
    slabs = [block((0.06, 0.06, 0.02), (0, 0, z)) for z in (-0.02, 0.02)]
    slabs += [block((0.06, 0.02, 0.02), (0, y, 0)) for y in (-0.02, 0.02)]
    slabs += [block((0.02, 0.02, 0.02), (-0.02, 0, 0)), block((0.02, 0.02, top + 0.01), (0.02, 0, (top - 0.01) / 2))]
    assert (compared(block((0.06,) * 3), slabs).surface > 0.01) == counts


def test_the_inside_of_a_cup_is_outside():
    outer = trimesh.creation.cylinder(0.03, 0.08, sections=48)
    cup = trimesh.creation.annulus(0.026, 0.03, 0.08, sections=48)
    errors = compared(cup, [outer])
    np.testing.assert_allclose(errors.volume, 0.03**2 / (0.03**2 - 0.026**2) - 1, rtol=0.03)
    assert errors.surface > 0.02


def test_wires_between_the_rays_have_exact_volumes():
    wires = [block((3e-4, 3e-4, 0.25)), block((3e-4, 0.25, 3e-4), (0, 0.12515, 0.12485))]
    mesh = trimesh.util.concatenate(wires)
    errors = compared(mesh, wires)
    np.testing.assert_allclose(errors.volume, 0, atol=1e-6)
    assert errors.surface < 5e-4
    errors = compared(mesh, wires[:1])
    np.testing.assert_allclose(errors.volume, -0.5, atol=1e-6)
    np.testing.assert_allclose(errors.surface, 0.25, atol=1e-3)
    points = interior(np.asarray(mesh.triangles), 1000)
    np.testing.assert_allclose(np.ptp(points, axis=0), np.ptp(mesh.vertices, axis=0), rtol=0.05, atol=1e-4)
    assert voxels(np.asarray(mesh.triangles), 0.01).inside.sum() >= 2 * 127


def test_an_open_mesh_has_no_volume_to_compare_with():
    mesh = block(SIDES)
    mesh.update_faces(np.arange(12) > 1)
    errors = compared(mesh, [block(SIDES)], closed=False)
    assert errors.volume is None
    # One side is missing in the mesh: its middle is half of its shorter edge away.
    assert 0.015 < errors.surface < 0.035
    assert "the mesh is open" in str(errors)
