"""Convex pieces: joined and simplified where the shape stays, and their errors against known
meshes.
"""

import numpy as np
import pytest
import trimesh

from congrasp.common.objects import shapes
from congrasp.common.objects.spec import MAX_MESH_VERTICES
from congrasp.services.assets.objects.fidelity import fidelity
from congrasp.services.assets.objects.hulls import simplify, solid_hull
from congrasp.services.assets.objects.interior import interior
from congrasp.services.assets.objects.merging import merge
from congrasp.services.assets.objects.voxels import voxels
from tests.solids import block


def prism(outline, depth):
    """Triangles of a prism over an outline (N, 2) that its first and its last corner see all of."""
    low, high = (
        np.column_stack([outline, np.full(len(outline), z)]) for z in (-depth / 2, depth / 2)
    )
    caps = []
    for side in (low[::-1], high):
        caps += [[side[0], side[i], side[i + 1]] for i in range(1, len(side) - 1)]
    walls = [[low[i - 1], low[i], high[i]] for i in range(len(low))]
    return np.array(caps + walls + [[low[i - 1], high[i], high[i - 1]] for i in range(len(low))])


def joined(blocks, max_pieces, triangles=None):
    if triangles is None:
        triangles = np.concatenate([np.asarray(mesh.triangles) for mesh in blocks])
    volume = sum(mesh.volume for mesh in blocks)
    return merge([np.asarray(mesh.vertices) for mesh in blocks], max_pieces, triangles, volume)


def test_pieces_that_form_a_convex_one_are_joined_without_need():
    blocks = [block((0.01, 0.01, 0.01), (x, 0, 0)) for x in (0, 0.01, 0.1, 0.11)]
    halves = [np.asarray(block((0.02, 0.01, 0.01), (x, 0, 0)).triangles) for x in (0.005, 0.105)]
    merged = joined(blocks, 8, np.concatenate(halves))
    np.testing.assert_allclose(
        [shapes.hull_of(piece).volume for piece in merged], [2e-6, 2e-6], rtol=1e-6
    )


def test_a_corner_is_kept_while_there_is_room_and_filled_when_there_is_none():
    ell = [block((0.06, 0.02, 0.02), (0.01, 0, 0)), block((0.02, 0.04, 0.02), (-0.01, 0.03, 0))]
    assert len(joined(ell, 2)) == 2
    (hull,) = joined(ell, 1)
    # The corner's triangle of 4 x 4 cm is filled.
    np.testing.assert_allclose(
        shapes.hull_of(hull).volume, (0.06 + 0.04) * 0.02**2 + 0.04**2 / 2 * 0.02, rtol=1e-6
    )


@pytest.mark.parametrize(("closed", "counts"), [(False, (2, 1)), (True, (1, 1))])
def test_a_thin_step_is_joined_for_its_small_depth_but_not_for_a_large_volume(closed, counts):
    """The upper side of the lower half is buried by 0.5 mm at most, under a wedge of 2 x 2 cm x
    0.25 mm: 5.6 % of a slab of 2 mm, which thinning takes off a closed mesh, and 1.2 % of one of 1
    cm."""

    def pieces_of_step(height):
        low = block((0.02, height, 0.02), (0.01, height / 2, 0))
        high = height + 0.0005
        blocks = [low, block((0.02, high, 0.02), (0.03, high / 2, 0))]
        outline = [[0, 0], [0.04, 0], [0.04, high], [0.02, high], [0.02, height], [0, height]]
        surface = prism(np.array(outline), 0.02)
        volume = sum(block.volume for block in blocks)
        return len(
            merge(
                [np.asarray(block.vertices) for block in blocks],
                4,
                surface,
                volume if closed else None,
            )
        )

    assert (pieces_of_step(0.002), pieces_of_step(0.01)) == counts


def test_bodies_apart_are_never_joined():
    assert len(joined([block((0.01, 0.01, 0.01), (x, 0, 0)) for x in (0, 0.05, 0.1)], 1)) == 3


def test_dust_of_the_cutting_is_no_piece():
    flat = np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0.01, 0.01, 0]])
    assert solid_hull(flat) is None
    assert solid_hull(np.concatenate([flat, [[0, 0, 1e-8]]])) is None


def test_simplified_pieces_keep_shape_and_volume():
    ball = np.random.default_rng(0).normal(size=(800, 3)) * [1, 1.5, 0.5]
    ball = 0.03 * ball / np.linalg.norm(ball / [1, 1.5, 0.5], axis=-1, keepdims=True)
    few = simplify(ball)
    assert len(few) == MAX_MESH_VERTICES
    np.testing.assert_allclose(shapes.hull_of(few).volume, shapes.hull_of(ball).volume, rtol=1e-9)
    np.testing.assert_allclose(np.ptp(few, axis=0), np.ptp(ball, axis=0), rtol=0.06)
    cube = np.array(np.meshgrid(*[np.linspace(-1, 1, 5)] * 3)).reshape(3, -1).T
    assert {tuple(abs(corner)) for corner in simplify(cube)} == {(1.0, 1.0, 1.0)}


