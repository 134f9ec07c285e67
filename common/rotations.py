"""Rotations: unit quaternions (w, x, y, z), matrices and intrinsic x-y-z angles, over any leading
axes.

Products are written over whole vectors instead of components: each component would add a slice to
programs that contain hundreds of rotations, and compiling takes longer than running them.
"""

import numpy as np

from congrasp.common.runtime.lazy_jax import jnp
from congrasp.common.task.types import Array

_FACTORS = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])
_SIGNS = np.array([[1, 1, 1, 1], [-1, 1, -1, 1], [-1, 1, 1, -1], [-1, -1, 1, 1]], np.float32)
"""Component k of the Hamilton product a b is the sum over i of a_i signs[i, k] b[factors[i, k]]."""
_SKEW = np.array([[0, 2, 1], [2, 1, 0], [1, 0, 2]])
_SKEW_SIGNS = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]], np.float32)
_IDENTITY = np.eye(4, dtype=np.float32)[0]
_AXES = np.eye(4, dtype=np.float32)[1:]
_UNDECIDED = 1e-5
"""Cosine of the y angle below which the x angle keeps its previous value
(`quaternion_to_euler`).
"""


def multiply(a: Array, b: Array) -> Array:
    """Hamilton product of quaternions (..., 4): first `b`, then `a`."""
    return jnp.sum(a[..., :, None] * (b[..., _FACTORS] * _SIGNS), -2)


def conjugate(q: Array) -> Array:
    """Inverse of unit quaternions (..., 4)."""
    return q * jnp.array([1.0, -1.0, -1.0, -1.0], q.dtype)


def cross(a: Array, b: Array) -> Array:
    """Cross product of vectors (..., 3)."""
    return jnp.roll(a * jnp.roll(b, -1, -1) - jnp.roll(a, -1, -1) * b, -1, -1)


def rotate(q: Array, v: Array) -> Array:
    """Vectors (..., 3) rotated by unit quaternions (..., 4)."""
    w = q[..., :1]
    axis = q[..., 1:]
    t = 2.0 * cross(axis, v)
    return v + w * t + cross(axis, t)


