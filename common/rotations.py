"""Rotations: unit quaternions (w, x, y, z), matrices and intrinsic x-y-z angles, over any leading axes."""

import jax.numpy as jnp
import numpy as np

from congrasp.common.task.types import Array

_UNDECIDED = 1e-5
"""Cosine of the y angle below which the x angle keeps its previous value (`quaternion_to_euler`)."""


def multiply(a: Array, b: Array) -> Array:
    """Hamilton product of quaternions (..., 4): first `b`, then `a`."""
    aw, ax, ay, az = jnp.moveaxis(a, -1, 0)
    bw, bx, by, bz = jnp.moveaxis(b, -1, 0)
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def conjugate(q: Array) -> Array:
    """Inverse of unit quaternions (..., 4)."""
    return q * jnp.array([1.0, -1.0, -1.0, -1.0], q.dtype)


def rotate(q: Array, v: Array) -> Array:
    """Vectors (..., 3) rotated by unit quaternions (..., 4)."""
    w, axis = q[..., :1], q[..., 1:]
    t = 2.0 * jnp.cross(axis, v)
    return v + w * t + jnp.cross(axis, t)


def to_matrix(q: Array) -> Array:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    w, x, y, z = jnp.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def from_matrix(m: Array) -> Array:
    """Unit quaternions (..., 4) with w >= 0 of rotation matrices (..., 3, 3), stable for every rotation."""
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    diagonal = jnp.stack([trace, m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]], -1)
    skew = jnp.stack(
        [m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]],
        -1,
    )
    # Row k holds 4 q_k q; the candidate with the largest component is the most accurate.
    w_row = jnp.concatenate([1.0 + trace[..., None], skew], -1)
    symmetric = m + jnp.swapaxes(m, -1, -2)
    squares = 1.0 - trace[..., None] + 2.0 * diagonal[..., 1:]
    off_diagonal = symmetric * (1.0 - jnp.eye(3, dtype=m.dtype))
    axis_rows = jnp.concatenate([skew[..., :, None], off_diagonal + squares[..., None] * jnp.eye(3, dtype=m.dtype)], -1)
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
    """Rotation matrices (..., 3, 3) about unit axes (..., 3) by angles (...,), by Rodrigues' formula."""
    zero = jnp.zeros_like(axis[..., 0])
    x, y, z = jnp.moveaxis(axis, -1, 0)
    k = jnp.stack(
        [jnp.stack([zero, -z, y], -1), jnp.stack([z, zero, -x], -1), jnp.stack([-y, x, zero], -1)],
        -2,
    )
    s, c = jnp.sin(theta)[..., None, None], jnp.cos(theta)[..., None, None]
    return jnp.eye(3, dtype=axis.dtype) + s * k + (1.0 - c) * (k @ k)


def euler_to_quaternion(angles: Array) -> Array:
    """Quaternions of intrinsic x-y-z angles (..., 3): R = Rx Ry Rz, the order of the wrist's hinges."""
    half = 0.5 * angles
    zero = jnp.zeros_like(half[..., 0])
    c, s = jnp.cos(half), jnp.sin(half)
    qx = jnp.stack([c[..., 0], s[..., 0], zero, zero], -1)
    qy = jnp.stack([c[..., 1], zero, s[..., 1], zero], -1)
    qz = jnp.stack([c[..., 2], zero, zero, s[..., 2]], -1)
    return multiply(multiply(qx, qy), qz)


def quaternion_to_euler(q: Array, near: Array) -> Array:
    """Intrinsic x-y-z angles (..., 3) of quaternions (..., 4), chosen nearest to given ones.

    (x, y, z) and (x + pi, pi - y, z + pi) are the same rotation, up to whole turns. The result is the solution with the
    least sum of squared differences from `near`, each within pi, so that a path followed step by step does not jump
    where y passes +-90 degrees. There only x + z or x - z is determined, and x keeps its value.

    Args:
      q: unit quaternions.
      near: (..., 3) rad, such as the current angles.
    """
    m = to_matrix(q)
    # A weight on the current x decides where the matrix does not: it moves x by less than 0.1 degrees while y is more
    # than a third of a degree from 90. y and z are exact for any x.
    sine, cosine = _UNDECIDED * jnp.sin(near[..., 0]), _UNDECIDED * jnp.cos(near[..., 0])
    branches = [
        _euler_given_x(m, jnp.arctan2(sine - side * m[..., 1, 2], cosine + side * m[..., 2, 2])) for side in (1.0, -1.0)
    ]
    first, second = (wrapped(angles - near) for angles in branches)
    nearer = jnp.sum(first**2, -1, keepdims=True) <= jnp.sum(second**2, -1, keepdims=True)
    return near + jnp.where(nearer, first, second)


def _euler_given_x(m: Array, x: Array) -> Array:
    """Angles (..., 3) of matrices (..., 3, 3) for a known x (...,): those of Rx(-x) R = Ry Rz."""
    s, c = jnp.sin(x), jnp.cos(x)
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
    q = jnp.concatenate([1.0 + jnp.sum(a * b, -1, keepdims=True), jnp.cross(a, b)], -1)
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
    return from_matrix(jnp.stack([first, second, jnp.cross(first, second)], -1))


def apply(matrix: Array, points: Array) -> Array:
    """Points (..., N, 3) rotated by matrices (..., 3, 3).

    Written out, because the overhead of a matrix product of this size exceeds its arithmetic.
    """
    return sum(matrix[..., None, :, i] * points[..., i, None] for i in range(3))


def transform(position: Array, quaternion: Array, points: Array) -> Array:
    """Transforms points (..., N, 3) of a body's frame into the frame of the body's pose (..., 3), (..., 4)."""
    return apply(to_matrix(quaternion), points) + position[..., None, :]


def inverse_transform(position: Array, quaternion: Array, points: Array) -> Array:
    """Transforms points (..., N, 3) into the frame of a body with this pose; the inverse of `transform`."""
    return apply(jnp.swapaxes(to_matrix(quaternion), -1, -2), points - position[..., None, :])


def relative_pose(
    position: Array, quaternion: Array, other_position: Array, other_quaternion: Array
) -> tuple[Array, Array]:
    """Pose of `other` in the frame of the first pose (..., 3), (..., 4)."""
    inverse = conjugate(quaternion)
    return rotate(inverse, other_position - position), multiply(inverse, other_quaternion)


def compose_pose(
    position: Array, quaternion: Array, local_position: Array, local_quaternion: Array
) -> tuple[Array, Array]:
    """Composes poses: a pose local to the first one, expressed in the frame in which the first one is given."""
    return position + rotate(quaternion, local_position), multiply(quaternion, local_quaternion)


def continuous(q: np.ndarray) -> np.ndarray:
    """Quaternions (T, 4) of a motion without sign flips, so that neighbours can be interpolated."""
    flips = np.sign(np.sum(q[1:] * q[:-1], -1))
    return q * np.cumprod(np.concatenate([[1.0], np.where(flips == 0, 1.0, flips)]))[:, None]
