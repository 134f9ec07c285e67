"""One piece against MuJoCo's own numbers and against the definition of convexity."""

import numpy as np
import pytest

from congrasp.common.objects import shapes
from congrasp.common.objects.shapes import halves, mass_properties, sample_mesh, sample_union
from congrasp.common.objects.spec import Piece
from tests.solids import mujoco_mass_properties

QUAT = tuple(np.array([0.8, 0.3, -0.4, 0.33]) / np.linalg.norm([0.8, 0.3, -0.4, 0.33]))
WEDGE = np.array([[0, 0, 0], [0.05, 0, 0], [0, 0.03, 0], [0, 0, 0.04], [0.05, 0, 0.04], [0, 0.03, 0.04]])
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
    pieces, densities = tuple(PIECES.values()), np.array([500.0, 900.0, 300.0, 2000.0, 1100.0])
    found, expected = mass_properties(pieces, densities), mujoco_mass_properties(pieces, densities)
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-5)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-7)
    np.testing.assert_allclose(found[2], expected[2], atol=1e-5 * np.abs(expected[2]).max())


def test_surface_samples_have_supporting_planes_and_separate_inside_from_outside(piece):
    u = np.random.default_rng(0).random((2000, 4))
    points, normals, keep = shapes.propose(piece, u)
    points, normals = points[keep], normals[keep]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-12)
    # The tangent plane of a convex body at a point with normal n is its supporting plane in the direction n.
    np.testing.assert_allclose((points * normals).sum(-1), shapes.support(piece, normals), atol=1e-9)
    assert shapes.contains(piece, points - 1e-6 * normals).mean() > 0.999
    assert not shapes.contains(piece, points + 1e-6 * normals).any()


def test_tessellations_lie_on_the_surface_and_wind_outwards(piece):
    vertices, faces = shapes.tessellate(piece)
    middle = vertices.mean(0)
    assert not shapes.contains(piece, middle + 1.001 * (vertices - middle)).any()
    assert shapes.contains(piece, middle + 0.999 * (vertices - middle)).all()
    corners = vertices[faces]
    signed = np.einsum("ij,ij->i", corners[:, 0] - middle, np.cross(corners[:, 1] - middle, corners[:, 2] - middle)) / 6
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
    assert np.isclose((np.abs(points[keep, 2]) > 0.03).mean(), ring[np.abs(z) > 0.5].sum() / ring.sum(), atol=0.01)


def test_a_union_has_no_points_inside_or_on_seams_and_keeps_flush_faces():
    # Two cubes side by side, and a bar through both: the shared face and the inside of the bar must stay free.
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
    # Area: a 8 x 4 x 4 cm block without two 1 x 1 cm holes, and two stubs of 2 cm with 1 x 1 cm ends.
    block, stubs = 2 * 16 + 4 * 32 - 2, 2 * (4 * 2 + 1)
    assert np.isclose(bar.mean(), stubs / (block + stubs), atol=0.02)
    # Any prefix covers the surface as the whole does.
    assert np.isclose(bar[:400].mean(), bar.mean(), atol=0.03)


def test_halves_cut_across_the_longest_axis():
    points = np.random.default_rng(0).uniform(-1, 1, (1000, 3)) * [0.02, 0.1, 0.03]
    labels = halves(points, 0.3)
    assert np.isclose((labels == 0).mean(), 0.3, atol=0.01)
    assert points[labels == 0, 1].max() < points[labels == 1, 1].min() + 0.02


def test_mesh_samples_leave_out_what_the_pieces_cover():
    # A cube's surface with a second, smaller one inside it, whose faces look inwards.
    outer = shapes.triangulate(np.array(np.meshgrid(*[[-0.03, 0.03]] * 3)).reshape(3, -1).T)
    inner = np.asarray(outer.triangles)[:, ::-1] * 0.6
    triangles = np.concatenate([outer.triangles, inner])
    piece = Piece("box", (0.03, 0.03, 0.03))
    points, normals, face = sample_mesh(triangles, (piece,), np.random.default_rng(0), oriented=True)
    assert len(points) == 512
    assert (face < 12).all()
    assert ((points * normals).sum(-1) > 0.029).all()
    flipped = np.asarray(outer.triangles)[:, ::-1]
    _, normals, _ = sample_mesh(flipped, (piece,), np.random.default_rng(0), oriented=False)
    points, _, _ = sample_mesh(flipped, (piece,), np.random.default_rng(0), oriented=False)
    assert ((points * normals).sum(-1) > 0.029).all()
