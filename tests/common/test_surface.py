"""Signed distance and normals of surfaces, against closed forms, known points and exact queries."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from congrasp.common.objects import procedural, shapes
from congrasp.common.objects.distance import (
    MARGIN,
    DistanceField,
    distance_field,
    primitive_distance,
)
from congrasp.common.objects.spec import GraspObject, Piece
from congrasp.common.task.normals import estimated_normals

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


# --- estimated normals of analytic shapes, in degrees ---


COUNT = 256
estimate = jax.jit(estimated_normals)


def _units(rng: np.random.Generator, count: int) -> np.ndarray:
    drawn = rng.normal(size=(count, 3))
    return drawn / np.linalg.norm(drawn, axis=-1, keepdims=True)


def sphere(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    normals = _units(rng, COUNT)
    return 0.04 * normals, normals


def box(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    half = np.array([0.03, 0.05, 0.07])
    areas = np.array([half[1] * half[2], half[0] * half[2], half[0] * half[1]])
    axis = rng.choice(3, COUNT, p=areas / areas.sum())
    side = rng.choice([-1.0, 1.0], COUNT)
    normals = side[:, None] * np.eye(3)[axis]
    points = rng.uniform(-half, half, (COUNT, 3))
    return np.where(normals != 0, normals * half, points), normals


def cylinder(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    radius = 0.03
    half = 0.06
    angle = rng.uniform(0, 2 * np.pi, COUNT)
    cap = rng.random(COUNT) < radius / (radius + 2 * half)
    round_ = np.stack([np.cos(angle), np.sin(angle), np.zeros(COUNT)], -1)
    side = np.stack([np.zeros(COUNT), np.zeros(COUNT), rng.choice([-1.0, 1.0], COUNT)], -1)
    wall = radius * round_ + rng.uniform(-half, half, COUNT)[:, None] * [0, 0, 1]
    lid = radius * np.sqrt(rng.random(COUNT))[:, None] * round_ + half * side
    return np.where(cap[:, None], lid, wall), np.where(cap[:, None], side, round_)


def bowl(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Half a sphere with a wall 3 mm thick; its points lie about 12 mm apart."""
    down = _units(rng, COUNT) * [1, 1, -1]
    down[:, 2] = -np.abs(down[:, 2])
    outer = rng.random(COUNT)[:, None] < 0.5
    return np.where(outer, 0.07, 0.067) * down, np.where(outer, down, -down)


def degrees(estimated: np.ndarray, exact: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip(np.sum(np.asarray(estimated) * exact, -1), -1, 1)))


@pytest.mark.parametrize(
    ("shape", "median", "most", "inward"),
    [
        (sphere, 6.0, 15.0, 0.0),
        (box, 3.0, 70.0, 0.06),
        (cylinder, 8.0, 40.0, 0.04),
        (bowl, 15.0, 180.0, 0.2),
    ],
)
def test_estimated_normals_are_near_the_exact_ones(shape, median, most, inward):
    """Median and 90th percentile of the errors, and the share that points inward, of 20 clouds of
    256 points each.
    """
    rng = np.random.default_rng(0)
    clouds, exact = map(np.stack, zip(*(shape(rng) for _ in range(20)), strict=True))
    estimated = np.asarray(estimate(clouds.astype(np.float32)))
    np.testing.assert_allclose(np.linalg.norm(estimated, axis=-1), 1.0, atol=1e-5)
    errors = degrees(estimated, exact)
    assert np.median(errors) < median
    assert np.percentile(errors, 90) < most
    assert np.mean(errors > 90) <= inward


def test_normals_turn_with_the_cloud_whatever_its_unit_and_place():
    rng = np.random.default_rng(1)
    points, _ = cylinder(rng)
    turn = Rotation.random(random_state=2)
    first, turned = (
        np.asarray(estimate(cloud[None].astype(np.float32))[0])
        for cloud in (points, 10 * turn.apply(points) + 3)
    )
    assert np.percentile(degrees(turned, turn.apply(first)), 95) < 1.0


def test_repeated_points_count_once():
    points, exact = sphere(np.random.default_rng(3))
    twice = np.concatenate([points[:128], points[:128]])[None].astype(np.float32)
    estimated = np.asarray(estimate(twice))[0]
    np.testing.assert_allclose(estimated[:128], estimated[128:], atol=1e-6)
    assert np.median(degrees(estimated[:128], exact[:128])) < 12.0


@pytest.mark.parametrize("count", [1, 2, 3, 7])
def test_any_cloud_has_unit_normals(count):
    rng = np.random.default_rng(count)
    line = np.linspace(0, 1, count)[:, None] * [[1, 0, 0]]
    clouds = np.stack([np.zeros((count, 3)), rng.normal(size=(count, 3)), line])
    for eye in (None, jnp.ones((3, 3))):
        estimated = np.asarray(estimate(clouds, eye))
        np.testing.assert_allclose(np.linalg.norm(estimated, axis=-1), 1.0, atol=1e-5)


def test_normals_of_a_camera_point_toward_it():
    """The camera sees three faces of a box, whose normals are exact except at the edges; and a flat
    sheet.
    """
    points, exact = box(np.random.default_rng(4))
    eye = np.array([0.4, 0.5, 0.6])
    seen = np.sum(exact * (eye - points), -1) > 0
    cloud, exact = points[seen], exact[seen]
    estimated = np.asarray(estimate(cloud[None], jnp.asarray(eye)[None]))[0]
    assert (np.sum(estimated * (eye - cloud), -1) >= 0).all()
    assert np.median(degrees(estimated, exact)) < 3.0
    sheet = np.random.default_rng(5).uniform(-0.05, 0.05, (COUNT, 3)) * [1, 1, 0]
    for side in (1.0, -1.0):
        estimated = np.asarray(estimate(sheet[None], jnp.array([[0.0, 0.0, side]])))[0]
        np.testing.assert_allclose(estimated, np.tile([0, 0, side], (COUNT, 1)), atol=1e-3)
