"""Joining and simplifying convex pieces: what must be joined is, what would change the shape is not."""

import numpy as np
import pytest

from congrasp.common.objects import shapes
from congrasp.common.objects.spec import MAX_MESH_VERTICES
from congrasp.services.assets.objects import decompose
from congrasp.services.assets.objects.fidelity import fidelity
from tests.solids import block


def prism(outline, depth):
    """Triangles of a prism over an outline (N, 2) that its first and its last corner see all of."""
    low, high = (np.column_stack([outline, np.full(len(outline), z)]) for z in (-depth / 2, depth / 2))
    caps = [[side[0], side[i], side[i + 1]] for side in (low[::-1], high) for i in range(1, len(side) - 1)]
    walls = [[low[i - 1], low[i], high[i]] for i in range(len(low))]
    return np.array(caps + walls + [[low[i - 1], high[i], high[i - 1]] for i in range(len(low))])


def joined(blocks, max_pieces, triangles=None):
    if triangles is None:
        triangles = np.concatenate([np.asarray(mesh.triangles) for mesh in blocks])
    volume = sum(mesh.volume for mesh in blocks)
    return decompose.merge([np.asarray(mesh.vertices) for mesh in blocks], max_pieces, triangles, volume)


def test_pieces_that_form_a_convex_one_are_joined_without_need():
    blocks = [block((0.01, 0.01, 0.01), (x, 0, 0)) for x in (0, 0.01, 0.1, 0.11)]
    whole = [np.asarray(block((0.02, 0.01, 0.01), (x, 0, 0)).triangles) for x in (0.005, 0.105)]
    merged = joined(blocks, 8, np.concatenate(whole))
    np.testing.assert_allclose([shapes.hull_of(piece).volume for piece in merged], [2e-6, 2e-6], rtol=1e-6)


def test_a_corner_is_kept_while_there_is_room_and_filled_when_there_is_none():
    ell = [block((0.06, 0.02, 0.02), (0.01, 0, 0)), block((0.02, 0.04, 0.02), (-0.01, 0.03, 0))]
    assert len(joined(ell, 2)) == 2
    (hull,) = joined(ell, 1)
    # The corner's triangle of 4 x 4 cm is filled.
    np.testing.assert_allclose(shapes.hull_of(hull).volume, (0.06 + 0.04) * 0.02**2 + 0.04**2 / 2 * 0.02, rtol=1e-6)


@pytest.mark.parametrize(("closed", "counts"), [(False, (2, 1)), (True, (1, 1))])
def test_a_thin_step_is_joined_for_its_small_depth_but_not_for_a_large_volume(closed, counts):
    """The upper side of the lower half is buried by 0.5 mm at most, under a wedge of 2 x 2 cm x 0.25 mm: 5.6 % of a
    slab of 2 mm, which thinning takes off a closed mesh, and 1.2 % of one of 1 cm."""

    def pieces_of_step(height):
        low, high = block((0.02, height, 0.02), (0.01, height / 2, 0)), height + 0.0005
        blocks = [low, block((0.02, high, 0.02), (0.03, high / 2, 0))]
        outline = [[0, 0], [0.04, 0], [0.04, high], [0.02, high], [0.02, height], [0, height]]
        surface, volume = prism(np.array(outline), 0.02), sum(block.volume for block in blocks)
        return len(
            decompose.merge([np.asarray(block.vertices) for block in blocks], 4, surface, volume if closed else None)
        )

    assert (pieces_of_step(0.002), pieces_of_step(0.01)) == counts


def test_bodies_apart_are_never_joined():
    assert len(joined([block((0.01, 0.01, 0.01), (x, 0, 0)) for x in (0, 0.05, 0.1)], 1)) == 3


def test_dust_of_the_cutting_is_no_piece():
    flat = np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0.01, 0.01, 0]])
    assert decompose.solid_hull(flat) is None
    assert decompose.solid_hull(np.concatenate([flat, [[0, 0, 1e-8]]])) is None


def test_simplified_pieces_keep_shape_and_volume():
    ball = np.random.default_rng(0).normal(size=(800, 3)) * [1, 1.5, 0.5]
    ball = 0.03 * ball / np.linalg.norm(ball / [1, 1.5, 0.5], axis=-1, keepdims=True)
    few = decompose.simplify(ball)
    assert len(few) == MAX_MESH_VERTICES
    np.testing.assert_allclose(shapes.hull_of(few).volume, shapes.hull_of(ball).volume, rtol=1e-9)
    np.testing.assert_allclose(np.ptp(few, axis=0), np.ptp(ball, axis=0), rtol=0.06)
    cube = np.array(np.meshgrid(*[np.linspace(-1, 1, 5)] * 3)).reshape(3, -1).T
    assert {tuple(abs(corner)) for corner in decompose.simplify(cube)} == {(1.0, 1.0, 1.0)}


@pytest.mark.parametrize("angle", [45, 90])
def test_pieces_of_a_bent_wall_are_as_thin_as_the_wall(angle):
    """Six parts of a wall of 2 mm around a radius of 4 cm become two: their hulls have up to three times the volume."""
    turn = np.radians(np.linspace(0, angle, 25))
    inner, outer = (np.column_stack([r * np.cos(turn), r * np.sin(turn)]) for r in (0.039, 0.041))
    sections = [prism(np.array([inner[i], outer[i], outer[i + 1], inner[i + 1]]), 0.03) for i in range(24)]
    wall, blocks = (
        np.concatenate(sections),
        [np.concatenate(some).reshape(-1, 3) for some in np.split(np.array(sections), 6)],
    )
    volume = np.radians(angle) * 0.040 * 0.002 * 0.03
    merged = decompose.merge(blocks, 2, wall, volume)
    assert len(merged) == 2
    errors = fidelity(wall, merged, closed=True)
    assert abs(errors.volume) < 0.05
    # The bend of a half is r (1 - cos(angle / 4)) deep.
    assert errors.surface < 0.041 * (1 - np.cos(np.radians(angle / 4)))
    as_thick = decompose.merge(blocks, 2, wall, None)
    assert sum(shapes.hull_of(piece).volume for piece in as_thick) > 1.2 * volume
