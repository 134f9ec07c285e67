"""Pieces against MuJoCo's own numbers, the definition of convexity, and volumes worked out by
hand.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from congrasp.common.objects import shapes
from congrasp.common.objects.families.draft import (
    extrude,
    lathe,
    shell,
    slab,
    smooth,
    sweep,
    vessel,
)
from congrasp.common.objects.shapes import halves, mass_properties, sample_mesh, sample_union
from congrasp.common.objects.spec import MAX_MESH_VERTICES, Piece
from tests.solids import mujoco_mass_properties

QUAT = tuple(np.array([0.8, 0.3, -0.4, 0.33]) / np.linalg.norm([0.8, 0.3, -0.4, 0.33]))
WEDGE = np.array(
    [[0, 0, 0], [0.05, 0, 0], [0, 0.03, 0], [0, 0, 0.04], [0.05, 0, 0.04], [0, 0.03, 0.04]]
)
PIECES = {
    "box": Piece("box", (0.03, 0.02, 0.05), (0.01, -0.02, 0.03), QUAT),
    "cylinder": Piece("cylinder", (0.02, 0.05, 0), (0.01, -0.02, 0.03), QUAT),
    "capsule": Piece("capsule", (0.02, 0.05, 0), (0.01, -0.02, 0.03), QUAT),
    "ellipsoid": Piece("ellipsoid", (0.03, 0.02, 0.05), (0.01, -0.02, 0.03), QUAT),
    "mesh": Piece("mesh", (0, 0, 0), (0.01, -0.02, 0.03), QUAT, vertices=WEDGE),
}


@pytest.fixture(params=sorted(PIECES))
def piece(request):
    return PIECES[request.param]


def test_mass_properties_of_a_union_with_densities_equal_mujocos():
    pieces = tuple(PIECES.values())
    densities = np.array([500.0, 900.0, 300.0, 2000.0, 1100.0])
    actual = mass_properties(pieces, densities)
    expected = mujoco_mass_properties(pieces, densities)
    np.testing.assert_allclose(actual[0], expected[0], rtol=1e-5)
    np.testing.assert_allclose(actual[1], expected[1], atol=1e-7)
    np.testing.assert_allclose(actual[2], expected[2], atol=1e-5 * np.abs(expected[2]).max())


def test_surface_samples_have_supporting_planes_and_separate_inside_from_outside(piece):
    u = np.random.default_rng(0).random((2000, 4))
    points, normals, keep = shapes.propose(piece, u)
    points, normals = points[keep], normals[keep]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-12)
    # The tangent plane of a convex body at a point with normal n is its supporting plane in the
    # direction n.
    np.testing.assert_allclose(
        (points * normals).sum(-1), shapes.support(piece, normals), atol=1e-9
    )
    assert shapes.contains(piece, points - 1e-6 * normals).mean() > 0.999
    assert not shapes.contains(piece, points + 1e-6 * normals).any()


def test_tessellations_lie_on_the_surface_and_wind_outwards(piece):
    vertices, faces = shapes.tessellate(piece)
    middle = vertices.mean(0)
    assert not shapes.contains(piece, middle + 1.001 * (vertices - middle)).any()
    assert shapes.contains(piece, middle + 0.999 * (vertices - middle)).all()
    corners = vertices[faces]
    signed = (
        np.einsum(
            "ij,ij->i",
            corners[:, 0] - middle,
            np.cross(corners[:, 1] - middle, corners[:, 2] - middle),
        )
        / 6
    )
    assert (signed > -1e-15).all()
    assert 0.9 * shapes.volume(piece) < signed.sum() <= 1.0001 * shapes.volume(piece)


def test_samples_are_uniform_in_area():
    u = np.random.default_rng(1).random((40_000, 4))
    points, normals, _ = shapes.propose(Piece("cylinder", (0.02, 0.05, 0)), u)
    # Side 2 pi r 2h against two discs 2 pi r^2: 10 to 2.
    assert np.isclose((np.abs(normals[:, 2]) < 0.5).mean(), 10 / 12, atol=0.01)
    points, _, _ = shapes.propose(Piece("capsule", (0.02, 0.05, 0)), u)
    assert np.isclose((np.abs(points[:, 2]) < 0.05).mean(), 5 / 7, atol=0.01)
    _, normals, _ = shapes.propose(Piece("box", (0.01, 0.02, 0.03)), u)
    # Faces 2*3, 3*1 and 1*2.
    np.testing.assert_allclose((np.abs(normals) > 0.5).mean(0), [6 / 11, 3 / 11, 2 / 11], atol=0.01)
    points, _, keep = shapes.propose(Piece("ellipsoid", (0.02, 0.02, 0.06)), u)
    # Prolate spheroid: area beyond |z| > c/2 by its surface of revolution.
    z = np.linspace(-1, 1, 20_001)
    ring = np.sqrt(np.clip(1 - z**2, 0, None) + (z * 0.02 / 0.06) ** 2)
    assert np.isclose(
        (np.abs(points[keep, 2]) > 0.03).mean(), ring[np.abs(z) > 0.5].sum() / ring.sum(), atol=0.01
    )


def test_a_union_has_no_points_inside_or_on_seams_and_keeps_flush_faces():
    # Two cubes side by side, and a bar through both: the shared face and the inside of the bar must
    # stay free.
    pieces = (
        Piece("box", (0.02, 0.02, 0.02), (-0.02, 0, 0)),
        Piece("box", (0.02, 0.02, 0.02), (0.02, 0, 0)),
        Piece("box", (0.06, 0.005, 0.005)),
    )
    points, normals, owner = sample_union(pieces, np.random.default_rng(0), 4000)
    assert points.shape == normals.shape == (4000, 3)
    bar = owner == 2
    assert (np.abs(points[bar, 0]) > 0.04 - 1e-9).all()
    on_seam = (np.abs(points[:, 0]) < 1e-9) & (np.abs(normals[:, 0]) > 0.5)
    assert not on_seam.any()
    # Area: a 8 x 4 x 4 cm block without two 1 x 1 cm holes, and two stubs of 2 cm with 1 x 1 cm
    # ends.
    block = 2 * 16 + 4 * 32 - 2
    stubs = 2 * (4 * 2 + 1)
    assert np.isclose(bar.mean(), stubs / (block + stubs), atol=0.02)
    # Any prefix covers the surface as the whole does.
    assert np.isclose(bar[:400].mean(), bar.mean(), atol=0.03)


def test_halves_cut_across_the_longest_axis():
    points = np.random.default_rng(0).uniform(-1, 1, (1000, 3)) * [0.02, 0.1, 0.03]
    labels = halves(points, 0.3)
    assert np.isclose((labels == 0).mean(), 0.3, atol=0.01)
    assert points[labels == 0, 1].max() < points[labels == 1, 1].min() + 0.02


def test_mesh_samples_exclude_areas_covered_by_pieces():
    # A cube's surface with a second, smaller one inside it, whose faces look inwards.
    outer = shapes.triangulate(np.array(np.meshgrid(*[[-0.03, 0.03]] * 3)).reshape(3, -1).T)
    inner = np.asarray(outer.triangles)[:, ::-1] * 0.6
    triangles = np.concatenate([outer.triangles, inner])
    piece = Piece("box", (0.03, 0.03, 0.03))
    points, normals, face = sample_mesh(
        triangles, (piece,), np.random.default_rng(0), oriented=True
    )
    assert len(points) == 512
    assert (face < 12).all()
    assert ((points * normals).sum(-1) > 0.029).all()
    flipped = np.asarray(outer.triangles)[:, ::-1]
    _, normals, _ = sample_mesh(flipped, (piece,), np.random.default_rng(0), oriented=False)
    points, _, _ = sample_mesh(flipped, (piece,), np.random.default_rng(0), oriented=False)
    assert ((points * normals).sum(-1) > 0.029).all()


# --- lathed, hollow, extruded and swept shapes ---


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


def test_a_shell_is_the_solid_between_its_polygons():
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
    # Three chords stand for each quarter of a circle: three triangles of 30 degrees instead of a
    # square.
    assert shapes.volume(slab((0.03, 0.05, 0.01), 0.02)) == pytest.approx(
        0.02 * (4 * 0.03 * 0.05 - 0.02**2)
    )


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
