"""Rotations against SciPy."""

import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from congrasp.common import rotations as module
from tests.compiled import Compiled

rotations = Compiled(module)
seeds = st.integers(0, 2**31)


def _random(seed: int, count: int = 8) -> Rotation:
    return Rotation.random(count, np.random.default_rng(seed))


def _wxyz(rotation: Rotation) -> np.ndarray:
    return rotation.as_quat(scalar_first=True).astype(np.float32)


@settings(max_examples=15, deadline=None)
@given(seeds, seeds)
def test_products_rotations_and_matrices_agree_with_scipy(a, b):
    first = _random(a)
    second = _random(b)
    vectors = np.random.default_rng(a).normal(size=(8, 3)).astype(np.float32)
    np.testing.assert_allclose(
        np.abs(np.sum(rotations.multiply(_wxyz(first), _wxyz(second)) * _wxyz(first * second), -1)),
        1.0,
        atol=1e-5,
    )
    np.testing.assert_allclose(
        rotations.rotate(_wxyz(first), vectors), first.apply(vectors), atol=1e-5
    )
    np.testing.assert_allclose(rotations.to_matrix(_wxyz(first)), first.as_matrix(), atol=1e-5)
    np.testing.assert_allclose(
        rotations.angle(_wxyz(first), _wxyz(second)), (first.inv() * second).magnitude(), atol=1e-3
    )


@settings(max_examples=15, deadline=None)
@given(seeds)
def test_matrix_to_quaternion_and_back(seed):
    rotation = _random(seed)
    half_turns = Rotation.from_rotvec(np.pi * np.eye(3))
    for each in (rotation, half_turns):
        matrix = jnp.array(each.as_matrix(), jnp.float32)
        np.testing.assert_allclose(
            rotations.to_matrix(rotations.from_matrix(matrix)), matrix, atol=1e-5
        )


@settings(max_examples=15, deadline=None)
@given(seeds)
def test_euler_angles_are_intrinsic_xyz(seed):
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-1.4, 1.4, (8, 3)).astype(np.float32)
    expected = Rotation.from_euler("XYZ", angles)
    quaternion = rotations.euler_to_quaternion(jnp.array(angles))
    np.testing.assert_allclose(np.abs(np.sum(quaternion * _wxyz(expected), -1)), 1.0, atol=1e-5)
    near = angles + rng.uniform(-0.4, 0.4, (8, 3)).astype(np.float32)
    np.testing.assert_allclose(rotations.quaternion_to_euler(quaternion, near), angles, atol=2e-4)
    far = rng.uniform(-9.0, 9.0, (8, 3)).astype(np.float32)
    other = rotations.quaternion_to_euler(quaternion, far)
    np.testing.assert_allclose(
        rotations.angle(rotations.euler_to_quaternion(other), quaternion), 0.0, atol=1e-3
    )
    assert np.abs(other - far).max() <= np.pi + 1e-5


def test_euler_angles_stay_continuous_beyond_ninety_degrees():
    """By hand: 95 degrees about y from a wrist at 89 stays (0, 95, 0), and is not (180, 85,
    180).
    """
    turned = rotations.from_rotation_vector(jnp.radians(jnp.array([0.0, 95.0, 0.0])))
    near = np.radians([0.0, 89.0, 0.0]).astype(np.float32)
    np.testing.assert_allclose(
        np.degrees(rotations.quaternion_to_euler(turned, near)), [0.0, 95.0, 0.0], atol=1e-3
    )
    # At 90 degrees only x + z is determined, here 20 degrees: x stays where it is.
    singular = jnp.array(
        Rotation.from_euler("XYZ", [5.0, 90.0, 15.0], True).as_quat(scalar_first=True), jnp.float32
    )
    near = np.radians([12.0, 88.0, 9.0]).astype(np.float32)
    np.testing.assert_allclose(
        np.degrees(rotations.quaternion_to_euler(singular, near)), [12.0, 90.0, 8.0], atol=0.5
    )


@settings(max_examples=10, deadline=None)
@given(st.floats(-0.5, 0.5), st.sampled_from((1.0, -1.0)))
def test_a_path_of_two_and_a_half_radians_about_y_is_followed_without_a_jump(x, sign):
    """Every angle of the steps is worked out by hand: x stays, y grows."""
    angles = np.stack([np.full(51, x), sign * np.linspace(0.0, 2.5, 51), np.zeros(51)], -1).astype(
        np.float32
    )
    near = angles[0]
    for quaternion, expected in zip(
        rotations.euler_to_quaternion(jnp.array(angles)), angles, strict=True
    ):
        near = rotations.quaternion_to_euler(quaternion, near)
        np.testing.assert_allclose(near, expected, atol=5e-3)


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_the_shortest_rotation_carries_one_vector_to_the_other(seed):
    rng = np.random.default_rng(seed)
    a, b, c = (
        v / np.linalg.norm(v, axis=-1, keepdims=True)
        for v in rng.normal(size=(3, 8, 3)).astype(np.float32)
    )
    axis = np.cross(a, c) / np.linalg.norm(np.cross(a, c), axis=-1, keepdims=True)
    b[0] = -a[0]
    b[1] = a[1]
    turn = np.asarray(rotations.shortest(a, b, axis))
    np.testing.assert_allclose(rotations.rotate(turn, a), b, atol=2e-5)
    expected = np.arccos(np.clip(np.sum(a * b, -1), -1.0, 1.0))
    np.testing.assert_allclose(
        Rotation.from_quat(turn, scalar_first=True).magnitude(), expected, atol=2e-3
    )
    np.testing.assert_allclose(turn[0], [0.0, *axis[0]], atol=1e-6)


def test_axis_rotation_by_hand():
    quarter = rotations.axis_rotation(jnp.array([0.0, 0.0, 1.0]), jnp.array(np.pi / 2))
    np.testing.assert_allclose(quarter @ jnp.array([1.0, 0.0, 0.0]), [0.0, 1.0, 0.0], atol=1e-6)


def test_poses_compose_and_invert():
    rng = np.random.default_rng(3)
    p = rng.normal(size=(8, 3)).astype(np.float32)
    q = _wxyz(_random(1))
    p2 = rng.normal(size=(8, 3)).astype(np.float32)
    q2 = _wxyz(_random(2))
    local = rotations.relative_pose(p, q, p2, q2)
    back = rotations.compose_pose(p, q, *local)
    np.testing.assert_allclose(back[0], p2, atol=1e-5)
    np.testing.assert_allclose(np.abs(np.sum(back[1] * q2, -1)), 1.0, atol=1e-5)
    points = rng.normal(size=(8, 5, 3)).astype(np.float32)
    np.testing.assert_allclose(
        rotations.inverse_transform(p, q, rotations.transform(p, q, points)), points, atol=1e-5
    )