def to_matrix(q: Array) -> Array:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4): (2 w^2 - 1) I + 2 (v v^T + w
    [v]_x).
    """
    w = q[..., :1, None]
    v = q[..., 1:]
    outer = v[..., :, None] * v[..., None, :]
    return (2.0 * w * w - 1.0) * np.eye(3, dtype=np.float32) + 2.0 * (outer + w * skew(v))


def skew(v: Array) -> Array:
    """Matrices (..., 3, 3) of the cross product with vectors (..., 3): skew(v) @ x = v x x."""
    return v[..., _SKEW] * _SKEW_SIGNS


def from_matrix(m: Array) -> Array:
    """Unit quaternions (..., 4) with w >= 0 of rotation matrices (..., 3, 3), stable for every
    rotation.
    """
    entries = m.reshape(*m.shape[:-2], 9)
    axes = entries[..., ::4]
    trace = jnp.sum(entries[..., ::4], -1, keepdims=True)
    diagonal = jnp.concatenate([trace, axes], -1)
    opposite = entries[..., np.array([7, 2, 3])] - entries[..., np.array([5, 6, 1])]
    # Row k holds 4 q_k q; the candidate with the largest component is the most accurate.
    w_row = jnp.concatenate([1.0 + trace, opposite], -1)
    axis_block = m + m.mT + (1.0 - trace)[..., None] * np.eye(3, dtype=np.float32)
    axis_rows = jnp.concatenate([opposite[..., :, None], axis_block], -1)
    rows = jnp.concatenate([w_row[..., None, :], axis_rows], -2)
    best = jnp.argmax(diagonal, -1)
    q = jnp.take_along_axis(rows, best[..., None, None], -2)[..., 0, :]
    q = q / jnp.linalg.norm(q, axis=-1, keepdims=True)
    return jnp.where(q[..., :1] < 0, -q, q)


def angle(a: Array, b: Array) -> Array:
    """Geodesic distance in radians (...,) between unit quaternions (..., 4)."""
    relative = multiply(conjugate(a), b)
    # The sine is floored so that gradients and values stay finite at zero.
    sine = jnp.sqrt(jnp.sum(relative[..., 1:] ** 2, -1) + 1e-14)
    return 2.0 * jnp.arctan2(sine, jnp.abs(relative[..., 0]))


def from_rotation_vector(vector: Array) -> Array:
    """Quaternions (..., 4) of rotation vectors (..., 3): unit axis times angle in radians."""
    half = 0.5 * vector
    # jnp.sinc(x) is sin(pi x) / (pi x), finite at zero.
    length = jnp.sqrt(jnp.sum(half**2, -1, keepdims=True) + 1e-20)
    return jnp.concatenate([jnp.cos(length), jnp.sinc(length / jnp.pi) * half], -1)


def axis_rotation(axis: Array, theta: Array) -> Array:
    """Rotation matrices (..., 3, 3) about unit axes (..., 3) by angles (...,), by Rodrigues'
    formula.
    """
    s = jnp.sin(theta)[..., None, None]
    c = jnp.cos(theta)[..., None, None]
    outer = axis[..., :, None] * axis[..., None, :]
    return c * np.eye(3, dtype=np.float32) + s * skew(axis) + (1.0 - c) * outer


def euler_to_quaternion(angles: Array) -> Array:
    """Quaternions of intrinsic x-y-z angles (..., 3): R = Rx Ry Rz, the order of the wrist's
    hinges.
    """
    half = 0.5 * angles[..., :, None]
    turns = jnp.cos(half) * _IDENTITY + jnp.sin(half) * _AXES
    return multiply(multiply(turns[..., 0, :], turns[..., 1, :]), turns[..., 2, :])


def quaternion_to_euler(q: Array, near: Array) -> Array:
    """Intrinsic x-y-z angles (..., 3) of quaternions (..., 4), chosen nearest to given ones.

    (x, y, z) and (x + pi, pi - y, z + pi) are the same rotation, up to whole turns. The result is
    the solution with the least sum of squared differences from `near`, each within pi, so that a
    path followed step by step does not jump where y passes +-90 degrees. There only x + z or x - z
    is determined, and x keeps its value.

    Args:
      q: unit quaternions.
      near: (..., 3) rad, such as the current angles.
    """
    m = to_matrix(q)
    # A weight on the current x decides where the matrix does not: it moves x by less than 0.1
    # degrees while y is more than a third of a degree from 90. y and z are exact for any x.
    sine = _UNDECIDED * jnp.sin(near[..., 0])
    cosine = _UNDECIDED * jnp.cos(near[..., 0])
    branches = [
        _euler_given_x(m, jnp.arctan2(sine - side * m[..., 1, 2], cosine + side * m[..., 2, 2]))
        for side in (1.0, -1.0)
    ]
    first, second = (wrapped(angles - near) for angles in branches)
    nearer = jnp.sum(first**2, -1, keepdims=True) <= jnp.sum(second**2, -1, keepdims=True)
    return near + jnp.where(nearer, first, second)


def _euler_given_x(m: Array, x: Array) -> Array:
    """Angles (..., 3) of matrices (..., 3, 3) for a known x (...,): those of Rx(-x) R = Ry Rz."""
    s = jnp.sin(x)
    c = jnp.cos(x)
    y = jnp.arctan2(m[..., 0, 2], c * m[..., 2, 2] - s * m[..., 1, 2])
    z = jnp.arctan2(c * m[..., 1, 0] + s * m[..., 2, 0], c * m[..., 1, 1] + s * m[..., 2, 1])
    return jnp.stack([x, y, z], -1)


def wrapped(angle: Array) -> Array:
    """Angles, or differences of angles, in [-pi, pi), rad."""
    return jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi


def shortest(a: Array, b: Array, axis: Array) -> Array:
    """Quaternions (..., 4) of the smallest rotations from unit vectors a (..., 3) to b (..., 3).

    Args:
      a: initial vectors.
      b: final vectors.
      axis: (..., 3) unit, orthogonal to a: the axis used if b is -a, where any is valid.
    """
    q = jnp.concatenate([1.0 + jnp.sum(a * b, -1, keepdims=True), cross(a, b)], -1)
    length = jnp.linalg.norm(q, axis=-1, keepdims=True)
    half_turn = jnp.concatenate([jnp.zeros_like(length), axis], -1)
    return jnp.where(length < 1e-3, half_turn, q / jnp.maximum(length, 1e-3))


def frame_from_axes(primary: Array, secondary: Array) -> Array:
    """Quaternions (..., 4) of the frame with columns (primary, secondary', primary x secondary').

    `primary` (..., 3) is kept, `secondary` (..., 3) is made orthogonal to it.
    """
    first = primary / jnp.linalg.norm(primary, axis=-1, keepdims=True)
    second = secondary - jnp.sum(secondary * first, -1, keepdims=True) * first
    second = second / jnp.linalg.norm(second, axis=-1, keepdims=True)
    return from_matrix(jnp.stack([first, second, cross(first, second)], -1))


def apply(matrix: Array, points: Array) -> Array:
    """Points (..., N, 3) rotated by matrices (..., 3, 3).

    Written out, because the overhead of a matrix product of this size exceeds its arithmetic.
    """
    return sum(matrix[..., None, :, i] * points[..., i, None] for i in range(3))


def transform(position: Array, quaternion: Array, points: Array) -> Array:
    """Transforms points (..., N, 3) of a body's frame into the frame of the body's pose (..., 3),
    (..., 4).
    """
    return apply(to_matrix(quaternion), points) + position[..., None, :]


def inverse_transform(position: Array, quaternion: Array, points: Array) -> Array:
    """Transforms points (..., N, 3) into the frame of a body with this pose; the inverse of
    `transform`.
    """
    return apply(jnp.swapaxes(to_matrix(quaternion), -1, -2), points - position[..., None, :])


def relative_pose(
    position: Array, quaternion: Array, other_position: Array, other_quaternion: Array
) -> tuple[Array, Array]:
    """Pose of `other` in the frame of the first pose (..., 3), (..., 4)."""
    inverse = conjugate(quaternion)
    relative_position = rotate(inverse, other_position - position)
    return relative_position, multiply(inverse, other_quaternion)


def compose_pose(
    position: Array, quaternion: Array, local_position: Array, local_quaternion: Array
) -> tuple[Array, Array]:
    """Composes poses: a pose local to the first one, expressed in the frame in which the first one
    is given.
    """
    return position + rotate(quaternion, local_position), multiply(quaternion, local_quaternion)


def continuous(q: np.ndarray) -> np.ndarray:
    """Quaternions (T, 4) of a motion without sign flips, so that neighbours can be interpolated."""
    flips = np.sign(np.sum(q[1:] * q[:-1], -1))
    factors = np.concatenate([[1.0], np.where(flips == 0, 1.0, flips)])
    return q * np.cumprod(factors)[:, None]
