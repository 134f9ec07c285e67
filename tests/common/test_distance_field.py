"""Distances from the surfaces of objects: exact, and on grids."""

import dataclasses

import jax
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from congrasp.common.objects import procedural, shapes
from congrasp.common.objects.distance import (
    MARGIN,
    DistanceField,
    distance_field,
    primitive_distance,
)
from congrasp.common.objects.spec import GraspObject, Piece

DIAGONAL = (0.9238795325112867, 0.0, 0.0, 0.3826834323650898)  # 45 degrees about z


def of_mesh(mesh: trimesh.Trimesh) -> GraspObject:
    """An object whose real surface is this mesh, and whose physics is its convex hull."""
    base = procedural.generate(0, "box")
    hull = Piece("mesh", (0.0, 0.0, 0.0), vertices=np.asarray(mesh.convex_hull.vertices))
    vertices = np.asarray(mesh.vertices, np.float32)
    faces = np.asarray(mesh.faces, np.int32)
    return dataclasses.replace(base, pieces=(hull,), visual_vertices=vertices, visual_faces=faces)


def near(obj: GraspObject, seed: int = 0) -> tuple[np.ndarray, trimesh.Trimesh]:
    """Points 2 to 22 mm off the object's visual mesh, and that mesh."""
    mesh = trimesh.Trimesh(obj.visual_vertices, obj.visual_faces, process=False)
    points, face = trimesh.sample.sample_surface(mesh, 2000, seed=seed)
    off = np.random.default_rng(seed).uniform(0.002, 0.022, (len(points), 1))
    return points + off * mesh.face_normals[face], mesh


def at(field: DistanceField, points: np.ndarray, index: int = 0) -> np.ndarray:
    return np.asarray(_at(field, np.array([index]), points[None].astype(np.float32)))[0]


_at = jax.jit(DistanceField.at)


@pytest.mark.parametrize(
    ("piece", "point", "distance"),
    [
        (Piece("box", (0.01, 0.02, 0.03)), (0.04, 0.0, 0.0), 0.03),
        (Piece("box", (0.01, 0.02, 0.03)), (0.04, 0.06, 0.0), 0.05),  # 3-4-5 from the edge
        (Piece("box", (0.01, 0.02, 0.03)), (0.008, 0.0, 0.0), -0.002),
        (
            Piece("box", (0.01, 0.01, 0.01), quat=DIAGONAL),
            (0.02, 0.0, 0.0),
            0.02 - 0.01 * np.sqrt(2),
        ),
        (Piece("cylinder", (0.02, 0.05, 0.0)), (0.03, 0.04, 0.0), 0.03),
        (Piece("cylinder", (0.02, 0.05, 0.0)), (0.0, 0.05, 0.09), 0.05),  # 3-4-5 from the rim
        (Piece("cylinder", (0.02, 0.05, 0.0), pos=(0.1, 0.0, 0.0)), (0.1, 0.0, 0.0), -0.02),
        # 3-4-5 from the end of the axis
        (
            Piece("capsule", (0.02, 0.05, 0.0)),
            (0.0, 0.04, 0.08),
            0.03,
        ),
        (Piece("capsule", (0.02, 0.05, 0.0)), (0.005, 0.0, 0.03), -0.015),
        (Piece("ellipsoid", (0.02, 0.03, 0.06)), (0.0, 0.0, 0.07), 0.01),
        (Piece("ellipsoid", (0.02, 0.03, 0.06)), (0.0, 0.0, 0.0), -0.02),
        (Piece("ellipsoid", (0.02, 0.02, 0.02)), (0.03, 0.04, 0.0), 0.03),
    ],
)
def test_distances_worked_out_by_hand(piece, point, distance):
    assert float(primitive_distance([piece], np.array([point]))[0]) == pytest.approx(
        distance, abs=3e-5
    )


@settings(max_examples=25, deadline=None)
@given(
    kind=st.sampled_from(["box", "cylinder", "capsule", "ellipsoid"]),
    size=st.tuples(*[st.floats(0.01, 0.05)] * 3),
    seed=st.integers(0, 1000),
)
def test_off_the_surface_of_a_convex_piece_it_is_the_way_along_the_normal(kind, size, seed):
    piece = Piece(kind, size)
    rng = np.random.default_rng(seed)
    points, normals, _ = shapes.propose(piece, rng.random((50, 4)))
    way = rng.uniform(0.0, 0.03, 50)
    np.testing.assert_allclose(
        primitive_distance([piece], points + way[:, None] * normals), way, atol=2e-5
    )


@pytest.mark.parametrize("family", ["mug", "knife", "ellipsoid"])
def test_grids_of_primitives_are_near_the_exact_distance(family):
    obj = procedural.generate(5, family)
    points, _ = near(obj)
    exact = np.asarray(primitive_distance(obj.pieces, points))
    error = np.abs(at(distance_field([obj]), points) - exact)[(exact > 0.002) & (exact < 0.022)]
    assert error.mean() < 1e-4
    assert np.percentile(error, 99) < 5e-4
    assert error.max() < 1e-3


@pytest.mark.parametrize("oriented", [True, False])
def test_grids_of_meshes_are_near_the_exact_distance_whichever_way_faces_wind(
    oriented, tmp_path, monkeypatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    mesh = trimesh.creation.annulus(0.02, 0.035, 0.06, sections=48)  # its hull would fill the hole
    obj = of_mesh(
        mesh if oriented else trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)
    )
    points, _ = near(of_mesh(mesh))
    exact = np.linalg.norm(points - trimesh.proximity.closest_point(mesh, points)[0], axis=-1)
    interpolated = at(distance_field([obj]), points)
    # At the hole's axis it has a kink
    error = np.abs(interpolated - exact)[(exact > 0.002) & (exact < 0.017)]
    assert error.mean() < 1e-4
    assert np.percentile(error, 99) < 5e-4
    hole, wall = at(distance_field([obj]), np.array([[0.005, 0.0, 0.0], [0.0275, 0.0, 0.0]]))
    assert hole == pytest.approx(0.015, abs=3e-4)  # not filled
    assert wall == pytest.approx(-0.0075, abs=1e-3)


def test_each_object_has_its_own_grid_and_far_points_are_far():
    objects = [procedural.generate(1, "ball"), procedural.generate(2, "box")]
    field = distance_field(objects)
    fields = [distance_field([obj]) for obj in objects]
    points = np.random.default_rng(0).uniform(-0.06, 0.06, (40, 3))
    both = _at(field, np.array([1, 0]), np.stack([points, points]).astype(np.float32))
    np.testing.assert_allclose(both, [at(fields[1], points), at(fields[0], points)], atol=1e-7)
    far = np.array([[objects[1].visual_vertices[:, 0].max() + MARGIN + 0.1, 0.0, 0.0]])
    np.testing.assert_allclose(
        at(field, far, 1), primitive_distance(objects[1].pieces, far), atol=1e-3
    )


def test_grids_of_meshes_are_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    obj = of_mesh(trimesh.creation.icosphere(2, 0.03))
    first = np.asarray(distance_field([obj]).values)
    (file,) = (tmp_path / "congrasp" / "distances").iterdir()
    written = file.stat().st_ino
    np.testing.assert_array_equal(distance_field([obj]).values, first)
    assert file.stat().st_ino == written
