"""Estimated normals of analytic shapes, in degrees."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from congrasp.common.task.normals import estimated_normals

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


def test_normals_rotate_with_the_cloud_at_any_scale_and_place():
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
