"""Rotations against SciPy."""

import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from common import rotations

seeds = st.integers(0, 2**31)


def _random(seed: int, count: int = 8) -> Rotation:
    return Rotation.random(count, np.random.default_rng(seed))


def _wxyz(rotation: Rotation) -> np.ndarray:
    return rotation.as_quat(scalar_first=True).astype(np.float32)


@settings(max_examples=30, deadline=None)
@given(seeds, seeds)
def test_products_rotations_and_matrices_agree_with_scipy(a, b):
    first, second = _random(a), _random(b)
    vectors = np.random.default_rng(a).normal(size=(8, 3)).astype(np.float32)
    np.testing.assert_allclose(
        np.abs(np.sum(rotations.multiply(_wxyz(first), _wxyz(second)) * _wxyz(first * second), -1)), 1.0, atol=1e-5
    )
    np.testing.assert_allclose(rotations.rotate(_wxyz(first), vectors), first.apply(vectors), atol=1e-5)
    np.testing.assert_allclose(rotations.to_matrix(_wxyz(first)), first.as_matrix(), atol=1e-5)
    np.testing.assert_allclose(
        rotations.angle(_wxyz(first), _wxyz(second)), (first.inv() * second).magnitude(), atol=1e-3
    )


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_matrix_to_quaternion_and_back(seed):
    rotation = _random(seed)
    half_turns = Rotation.from_rotvec(np.pi * np.eye(3))
    for each in (rotation, half_turns):
        matrix = jnp.array(each.as_matrix(), jnp.float32)
        np.testing.assert_allclose(rotations.to_matrix(rotations.from_matrix(matrix)), matrix, atol=1e-5)


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_euler_angles_are_intrinsic_xyz(seed):
    angles = np.random.default_rng(seed).uniform(-1.4, 1.4, (8, 3)).astype(np.float32)
    expected = Rotation.from_euler("XYZ", angles)
    quaternion = rotations.euler_to_quaternion(jnp.array(angles))
    np.testing.assert_allclose(np.abs(np.sum(quaternion * _wxyz(expected), -1)), 1.0, atol=1e-5)
    np.testing.assert_allclose(rotations.quaternion_to_euler(quaternion), angles, atol=2e-4)


def test_axis_rotation_by_hand():
    quarter = rotations.axis_rotation(jnp.array([0.0, 0.0, 1.0]), jnp.array(np.pi / 2))
    np.testing.assert_allclose(quarter @ jnp.array([1.0, 0.0, 0.0]), [0.0, 1.0, 0.0], atol=1e-6)


def test_poses_compose_and_invert():
    rng = np.random.default_rng(3)
    p, q = rng.normal(size=(8, 3)).astype(np.float32), _wxyz(_random(1))
    p2, q2 = rng.normal(size=(8, 3)).astype(np.float32), _wxyz(_random(2))
    local = rotations.relative_pose(p, q, p2, q2)
    back = rotations.compose_pose(p, q, *local)
    np.testing.assert_allclose(back[0], p2, atol=1e-5)
    np.testing.assert_allclose(np.abs(np.sum(back[1] * q2, -1)), 1.0, atol=1e-5)
    points = rng.normal(size=(8, 5, 3)).astype(np.float32)
    np.testing.assert_allclose(rotations.inverse_transform(p, q, rotations.transform(p, q, points)), points, atol=1e-5)
