"""Pieces of lathed, hollow, extruded and swept shapes: volumes by hand, and no piece inside another."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from congrasp.common.objects import shapes
from congrasp.common.objects.families.draft import extrude, lathe, shell, slab, smooth, sweep, vessel
from congrasp.common.objects.spec import MAX_MESH_VERTICES


def _volume(pieces) -> float:
    return sum(shapes.volume(piece) for piece in pieces)


def _polygon(corners: int) -> float:
    """Area of a regular polygon in a circle of radius 1."""
    return corners / 2 * np.sin(2 * np.pi / corners)


def test_a_lathed_solid_has_a_piece_for_each_convex_stretch():
    (cylinder,) = lathe([(0.0, 0.03), (0.1, 0.03)], squash=0.5)
    assert shapes.volume(cylinder) == pytest.approx(_polygon(16) * 0.03**2 * 0.1 * 0.5)
    hourglass = lathe([(0.0, 0.04), (0.05, 0.02), (0.1, 0.04)])
    assert len(hourglass) == 2
    frustum = 0.05 / 3 * (0.04**2 + 0.04 * 0.02 + 0.02**2)
    assert _volume(hourglass) == pytest.approx(2 * _polygon(16) * frustum)
    assert len(lathe([(0.0, 0.02), (0.05, 0.04), (0.1, 0.02)])) == 1


def test_a_shell_is_what_lies_between_its_polygons():
    ring = shell([(0.0, 0.05, 0.04), (0.1, 0.05, 0.04)], 8)
    assert len(ring) == 8
    assert _volume(ring) == pytest.approx(0.1 * (_polygon(16) * 0.05**2 - _polygon(8) * 0.04**2))
    cup = vessel([(0.0, 0.05), (0.1, 0.05)], 0.01, 8)
    inside = 0.09 * _polygon(8) * 0.04**2
    assert _volume(cup) == pytest.approx(0.1 * _polygon(16) * 0.05**2 - inside)


def test_an_extruded_arrow_is_cut_at_its_reflex_corner():
    arrow = np.array([(0.04, 0.0), (-0.03, 0.03), (-0.01, 0.0), (-0.03, -0.03)])
    x, y = arrow.T
    area = (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2
    pieces = extrude(arrow, 0.0, 0.05, taper=0.5)
    assert len(pieces) == 2
    assert _volume(pieces) == pytest.approx(area * 0.05 * (1 + 0.5 + 0.25) / 3)
    assert len(extrude(arrow[[0, 1, 3]], 0.0, 0.05)) == 1


def test_swept_frames_have_mitred_corners():
    square = 0.05 * np.array([(-1.0, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    frame = sweep(square, (0, 0, 1), 0.02, 0.01, closed=True)
    assert len(frame) == 4
    assert _volume(frame) == pytest.approx(0.01 * (0.12**2 - 0.08**2))
    assert _volume(sweep(square[:3], (0, 0, 1), 0.02, 0.01)) == pytest.approx(0.01 * 2 * 0.1 * 0.02)


def test_a_plate_loses_its_corners():
    # Three chords stand for each quarter of a circle: three triangles of 30 degrees instead of a square.
    assert shapes.volume(slab((0.03, 0.05, 0.01), 0.02)) == pytest.approx(0.02 * (4 * 0.03 * 0.05 - 0.02**2))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000))
def test_pieces_of_random_profiles_share_faces_and_no_space(seed):
    rng = np.random.default_rng(seed)
    radii = smooth(rng, 7, 0.02, 0.04)
    turns = np.sort(rng.uniform(0, 2 * np.pi, 9)) / 3 + 2 * np.pi / 9 * 2 / 3 * np.arange(9)
    outline = rng.uniform(0.02, 0.05, 9)[:, None] * np.stack([np.cos(turns), np.sin(turns)], -1)
    solids = (
        lathe(list(zip(np.linspace(0, 0.1, 7), radii, strict=True))),
        vessel(list(zip(np.linspace(0, 0.1, 3), radii[:3], strict=True)), 0.005, 6),
        extrude(outline, 0.0, 0.03),
    )
    for pieces in solids:
        points = rng.uniform((-0.05, -0.05, 0.0), (0.05, 0.05, 0.1), (2000, 3))
        depth = np.sum([shapes.contains(piece, points) for piece in pieces], 0)
        assert depth.max() <= 1
        assert all(len(piece.vertices) <= MAX_MESH_VERTICES for piece in pieces)