@pytest.mark.parametrize("angle", [45, 90])
def test_pieces_of_a_bent_wall_are_as_thin_as_the_wall(angle):
    """Six parts of a wall of 2 mm around a radius of 4 cm become two: their hulls have up to three
    times the volume.
    """
    turn = np.radians(np.linspace(0, angle, 25))
    inner, outer = (np.column_stack([r * np.cos(turn), r * np.sin(turn)]) for r in (0.039, 0.041))
    sections = [
        prism(np.array([inner[i], outer[i], outer[i + 1], inner[i + 1]]), 0.03) for i in range(24)
    ]
    wall = np.concatenate(sections)
    blocks = [np.concatenate(some).reshape(-1, 3) for some in np.split(np.array(sections), 6)]
    volume = np.radians(angle) * 0.040 * 0.002 * 0.03
    merged = merge(blocks, 2, wall, volume)
    assert len(merged) == 2
    errors = fidelity(wall, merged, is_closed=True)
    assert abs(errors.volume) < 0.05
    # The bend of a half is r (1 - cos(angle / 4)) deep.
    assert errors.surface < 0.041 * (1 - np.cos(np.radians(angle / 4)))
    as_thick = merge(blocks, 2, wall, None)
    assert sum(shapes.hull_of(piece).volume for piece in as_thick) > 1.2 * volume


# --- errors ---


SIDES = np.array([0.04, 0.06, 0.08])


def compared(mesh, pieces, closed=True):
    return fidelity(
        np.asarray(mesh.triangles), [np.asarray(piece.vertices) for piece in pieces], closed
    )


def test_a_convex_mesh_and_itself():
    ball = trimesh.creation.icosphere(radius=0.03)
    errors = compared(ball, [ball])
    np.testing.assert_allclose(errors, 0, atol=1e-12)


def test_a_surface_that_no_ball_touches_is_not_faultless(monkeypatch):
    monkeypatch.setattr(
        "congrasp.services.assets.objects.fidelity.are_outside",
        lambda triangles, centers: np.zeros(len(centers), bool),
    )
    assert compared(block(SIDES), [block(SIDES + 0.004)]).surface > 0.002


def test_walls_of_a_crack_do_not_count():
    """Two plates 0.35 mm apart, and a piece that fills them: the gap's walls are no error."""
    plates = [block([0.03, 0.03, 0.004]), block([0.03, 0.03, 0.004])]
    plates[1].apply_translation([0, 0, 0.00435])
    filled = block([0.03, 0.03, 0.00835])
    filled.apply_translation([0, 0, 0.002175])
    assert compared(trimesh.util.concatenate(plates), [filled]).surface < 5e-4


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
    for lower in (
        block((0.04, 0.06, 0.05), (0, 0, -0.015)),
        block((0.04, 0.06, 0.03), (0, 0, -0.025)),
    ):
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
    # The middle of the slot's floor lies 6 cm below the filled top, its walls up to 14 mm
    # from the sides
    if counts:
        assert 0.014 < errors.surface < 0.031
    else:
        assert errors.surface < 0.002


@pytest.mark.parametrize(("top", "counts"), [(0.01, False), (0.005, True)])
def test_a_void_between_pieces_counts_if_the_ball_gets_in(top, counts):
    """Slabs around a void of 2 cm in a cube of 6 cm; the last leaves a slot of 5 mm, or none."""
    slabs = [block((0.06, 0.06, 0.02), (0, 0, z)) for z in (-0.02, 0.02)]
    slabs += [block((0.06, 0.02, 0.02), (0, y, 0)) for y in (-0.02, 0.02)]
    slabs += [
        block((0.02, 0.02, 0.02), (-0.02, 0, 0)),
        block((0.02, 0.02, top + 0.01), (0.02, 0, (top - 0.01) / 2)),
    ]
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
    np.testing.assert_allclose(
        np.ptp(points, axis=0), np.ptp(mesh.vertices, axis=0), rtol=0.05, atol=1e-4
    )
    assert voxels(np.asarray(mesh.triangles), 0.01).inside.sum() >= 2 * 127


def test_an_open_mesh_has_no_volume_to_compare_with():
    mesh = block(SIDES)
    mesh.update_faces(np.arange(12) > 1)
    errors = compared(mesh, [block(SIDES)], closed=False)
    assert errors.volume is None
    # One side is missing in the mesh: its middle is half of its shorter edge away.
    assert 0.015 < errors.surface < 0.035
    assert "the mesh is open" in str(errors)
